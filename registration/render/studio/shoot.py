"""The photographer: lit pictures of surfaces by cameras with lenses and sensors, and what a lab extracts from them.

Light is baked to vertices once (`light.py`); a picture is then texture times light, averaged over jittered rays.
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
from registration.render.studio.light import Sky, bake
from registration.render.studio.scene import Hit, StudioScene, StudioSurface, subdivided
from registration.types import Camera

HIDDEN = 0.2  # confidence of a landmark that something hides, or that is outside the image
LANDMARK_TOLERANCE_M = 2e-3  # what lies less than this before a landmark does not hide it
_STRIP_PX = 1 << 19  # drawn at a time
_UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-10)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """What real cameras add. Spreads are standard deviations over the cameras, as a share."""

    shot_noise: float = 0.0  # standard deviation at linear 1; grows with the root of the light
    read_noise: float = 0.0  # standard deviation in the dark
    exposure_spread: float = 0.0
    colour_spread: float = 0.0  # of the channels' gains


@dataclass(frozen=True, kw_only=True)
class Quality:
    """What a picture may cost."""

    pixel_samples: int = 3  # rays along each side of a pixel
    light_rays: int = 160  # a vertex
    subdivisions: int = 1  # of the surfaces, for the light that their vertices carry


def shoot(
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
    """Pictures, masks, normals, labels and landmarks of every camera, in their distorted pixels; `cam00`, `cam01` ...

    RGB is linear; the mask is the surfaces' share of a pixel; normals (camera frame) and labels (1 + class, 0 for the
    background) are those at a pixel's centre. `landmarks` are points (world, m) by scheme: a point has confidence 1
    where nothing hides it, else HIDDEN. A Mitsuba variant must be active; equal seeds give equal pictures.
    """
    sky, sensor, quality = sky or Sky(), sensor or Sensor(), quality or Quality()
    for _ in range(quality.subdivisions):
        surfaces = [subdivided(surface) for surface in surfaces]
    scene = StudioScene(surfaces)
    light = mi.Float(bake(scene, sky, rays=quality.light_rays, seed=seed).astype(np.float32).ravel())
    views = []
    for number, camera in enumerate(cameras):
        rng = np.random.default_rng([seed, 3, number])
        picture = _draw(scene, light, camera, background, quality.pixel_samples, seed * len(cameras) + number)
        views.append(
            ViewArrays(
                name=f"cam{number:02d}",
                camera=camera,
                rgb=_expose(picture.rgb, sensor, rng),
                mask=picture.mask,
                normals=picture.normals,
                labels=picture.labels,
                landmarks={name: landmark_pixels(scene, camera, points) for name, points in (landmarks or {}).items()},
            )
        )
    return views


def distorted_pixels(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
    """World points (m) to pixels with the lens' distortion."""
    rotation, place = cv2.Rodrigues(camera.T_cam_world[:3, :3])[0], camera.T_cam_world[:3, 3]
    # Points and K share one pixel convention here, so OpenCV's own does not enter.
    lens = np.array(camera.distortion or (0.0,) * 4)
    return cv2.projectPoints(np.asarray(points, np.float64), rotation, place, camera.intrinsics, lens)[0][:, 0]


def landmark_pixels(scene: StudioScene, camera: Camera, points: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3"]:
    """x_px, y_px (distorted) and confidence of world points (m)."""
    xy = distorted_pixels(camera, points)
    inside = (xy >= 0).all(1) & (xy <= (camera.width_px, camera.height_px)).all(1)
    return np.column_stack([xy, np.where(inside & seen(scene, camera, points), 1.0, HIDDEN)])


def seen(
    scene: StudioScene, camera: Camera, points: Float[np.ndarray, "P 3"], tolerance_m: float = LANDMARK_TOLERANCE_M
) -> Bool[np.ndarray, "P"]:
    """Whether no surface is between the camera and a point, but for the last `tolerance_m`; the image has no edge."""
    away = points - camera.centre
    distance = np.linalg.norm(away, axis=1)
    origin = mi.Point3f(*(float(value) for value in camera.centre))
    direction = mi.Vector3f(*(mi.Float((away[:, k] / distance).astype(np.float32)) for k in range(3)))
    hit = scene.cast(origin, direction, mi.Bool(True), clear=False)
    nearest = np.array(dr.select(hit.valid, hit.distance, np.inf))
    in_front = (points @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]) > 0
    return in_front & (nearest > distance - tolerance_m)


@dataclass(frozen=True, kw_only=True)
class _Picture:
    rgb: Float[np.ndarray, "H W 3"]
    mask: Float[np.ndarray, "H W"]
    normals: Float[np.ndarray, "H W 3"]
    labels: UInt8[np.ndarray, "H W"]


