"""A synthetic capture: the vertices of one head, photographed in the studio, as a native capture folder.

Everything in the folder comes from the mesh: what a registration of it gives can be compared with what was put in.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from coregister.synthetic.hair_and_shirt import HAIR_M, hair, shirt
from registration.capture import native_writer
from registration.capture.scan import Scan
from registration.errors import InputError
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import CLASSES, exterior, group, neck_other, vertex_classes
from registration.render import backend
from registration.render.studio.canvas import Canvas, canvas
from registration.render.studio.eyes import corneas
from registration.render.studio.light import Sky
from registration.render.studio.rig import SPREAD_DEG, rig
from registration.render.studio.rig import check as check_rig
from registration.render.studio.scene import StudioScene, StudioSurface, subdivided
from registration.render.studio.shoot import Quality, Sensor, distorted_pixels, seen, shoot
from registration.render.studio.skin import Look, paint
from registration.types import Camera

NECK, HAIR, CLOTHES = "neck_other", "hair", "clothes"
WORN = (HAIR, CLOTHES)
LABELS = ("background", *CLASSES, NECK, *WORN)  # of the captures' label maps, in index order
MOST_PIXELS = 1 << 28  # of all images together: 8 GB while they are drawn
_SEEN_TOLERANCE_M = 1e-4


@dataclass(frozen=True, kw_only=True)
class Studio:
    """How a head is photographed. Equal studios give equal captures."""

    cameras: int = 22
    size_px: tuple[int, int] = (480, 720)  # width, height
    spread_deg: tuple[float, float] = SPREAD_DEG
    distortion: bool = False
    seed: int = 0  # of cameras, light's rays and noise
    sky: Sky = field(default_factory=Sky)
    sensor: Sensor = field(default_factory=Sensor)
    quality: Quality = field(default_factory=Quality)
    look: Look = field(default_factory=Look)
    texture_size: int = 2048
    hair: bool = False
    shirt: bool = False
    background: tuple[float, float, float] = (0.2, 0.2, 0.2)  # linear
    bits: int = 8


def write_capture(
    root: Path,
    *,
    data: GNMData,
    vertices: Float[np.ndarray, "V 3"],
    schemes: Mapping[str, LandmarkScheme],
    subject: str,
    expression: str,
    tags: Mapping[str, Any] | None = None,
    studio: Studio | None = None,
) -> Path:
    """Photograph the vertices (m, capture world; the model's topology) of one head and write `root`.

    The rig stands before the face however the head lies in its world. `ground_truth.npz` holds all vertices; `scan.ply`
    the outside of skin and eyes, in four triangles for one, as far as at least one camera sees it. Renders on the CPU.
    Returns `root`. Raises InputError, before anything is drawn, if `root` exists, the vertices are not the model's in
    number or not finite, or the studio's settings are out of range.
    """
    studio = studio or Studio()
    root = Path(root)
    check(root, studio)
    _check_vertices(data, vertices)
    vertices = np.asarray(vertices, np.float64)
    cameras = _rig(data, vertices, studio)
    backend.activate("llvm")
    head = _head(data, vertices, studio)
    surfaces = [head, *_worn(data, head, studio)]
    views = shoot(
        surfaces,
        cameras,
        sky=studio.sky,
        sensor=studio.sensor,
        quality=studio.quality,
        landmarks={name: scheme.points(vertices) for name, scheme in schemes.items()},
        background=studio.background,
        seed=studio.seed,
    )
    return native_writer.write_capture(
        root,
        views,
        native_writer.CaptureDescription(subject=subject, expression=expression, classes=LABELS, tags=tags or {}),
        scan=_scan(data, head, surfaces, cameras),
        truth=vertices,
        bits=studio.bits,
    )


def pose(data: GNMData, vertices: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """The rotation and translation (m) that bring the template's skin closest to the vertices' (Kabsch 1976)."""
    skin = exterior(data)
    source, target = data.template_vertex_positions[skin].astype(np.float64), vertices[skin]
    u, _, vt = np.linalg.svd((source - source.mean(0)).T @ (target - target.mean(0)))
    flip = np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ flip @ u.T
    return rotation, target.mean(0) - rotation @ source.mean(0)


def check(root: Path, studio: Studio) -> None:
    """Raises InputError for a folder that exists and for settings out of range; for callers with much to do before."""
    if Path(root).exists():
        raise _wrong("The capture folder exists already", root, "a path that is free", "a file or folder")
    check_rig(studio.cameras, studio.size_px, spread_deg=studio.spread_deg)
    if studio.seed < 0:
        raise _wrong("The seed is out of range", "studio.seed", "a whole number from 0", studio.seed)
    pixels = studio.cameras * studio.size_px[0] * studio.size_px[1]
    if pixels > MOST_PIXELS:
        raise _wrong("The images are too many and too large", "studio", f"{MOST_PIXELS} pixels in all", pixels)
    if not 64 <= studio.texture_size <= 8192:
        raise _wrong("The texture has a wrong size", "studio.texture_size", "64 to 8192 texels", studio.texture_size)
    quality = studio.quality
    if not (1 <= quality.pixel_samples <= 16 and 1 <= quality.light_rays <= 65536 and 0 <= quality.subdivisions <= 3):
        expected = "pixel_samples 1 to 16, light_rays 1 to 65536, subdivisions 0 to 3"
        raise _wrong("The quality is out of range", "studio.quality", expected, quality)
    if studio.bits not in (8, 16):
        raise _wrong("The images have a wrong depth", "studio.bits", "8 or 16", studio.bits)


def _check_vertices(data: GNMData, vertices: Float[np.ndarray, "V 3"]) -> None:
    count = len(data.template_vertex_positions)
    if len(vertices) != count or not np.isfinite(vertices).all():
        got = f"{len(vertices)}, {int(np.isfinite(vertices).all(1).sum())} of them finite"
        raise _wrong("The vertices are not the model's", "vertices", f"{count} finite positions in metres", got)


def _wrong(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="change it")


def _rig(data: GNMData, vertices: Float[np.ndarray, "V 3"], studio: Studio) -> tuple[Camera, ...]:
    rotation, translation = pose(data, vertices)
    own = (vertices[exterior(data)] - translation) @ rotation  # in the model's frame
    low, high = own.min(0), own.max(0)
    return rig(
        studio.cameras,
        studio.size_px,
        studio.seed,
        studio.distortion,
        centre=rotation @ ((low + high) / 2) + translation,
        R_world_head=rotation,
        head_height_m=float(high[1] - low[1]) + 2 * HAIR_M,  # room for hair, worn or not: it moves no camera
        spread_deg=studio.spread_deg,
    )


def label_shares(data: GNMData) -> Float[np.ndarray, "V K"]:
    """The vertices' shares of LABELS but the background."""
    names, shares = vertex_classes(data)
    neck = neck_other(data)
    result = np.zeros((len(shares), len(LABELS) - 1), np.float32)
    result[:, : len(names)] = shares
    result[:, LABELS.index(NECK) - 1] = shares[:, 0] * neck
    result[:, 0] *= ~neck
    return result


@lru_cache(maxsize=2)
def _canvas(model: "_ById", size: int) -> Canvas:
    return canvas(model.data, size)


@dataclass(frozen=True)
class _ById:
    """A model as a key of a cache: equal if it is the same object."""

    data: GNMData

    def __hash__(self) -> int:
        return id(self.data)


def _head(data: GNMData, vertices: Float[np.ndarray, "V 3"], studio: Studio) -> StudioSurface:
    return StudioSurface(
        vertices=vertices,
        triangles=data.triangles.astype(np.int64),
        corner_uvs=texture_atlas(data),
        texture=paint(data, _canvas(_ById(data), studio.texture_size), studio.look),
        classes=label_shares(data),
        clear=corneas(data),
    )


def _worn(data: GNMData, head: StudioSurface, studio: Studio) -> list[StudioSurface]:
    shares = np.eye(len(LABELS) - 1, dtype=np.float32)
    worn = []
    if studio.hair:
        worn.append(hair(data, head, shares[LABELS.index(HAIR) - 1], studio.look, studio.look.seed))
    if studio.shirt:
        worn.append(shirt(data, head, shares[LABELS.index(CLOTHES) - 1], studio.look.seed))
    return worn


def _scan(data: GNMData, head: StudioSurface, surfaces: list[StudioSurface], cameras: tuple[Camera, ...]) -> Scan:
    """What a scanner would have of the head: its outside, where a camera sees the middle of a face."""
    fine = subdivided(head)
    outside = exterior(data) | (group(data, "eye_exteriors") > 0.5)
    own = np.tile(outside[head.triangles].all(1), 4)
    triangles = fine.triangles[own]
    middle = fine.vertices[triangles].mean(1)
    scene = StudioScene(surfaces)
    found = np.zeros(len(triangles), bool)
    for camera in cameras:
        found |= _inside(camera, middle) & seen(scene, camera, middle, _SEEN_TOLERANCE_M)
    used, triangles = np.unique(triangles[found], return_inverse=True)
    return Scan(vertices=fine.vertices[used], triangles=triangles.reshape(-1, 3))


def _inside(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
    xy = distorted_pixels(camera, points)
    inside: Bool[np.ndarray, "P 2"] = (xy >= 0) & (xy <= (camera.width_px, camera.height_px))
    return np.all(inside, axis=1)
