"""Lit images of surfaces by cameras with lenses and sensors, with their masks, normals, labels and landmarks.

Light is baked to vertices once (`light.py`); an image is texture times light, averaged over jittered rays.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from jaxtyping import Bool, Float, UInt8

from registration.capture.native_writer import ViewArrays
from registration.render.studio.light import Sky, bake_light
from registration.render.studio.scene import Hit, StudioScene, StudioSurface, subdivide
from registration.types import Camera

HIDDEN_CONFIDENCE = 0.2  # of a landmark that is occluded or outside the image
LANDMARK_TOLERANCE_M = 2e-3  # surfaces closer than this in front of a landmark do not occlude it
_STRIP_PX = 1 << 19  # pixels rendered at a time
_UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-10)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Noise and variation of real cameras. Spreads are relative standard deviations over the cameras."""

    shot_noise: float = 0.0  # standard deviation at linear 1; proportional to the square root of the radiance
    read_noise: float = 0.0  # standard deviation in the dark
    exposure_spread: float = 0.0
    colour_spread: float = 0.0  # of the channels' gains


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Sampling of pixels and of light."""

    pixel_samples: int = 3  # rays per pixel: the square of this
    light_rays: int = 160  # per vertex
    subdivisions: int = 1  # of the surfaces, for the resolution of the light


def render_views(
    surfaces: Sequence[StudioSurface],
    cameras: Sequence[Camera],
    *,
    sky: Sky | None = None,
    sensor: Sensor | None = None,
    quality: Quality | None = None,
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]] | None = None,
    background: tuple[float, float, float] = (0.2, 0.2, 0.2),
    seed: int = 0,
) -> list[ViewArrays]:
    """Render images, masks, normals, labels and landmarks of every camera. A Mitsuba variant must be active.

    Args:
        surfaces: what is rendered.
        cameras: with or without lens distortion.
        sky: the environment light.
        sensor: noise and differences of exposure.
        quality: sampling of pixels and light.
        landmarks: points by scheme, world, metres.
        background: linear RGB.
        seed: of light rays, pixel samples and noise; equal seeds give equal images.

    Returns:
        Views `cam00`, `cam01` ... in the cameras' distorted pixels. RGB is linear; the mask is the surfaces' coverage
        of a pixel; normals (camera frame) and labels (1 + class, 0 for the background) are those at the pixel's centre.
        Landmarks have confidence 1 where they are visible, else `HIDDEN_CONFIDENCE`.
    """
    sky, sensor, quality = sky or Sky(), sensor or Sensor(), quality or Quality()
    for _ in range(quality.subdivisions):
        surfaces = [subdivide(surface) for surface in surfaces]
    scene = StudioScene(surfaces)
    light = mi.Float(bake_light(scene, sky, rays=quality.light_rays, seed=seed).astype(np.float32).ravel())
    views = []
    for number, camera in enumerate(cameras):
        rng = np.random.default_rng([seed, 3, number])
        layers = _render_view(scene, light, camera, background, quality.pixel_samples, seed * len(cameras) + number)
        views.append(
            ViewArrays(
                name=f"cam{number:02d}",
                camera=camera,
                rgb=_apply_sensor(layers.rgb, sensor, rng),
                mask=layers.mask,
                normals=layers.normals,
                labels=layers.labels,
                landmarks={name: landmark_pixels(scene, camera, points) for name, points in (landmarks or {}).items()},
            )
        )
    return views


def distorted_pixels(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    """Project world points (m) to pixels with lens distortion."""
    rotation, translation = cv2.Rodrigues(camera.T_cam_world[:3, :3])[0], camera.T_cam_world[:3, 3]
    # K and the result use the same pixel convention, so that OpenCV's does not matter.
    lens = np.array(camera.distortion or (0.0,) * 4)
    return cv2.projectPoints(np.asarray(points, np.float64), rotation, translation, camera.intrinsics, lens)[0][:, 0]


def landmark_pixels(scene: StudioScene, camera: Camera, points: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3"]:
    """Return x_px, y_px (distorted) and confidence of world points (m)."""
    xy = distorted_pixels(camera, points)
    inside = (xy >= 0).all(1) & (xy <= (camera.width_px, camera.height_px)).all(1)
    return np.column_stack([xy, np.where(inside & visible(scene, camera, points), 1.0, HIDDEN_CONFIDENCE)])


def visible(
    scene: StudioScene, camera: Camera, points: Float[np.ndarray, "P 3"], tolerance_m: float = LANDMARK_TOLERANCE_M
) -> Bool[np.ndarray, "P"]:
    """Return whether no surface occludes points (world, m), whether they are inside the image or not.

    Args:
        scene: the surfaces.
        camera: the view.
        points: metres, world.
        tolerance_m: surfaces closer than this in front of a point do not occlude it.
    """
    rays = points - camera.centre
    distance = np.linalg.norm(rays, axis=1)
    origin = mi.Point3f(*(float(value) for value in camera.centre))
    direction = mi.Vector3f(*(mi.Float((rays[:, k] / distance).astype(np.float32)) for k in range(3)))
    hit = scene.cast_rays(origin, direction, mi.Bool(True), transparent=True)
    nearest = np.array(dr.select(hit.valid, hit.distance, np.inf))
    in_front = (points @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]) > 0
    return in_front & (nearest > distance - tolerance_m)


@dataclass(frozen=True, kw_only=True)
class _Layers:
    rgb: Float[np.ndarray, "H W 3"]
    mask: Float[np.ndarray, "H W"]
    normals: Float[np.ndarray, "H W 3"]
    labels: UInt8[np.ndarray, "H W"]


def _render_view(
    scene: StudioScene,
    light: mi.Float,
    camera: Camera,
    background: tuple[float, float, float],
    side: int,
    seed: int,
) -> _Layers:
    width, height = camera.width_px, camera.height_px
    rgb = np.empty((height, width, 3), np.float32)
    rgb[:] = background
    layers = _Layers(
        rgb=rgb,
        mask=np.zeros((height, width), np.float32),
        normals=np.zeros((height, width, 3), np.float32),
        labels=np.zeros((height, width), np.uint8),
    )
    columns, rows = _bounding_box(scene, camera)
    step = max(1, _STRIP_PX // max(1, columns.stop - columns.start))
    for top in range(rows.start, rows.stop, step):
        part = (slice(top, min(top + step, rows.stop)), columns)
        rays = _Rays(camera, part)
        normals, labels = _render_geometry(scene, rays, camera)
        colour, mask = _render_colour(scene, light, rays, background, side, seed)
        layers.rgb[part], layers.mask[part] = colour, mask
        layers.normals[part], layers.labels[part] = normals, labels
    return layers


def _bounding_box(scene: StudioScene, camera: Camera) -> tuple[slice, slice]:
    """Return columns and rows outside which the image is empty."""
    depth = scene.vertices @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    if depth.min() < 1e-3:
        return slice(0, camera.width_px), slice(0, camera.height_px)
    xy = distorted_pixels(camera, scene.vertices)
    limits = (camera.width_px, camera.height_px)
    low = np.clip(np.floor(xy.min(0)) - 1, 0, limits).astype(int)
    high = np.clip(np.ceil(xy.max(0)) + 1, 0, limits).astype(int)
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))


class _Rays:
    """The rays of a block of pixels. The lens is inverted at the pixels' corners and interpolated between them."""

    def __init__(self, camera: Camera, part: tuple[slice, slice]):
        rows, columns = part
        self.shape = rows.stop - rows.start, columns.stop - columns.start
        x, y = np.meshgrid(np.arange(columns.start, columns.stop + 1.0), np.arange(rows.start, rows.stop + 1.0))
        corners = np.stack([x.ravel(), y.ravel()], 1)
        lens = np.array(camera.distortion or (0.0,) * 4)
        plane = cv2.undistortPoints(corners[:, None], camera.intrinsics, lens, criteria=_UNDISTORTION)
        self._plane = mi.Float(plane.astype(np.float32).ravel())
        self.origin = mi.Point3f(*(float(value) for value in camera.centre))
        self._axes = [[dr.opaque(mi.Float, float(value)) for value in row] for row in camera.T_cam_world[:3, :3]]
        lane = dr.arange(mi.UInt32, self.shape[0] * self.shape[1])
        across = dr.opaque(mi.UInt32, self.shape[1])
        row, column = lane // across, lane % across
        self.pixel = (row + rows.start) * camera.width_px + column + columns.start
        self._corner = row * (across + 1) + column
        self._below = across + 1
        dr.eval(self.pixel, self._corner)

    def directions(self, x: mi.Float, y: mi.Float) -> mi.Vector3f:
        """Return unit world directions through a position in each pixel, x and y in [0, 1]."""
        corner = [
            dr.gather(mi.Point2f, self._plane, self._corner + step)
            for step in (mi.UInt32(0), mi.UInt32(1), self._below, self._below + 1)
        ]
        p = dr.lerp(dr.lerp(corner[0], corner[1], x), dr.lerp(corner[2], corner[3], x), y)
        r = self._axes
        return dr.normalize(mi.Vector3f(*(r[0][k] * p.x + r[1][k] * p.y + r[2][k] for k in range(3))))


