"""Soft light: a bright sky all around, and the irradiance that it and the surfaces give to every vertex.

Irradiance is gathered as in path tracing with diffuse surfaces: cosine-distributed rays see the sky or a surface's
radiosity, which comes from the last gathering. Few rays will do but for the last one, because every gathering averages
over the noise of the one before (final gathering, Jensen 2001, section 8).
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float

from registration.render.studio.scene import StudioScene

BOUNCE_RAYS = 24  # a vertex, for the light that reaches it over two and more surfaces
BOUNCES = 3
_LANES = 1 << 20  # rays at a time: about 200 MB
_OFFSET_M = 2e-5  # rays start this far above their surface


@dataclass(frozen=True, kw_only=True)
class Sky:
    """An environment whose radiance grows linearly along one direction of the world."""

    brightness: float = 0.9  # mean radiance; a white surface under an even sky of 1 is 1
    contrast: float = 0.75  # the brightest radiance is (1 + contrast) times the mean, the darkest (1 - contrast)
    towards: tuple[float, float, float] = (0.35, 0.75, 0.55)  # of the brightest point, world; any length
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def radiance(self, directions: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Of unit directions from the scene to the sky."""
        towards = np.array(self.towards) / np.linalg.norm(self.towards)
        return (self.brightness * (1 + self.contrast * (directions @ towards)))[..., None] * np.array(self.tint)

    def seen(self, direction: mi.Vector3f) -> mi.Color3f:
        """`radiance` on the device."""
        x, y, z = (np.array(self.towards) / np.linalg.norm(self.towards)).tolist()
        share = self.brightness * (1 + self.contrast * (x * direction.x + y * direction.y + z * direction.z))
        return mi.Color3f(*(share * channel for channel in self.tint))


def bake(scene: StudioScene, sky: Sky, *, rays: int = 160, seed: int = 0) -> Float[np.ndarray, "V 3"]:
    """Irradiance over pi of every vertex, linear RGB: times albedo it is the radiance that the surface sends out."""
    albedo = scene.vertex_albedo()
    turns = np.random.default_rng([seed, 2]).random((len(scene.vertices), 2), np.float32)
    light = np.zeros_like(albedo)
    for bounce in range(BOUNCES + 1):
        count = rays if bounce == BOUNCES else BOUNCE_RAYS
        light = _gather(scene, sky, mi.Float((albedo * light).astype(np.float32).ravel()), count, turns)
    return light


def _gather(
    scene: StudioScene, sky: Sky, radiosity: mi.Float, rays: int, turns: Float[np.ndarray, "V 2"]
) -> Float[np.ndarray, "V 3"]:
    """The mean radiance that the cosine-distributed rays of each vertex meet."""
    result = np.empty((len(scene.vertices), 3))
    step = max(1, _LANES // rays)
    u, v = _hammersley(rays)
    for first in range(0, len(result), step):
        # Always as many vertices: one kernel serves all batches.
        rows = np.minimum(np.arange(first, first + step), len(result) - 1)
        lane = dr.arange(mi.UInt32, step * rays)
        vertex, ray = lane // dr.opaque(mi.UInt32, rays), lane % dr.opaque(mi.UInt32, rays)
        position = dr.gather(mi.Point3f, mi.Float(scene.vertices[rows].ravel()), vertex)
        normal = dr.gather(mi.Vector3f, mi.Float(scene.normals[rows].ravel()), vertex)
        turn = dr.gather(mi.Point2f, mi.Float(turns[rows].ravel()), vertex)
        x, y = dr.gather(mi.Float, u, ray) + turn.x, dr.gather(mi.Float, v, ray) + turn.y
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x - dr.floor(x), y - dr.floor(y)))
        direction = mi.Frame3f(normal).to_world(local)
        hit = scene.cast(position + normal * _OFFSET_M, direction, mi.Bool(True), clear=True, coherent=False)
        lit = dr.select(hit.behind, mi.Color3f(0), scene.at_corners(radiosity, hit))
        colour = dr.select(hit.valid, lit, sky.seen(direction))
        means = [np.array(dr.block_reduce(dr.ReduceOp.Add, channel, rays)) / rays for channel in colour]
        kept = min(step, len(result) - first)
        result[first : first + kept] = np.stack(means, 1)[:kept]
    return result


def _hammersley(count: int) -> tuple[mi.Float, mi.Float]:
    """An evenly spread set of points in the unit square."""
    index = np.arange(count, dtype=np.uint32)
    reversed_bits = np.zeros(count, np.uint64)
    for bit in range(32):
        reversed_bits |= ((index.astype(np.uint64) >> bit) & 1) << (31 - bit)
    return mi.Float(((index + 0.5) / count).astype(np.float32)), mi.Float((reversed_bits / 2**32).astype(np.float32))
