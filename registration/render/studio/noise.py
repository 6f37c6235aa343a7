"""Procedural noise of points in space (m); equal for equal points and seeds."""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float


class SolidNoise:
    """Noise at fixed points. A Mitsuba variant must be active."""

    def __init__(self, points: Float[np.ndarray, "P 3"]):
        # Lattice cells are computed by truncation, which needs positive coordinates.
        self._points = [mi.Float(points[:, k].astype(np.float32) + np.float32(8.0)) for k in range(3)]

    def smooth(
        self, size_m: float, seed: int, *, octaves: int = 1, stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ) -> Float[np.ndarray, "P"]:
        """Return gradient noise [Perlin 2002] with a standard deviation of about 1.

        Args:
            size_m: of the features; each further octave halves it.
            seed: of the noise.
            octaves: number of superposed frequencies.
            stretch: factor of the feature size along x, y, z.
        """
        total, weight, squares = mi.Float(0), 1.0, 0.0
        for octave in range(octaves):
            scale = 2.0**octave / size_m
            position = [p * dr.opaque(mi.Float, scale / s) for p, s in zip(self._points, stretch, strict=True)]
            total += weight * _gradient_noise(position, seed * 31 + octave)
            squares += weight**2
            weight *= 0.6
        return np.array(total) * np.float32(1 / (0.19 * np.sqrt(squares)))

    def dots(self, spacing_m: float, seed: int) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
        """Return cellular noise [Worley 1996]: distances to the nearest feature point, and random numbers.

        Args:
            spacing_m: each cube of this size has one random feature point.
            seed: of the feature points.

        Returns:
            The distance (m), and a number of the nearest feature point, uniform in [0, 1).
        """
        position = [p * dr.opaque(mi.Float, 1 / spacing_m) for p in self._points]
        first = [mi.UInt32(p) - 1 for p in position]
        best, best_number = mi.Float(9), mi.Float(0)
        for steps in product((0, 1, 2), repeat=3):
            cell = [c + step for c, step in zip(first, steps, strict=True)]
            bits = _hash(cell, seed)
            offsets = [mi.Float((bits >> shift) & 1023) / 1024 for shift in (0, 10, 20)]
            d = [mi.Float(c) + o - p for c, o, p in zip(cell, offsets, position, strict=True)]
            squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
            number = mi.Float(_mix(bits + 0x9E3779B9) >> 8) / (1 << 24)
            best_number = dr.select(squared < best, number, best_number)
            best = dr.minimum(best, squared)
        return np.array(dr.sqrt(best)) * np.float32(spacing_m), np.array(best_number)


def _mix(bits: mi.UInt32) -> mi.UInt32:
    """Hash a 32-bit integer: `lowbias32` of [Wellons 2018]."""
    bits = (bits ^ (bits >> 16)) * 0x7FEB352D
    bits = (bits ^ (bits >> 15)) * 0x846CA68B
    return bits ^ (bits >> 16)


def _hash(cell: list[mi.UInt32], seed: int) -> mi.UInt32:
    start = dr.opaque(mi.UInt32, (seed * 0x9E3779B1 + 0x85EBCA6B) & 0xFFFFFFFF)
    return _mix(cell[2] + _mix(cell[1] + _mix(cell[0] + start)))


def _gradient_noise(position: list[mi.Float], seed: int) -> mi.Float:
    cell = [mi.UInt32(p) for p in position]
    local = [p - mi.Float(c) for p, c in zip(position, cell, strict=True)]
    fade = [t * t * t * (t * (t * 6 - 15) + 10) for t in local]
    values = {}
    for steps in product((0, 1), repeat=3):
        bits = _hash([c + step for c, step in zip(cell, steps, strict=True)], seed)
        gradient = [mi.Float((bits >> shift) & 1023) / 511.5 - 1 for shift in (0, 10, 20)]
        d = [t - step for t, step in zip(local, steps, strict=True)]
        values[steps] = gradient[0] * d[0] + gradient[1] * d[1] + gradient[2] * d[2]
    rows = [dr.lerp(values[0, y, z], values[1, y, z], fade[0]) for z in (0, 1) for y in (0, 1)]
    return dr.lerp(dr.lerp(rows[0], rows[1], fade[1]), dr.lerp(rows[2], rows[3], fade[1]), fade[2])