def _draw(
    scene: StudioScene,
    light: mi.Float,
    camera: Camera,
    background: tuple[float, float, float],
    side: int,
    seed: int,
) -> _Picture:
    width, height = camera.width_px, camera.height_px
    rgb = np.empty((height, width, 3), np.float32)
    rgb[:] = background
    picture = _Picture(
        rgb=rgb,
        mask=np.zeros((height, width), np.float32),
        normals=np.zeros((height, width, 3), np.float32),
        labels=np.zeros((height, width), np.uint8),
    )
    columns, rows = _window(scene, camera)
    step = max(1, _STRIP_PX // max(1, columns.stop - columns.start))
    for top in range(rows.start, rows.stop, step):
        part = (slice(top, min(top + step, rows.stop)), columns)
        rays = _Rays(camera, part)
        normals, labels = _extract(scene, rays, camera)
        colour, mask = _colour(scene, light, rays, background, side, seed)
        picture.rgb[part], picture.mask[part] = colour, mask
        picture.normals[part], picture.labels[part] = normals, labels
    return picture


def _window(scene: StudioScene, camera: Camera) -> tuple[slice, slice]:
    """Columns and rows outside which nothing can be seen."""
    depth = scene.vertices @ camera.T_cam_world[2, :3] + camera.T_cam_world[2, 3]
    if depth.min() < 1e-3:
        return slice(0, camera.width_px), slice(0, camera.height_px)
    xy = distorted_pixels(camera, scene.vertices)
    limits = (camera.width_px, camera.height_px)
    low = np.clip(np.floor(xy.min(0)) - 1, 0, limits).astype(int)
    high = np.clip(np.ceil(xy.max(0)) + 1, 0, limits).astype(int)
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))


class _Rays:
    """The rays of some pixels. The lens is inverted at the pixels' corners, between which it is as good as linear."""

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

    def towards(self, x: mi.Float, y: mi.Float) -> mi.Vector3f:
        """World directions through a place of each pixel; unit."""
        corner = [
            dr.gather(mi.Point2f, self._plane, self._corner + step)
            for step in (mi.UInt32(0), mi.UInt32(1), self._below, self._below + 1)
        ]
        p = dr.lerp(dr.lerp(corner[0], corner[1], x), dr.lerp(corner[2], corner[3], x), y)
        r = self._axes
        return dr.normalize(mi.Vector3f(*(r[0][k] * p.x + r[1][k] * p.y + r[2][k] for k in range(3))))


def _extract(
    scene: StudioScene, rays: _Rays, camera: Camera
) -> tuple[Float[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Normals (camera frame) and labels at the pixels' centres."""
    hit = scene.cast(rays.origin, rays.towards(mi.Float(0.5), mi.Float(0.5)), mi.Bool(True), clear=False)
    # One ray in some 10,000 slips between two faces: one beside it does not.
    beside = scene.cast(rays.origin, rays.towards(mi.Float(0.503), mi.Float(0.498)), mi.Bool(True), clear=False)
    slipped = beside.valid & ~beside.behind & (~hit.valid | hit.behind)
    hit = _either(slipped, beside, hit)
    normal, label = scene.normal(hit) & hit.valid, scene.label(hit)
    dr.eval(normal, label)
    world = np.array(normal).T.astype(np.float64)
    return (
        (world @ camera.T_cam_world[:3, :3].T).reshape(*rays.shape, 3).astype(np.float32),
        np.array(label).reshape(rays.shape).astype(np.uint8),
    )


def _colour(
    scene: StudioScene,
    light: mi.Float,
    rays: _Rays,
    background: tuple[float, float, float],
    side: int,
    seed: int,
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Mean radiance and coverage of `side` x `side` jittered rays a pixel, one in each cell."""
    total, covered = mi.Color3f(0), mi.Float(0)
    for cell in range(side * side):
        salt = dr.opaque(mi.UInt32, (seed * side * side + cell) & 0xFFFFFFFF)
        jitter_x = mi.sample_tea_float32(rays.pixel, salt, 4)
        jitter_y = mi.sample_tea_float32(rays.pixel ^ 0x9E3779B9, salt, 4)
        left, top = (dr.opaque(mi.Float, float(value)) for value in (cell % side, cell // side))
        direction = rays.towards((left + jitter_x) / side, (top + jitter_y) / side)
        hit = scene.cast(rays.origin, direction, mi.Bool(True), clear=False)
        covered += dr.select(hit.valid, mi.Float(1), 0)
        if scene.has_clear:
            through = hit.valid & (hit.face >= scene.open_count)
            hit = _either(through, scene.cast(rays.origin, direction, through, clear=True), hit)
        lit = dr.select(hit.behind, mi.Color3f(0), scene.albedo(hit) * scene.at_corners(light, hit))
        total += dr.select(hit.valid, lit, mi.Color3f(*background))
        dr.eval(total, covered)
    count = side * side
    return np.array(total).T.reshape(*rays.shape, 3) / count, np.array(covered).reshape(rays.shape) / count


def _either(first: mi.Bool, a: Hit, b: Hit) -> Hit:
    """Lane by lane `a` where `first`, else `b`."""
    return Hit(
        valid=dr.select(first, a.valid, b.valid),
        face=dr.select(first, a.face, b.face),
        corners=dr.select(first, a.corners, b.corners),
        weights=[dr.select(first, u, v) for u, v in zip(a.weights, b.weights, strict=True)],
        behind=dr.select(first, a.behind, b.behind),
        distance=dr.select(first, a.distance, b.distance),
    )


def _expose(rgb: Float[np.ndarray, "H W 3"], sensor: Sensor, rng: np.random.Generator) -> Float[np.ndarray, "H W 3"]:
    """The radiance as a sensor of its own exposure and gains reports it."""
    gain = (1 + sensor.exposure_spread * rng.standard_normal()) * (1 + sensor.colour_spread * rng.standard_normal(3))
    rgb = rgb * np.clip(gain, 0.2, 5).astype(np.float32)
    if sensor.shot_noise or sensor.read_noise:
        deviation = np.sqrt(sensor.shot_noise**2 * np.maximum(rgb, 0) + sensor.read_noise**2)
        rgb = rgb + deviation * rng.standard_normal(rgb.shape, np.float32)
    return np.maximum(rgb, 0).astype(np.float32)