def _render_geometry(
    scene: StudioScene, rays: _Rays, camera: Camera
) -> tuple[Float[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Return normals (camera frame) and labels at the pixels' centres."""
    active = mi.Bool(True)
    hit = scene.cast_rays(rays.origin, rays.directions(mi.Float(0.5), mi.Float(0.5)), active, transparent=True)
    # About one ray in 10,000 passes between two adjacent faces; a neighbouring ray does not.
    neighbour = scene.cast_rays(
        rays.origin, rays.directions(mi.Float(0.503), mi.Float(0.498)), active, transparent=True
    )
    missed = neighbour.valid & ~neighbour.back_face & (~hit.valid | hit.back_face)
    hit = _select(missed, neighbour, hit)
    normal, label = scene.normal(hit) & hit.valid, scene.label(hit)
    dr.eval(normal, label)
    world = np.array(normal).T.astype(np.float64)
    return (
        (world @ camera.T_cam_world[:3, :3].T).reshape(*rays.shape, 3).astype(np.float32),
        np.array(label).reshape(rays.shape).astype(np.uint8),
    )


def _render_colour(
    scene: StudioScene,
    light: mi.Float,
    rays: _Rays,
    background: tuple[float, float, float],
    side: int,
    seed: int,
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Return mean radiance and coverage of `side` x `side` jittered rays per pixel, one in each cell of a grid."""
    total, covered = mi.Color3f(0), mi.Float(0)
    for cell in range(side * side):
        salt = dr.opaque(mi.UInt32, (seed * side * side + cell) & 0xFFFFFFFF)
        jitter_x = mi.sample_tea_float32(rays.pixel, salt, 4)
        jitter_y = mi.sample_tea_float32(rays.pixel ^ 0x9E3779B9, salt, 4)
        left, top = (dr.opaque(mi.Float, float(value)) for value in (cell % side, cell // side))
        direction = rays.directions((left + jitter_x) / side, (top + jitter_y) / side)
        hit = scene.cast_rays(rays.origin, direction, mi.Bool(True), transparent=True)
        covered += dr.select(hit.valid, mi.Float(1), 0)
        if scene.has_transparent:
            through = hit.valid & (hit.face >= scene.opaque_count)
            hit = _select(through, scene.cast_rays(rays.origin, direction, through, transparent=False), hit)
        lit = dr.select(hit.back_face, mi.Color3f(0), scene.albedo(hit) * scene.interpolate(light, hit))
        total += dr.select(hit.valid, lit, mi.Color3f(*background))
        dr.eval(total, covered)
    count = side * side
    return np.array(total).T.reshape(*rays.shape, 3) / count, np.array(covered).reshape(rays.shape) / count


def _select(condition: mi.Bool, a: Hit, b: Hit) -> Hit:
    """Return, lane by lane, `a` where the condition holds, else `b`."""
    return Hit(
        valid=dr.select(condition, a.valid, b.valid),
        face=dr.select(condition, a.face, b.face),
        corners=dr.select(condition, a.corners, b.corners),
        weights=[dr.select(condition, u, v) for u, v in zip(a.weights, b.weights, strict=True)],
        back_face=dr.select(condition, a.back_face, b.back_face),
        distance=dr.select(condition, a.distance, b.distance),
    )


def _apply_sensor(
    rgb: Float[np.ndarray, "H W 3"], sensor: Sensor, rng: np.random.Generator
) -> Float[np.ndarray, "H W 3"]:
    """Return the radiance with a random exposure, channel gains and noise."""
    gain = (1 + sensor.exposure_spread * rng.standard_normal()) * (1 + sensor.colour_spread * rng.standard_normal(3))
    rgb = rgb * np.clip(gain, 0.2, 5).astype(np.float32)
    if sensor.shot_noise or sensor.read_noise:
        deviation = np.sqrt(sensor.shot_noise**2 * np.maximum(rgb, 0) + sensor.read_noise**2)
        rgb = rgb + deviation * rng.standard_normal(rgb.shape, np.float32)
    return np.maximum(rgb, 0).astype(np.float32)
