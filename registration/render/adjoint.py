"""The way back from pixels to vertices and texels: the adjoint image, and sums over lanes."""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
from torch import Tensor

from registration.render.shading import GROUPS, MASK, Surface

_SAMPLED = 1 << 12  # values of a tensor tell how large it is
_UNIT = 2.0**-22  # of a sum, in the largest adjoint sampled (per metre): integers below count such units
_MOST = 2.0**42  # units of one lane: a million such lanes still fit


@dataclass(frozen=True, kw_only=True)
class Adjoint:
    """dLoss / d(channel) of every pixel, by groups of channels; None where the loss does not look."""

    groups: list[mi.Float | None]  # in the order of GROUPS, each (P D) flat
    widths: list[int]
    unit: mi.Float  # see `RowSum`

    @classmethod
    def of(cls, gradients: Sequence[Tensor | None], surface: Surface) -> Adjoint:
        """From what torch hands back; without a texture the colour is left out."""
        known = [None if g is None else g.detach().contiguous().reshape(-1) for g in gradients]
        if surface.texture is None:
            known[0] = None
        return cls(
            groups=[None if g is None else mi.Float(g) for g in known],
            widths=[3, 3, 1, surface.class_count],
            unit=unit_of([g for g in known if g is not None]),
        )

    @property
    def moves_inside(self) -> bool:
        """Whether the loss looks at anything that varies inside a face: the mask does not."""
        return any(g is not None and group.start != MASK for g, group in zip(self.groups, GROUPS, strict=True))

    def colour(self, pixel: mi.UInt32) -> mi.Vector3f | None:
        """Of the lanes' pixels, as the next two."""
        return None if self.groups[0] is None else dr.gather(mi.Vector3f, self.groups[0], pixel)

    def normal(self, pixel: mi.UInt32) -> mi.Vector3f | None:
        return None if self.groups[1] is None else dr.gather(mi.Vector3f, self.groups[1], pixel)

    def classes(self, pixel: mi.UInt32) -> mi.ArrayXf | None:
        return None if self.groups[3] is None else self._group(3, pixel)

    def _group(self, number: int, pixel: mi.UInt32) -> mi.ArrayXf:
        shape = (self.widths[number], dr.width(pixel))
        return dr.gather(mi.ArrayXf, self.groups[number], pixel, shape=shape)

    def times(self, channels: Sequence[mi.Float], pixel: mi.UInt32) -> mi.Float:
        """Sum over the channels of adjoint times value, in the lanes' pixels."""
        total = mi.Float(0)
        for number, group in enumerate(GROUPS):
            if self.groups[number] is not None:
                for g, value in zip(self._group(number, pixel), channels[group], strict=True):
                    total += g * value
        return total


def unit_of(values: Sequence[Tensor]) -> mi.Float:
    """A unit for `RowSum` that suits values (and what is alike)."""
    scale = max((_size(v[:: 1 + len(v) // _SAMPLED]) for v in values), default=0.0)
    if scale == 0:
        scale = max((_size(v) for v in values), default=0.0)
    return dr.opaque(mi.Float, max(scale, 1e-30) * _UNIT)


def _size(values: Tensor) -> float:
    return values.abs().max().item() if values.numel() else 0.0


class RowSum:
    """Sums of lanes' vectors into rows of a table, of four or eight columns.

    With a unit they are summed in fixed point: parallel sums of floats would differ from run to run.
    """

    def __init__(self, rows: int, unit: mi.Float | None = None, columns: int = 4):
        self._unit, self._columns = unit, columns
        number = mi.Float if unit is None else mi.Int64
        self._packet = mi.ArrayXf if unit is None else dr.int64_array_t(mi.ArrayXf)
        self.total = dr.zeros(number, columns * rows)
        # On the CPU every thread sums apart.
        self._mode = dr.ReduceMode.Expand if "llvm" in mi.variant() else dr.ReduceMode.Auto

    def add(self, row: mi.UInt32, value: Iterable[mi.Float]) -> None:
        """Up to eight numbers, if there are so many columns; those of three or four go to the first columns."""
        values = list(value)
        if self._unit is not None:
            per_unit = dr.rcp(self._unit)
            values = [mi.Int64(dr.clip(v * per_unit, -_MOST, _MOST)) for v in values]
        packet = 4 if len(values) <= 4 else 8
        values += [type(values[0])(0)] * (packet - len(values))
        dr.scatter_add(self.total, self._packet(values), row * (self._columns // packet), mode=self._mode)

    def table(self) -> mi.Float:
        """Flat, row by row."""
        return self.total if self._unit is None else mi.Float(mi.Float64(self.total) * mi.Float64(self._unit))
