"""Environment light, and the irradiance of every vertex with diffuse interreflection.

Irradiance is computed by Monte Carlo over cosine-distributed rays that see the sky or the radiosity of a surface from
the previous bounce. Only the last bounce needs many rays, because it averages over the noise of the earlier ones: final
gathering [Jensen 2001].
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Float

from registration.render.studio.scene import StudioScene

BOUNCE_RAYS = 24  # per vertex, in all bounces but the last
BOUNCES = 3
_BATCH_RAYS = 1 << 20  # about 200 MB
_OFFSET_M = 2e-5  # of the rays' origins above their surface


@dataclass(frozen=True, kw_only=True)
class Sky:
    """An environment whose radiance increases linearly along one direction of the world."""

    brightness: float = 0.9  # mean radiance; a white surface under a uniform sky of 1 has radiance 1
    contrast: float = 0.75  # the brightest radiance is (1 + contrast) times the mean, the darkest (1 - contrast)
    towards: tuple[float, float, float] = (0.35, 0.75, 0.55)  # of the brightest point, world; any length
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def radiance(self, directions: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3"]:
        """Return the radiance seen along unit directions (world)."""
        towards = np.array(self.towards) / np.linalg.norm(self.towards)
        return (self.brightness * (1 + self.contrast * (directions @ towards)))[..., None] * np.array(self.tint)

    def radiance_on_device(self, direction: mi.Vector3f) -> mi.Color3f:
        """`radiance` on the device."""
        x, y, z = (np.array(self.towards) / np.linalg.norm(self.towards)).tolist()
        level = self.brightness * (1 + self.contrast * (x * direction.x + y * direction.y + z * direction.z))
        return mi.Color3f(*(level * channel for channel in self.tint))


def bake_light(scene: StudioScene, sky: Sky, *, rays: int = 160, seed: int = 0) -> Float[np.ndarray, "V 3"]:
    """Compute the irradiance of every vertex, divided by pi: times albedo, it is the surface's radiance.

    Args:
        scene: the surfaces.
        sky: the environment.
        rays: per vertex, in the last bounce.
        seed: of the rays' random rotation per vertex.

    Returns:
        Linear RGB.
    """
    albedo = scene.vertex_albedo()
    shifts = np.random.default_rng([seed, 2]).random((len(scene.vertices), 2), np.float32)
    light = np.zeros_like(albedo)
    for bounce in range(BOUNCES + 1):
        count = rays if bounce == BOUNCES else BOUNCE_RAYS
        light = _gather(scene, sky, mi.Float((albedo * light).astype(np.float32).ravel()), count, shifts)
    return light


def _gather(
    scene: StudioScene, sky: Sky, radiosity: mi.Float, rays: int, shifts: Float[np.ndarray, "V 2"]
) -> Float[np.ndarray, "V 3"]:
    """Return the mean radiance along each vertex's cosine-distributed rays."""
    result = np.empty((len(scene.vertices), 3))
    step = max(1, _BATCH_RAYS // rays)
    u, v = _hammersley(rays)
    for first in range(0, len(result), step):
        # All batches have the same size, so that one kernel serves them.
        rows = np.minimum(np.arange(first, first + step), len(result) - 1)
        lane = dr.arange(mi.UInt32, step * rays)
        vertex, ray = lane // dr.opaque(mi.UInt32, rays), lane % dr.opaque(mi.UInt32, rays)
        position = dr.gather(mi.Point3f, mi.Float(scene.vertices[rows].ravel()), vertex)
        normal = dr.gather(mi.Vector3f, mi.Float(scene.normals[rows].ravel()), vertex)
        shift = dr.gather(mi.Point2f, mi.Float(shifts[rows].ravel()), vertex)
        x, y = dr.gather(mi.Float, u, ray) + shift.x, dr.gather(mi.Float, v, ray) + shift.y
        local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(x - dr.floor(x), y - dr.floor(y)))
        direction = mi.Frame3f(normal).to_world(local)
        hit = scene.cast_rays(
            position + normal * _OFFSET_M, direction, mi.Bool(True), transparent=False, coherent=False
        )
        lit = dr.select(hit.back_face, mi.Color3f(0), scene.interpolate(radiosity, hit))
        colour = dr.select(hit.valid, lit, sky.radiance_on_device(direction))
        means = [np.array(dr.block_reduce(dr.ReduceOp.Add, channel, rays)) / rays for channel in colour]
        kept = min(step, len(result) - first)
        result[first : first + kept] = np.stack(means, 1)[:kept]
    return result


def _hammersley(count: int) -> tuple[mi.Float, mi.Float]:
    """Return the Hammersley set, a low-discrepancy set of points in the unit square."""
    index = np.arange(count, dtype=np.uint32)
    reversed_bits = np.zeros(count, np.uint64)
    for bit in range(32):
        reversed_bits |= ((index.astype(np.uint64) >> bit) & 1) << (31 - bit)
    return mi.Float(((index + 0.5) / count).astype(np.float32)), mi.Float((reversed_bits / 2**32).astype(np.float32))
