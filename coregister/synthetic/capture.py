"""Synthetic captures: one head mesh, rendered in the studio and written as a native capture folder.

Everything in the folder is derived from the mesh, which is the ground truth of a registration.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from coregister.synthetic.hair_and_shirt import HAIR_M, hair_mesh, shirt_mesh
from registration.capture import native_writer
from registration.capture.scan import Scan
from registration.errors import InputError
from registration.geometry import rigid
from registration.model.atlas import texture_atlas
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import CLASSES, exterior, group, neck_other, vertex_classes
from registration.render import backend
from registration.render.studio.canvas import Canvas, make_canvas
from registration.render.studio.eyes import corneas
from registration.render.studio.light import Sky
from registration.render.studio.rig import SPREAD_DEG, RigOptions, make_rig
from registration.render.studio.scene import StudioScene, StudioSurface, subdivide
from registration.render.studio.shoot import Quality, Sensor, distorted_pixels, render_views, visible
from registration.render.studio.skin import SkinAppearance, paint_head
from registration.types import Camera

NECK, HAIR, CLOTHES = "neck_other", "hair", "clothes"
GARMENTS = (HAIR, CLOTHES)
LABELS = ("background", *CLASSES, NECK, *GARMENTS)  # of the captures' label maps, in index order
MAX_PIXELS = 1 << 28  # of all images together: 8 GB while they are rendered
_VISIBILITY_TOLERANCE_M = 1e-4


@dataclass(frozen=True, kw_only=True)
class Studio:
    """The settings of a synthetic capture. Equal settings give equal captures.

    Attributes:
        cameras: number of cameras.
        size_px: width and height of the images.
        spread_deg: angle between the outermost cameras, horizontally and vertically.
        distortion: whether the lenses have distortion.
        seed: of the cameras' jitter, of light rays and of noise.
        sky: the environment light.
        sensor: noise and differences of exposure.
        quality: sampling of pixels and light.
        look: the skin's appearance.
        texture_size: side of the texture, texels.
        hair: whether to add hair.
        shirt: whether to add a shirt.
        background: linear RGB.
        bits: of the images, 8 or 16.
    """

    cameras: int = 22
    size_px: tuple[int, int] = (480, 720)
    spread_deg: tuple[float, float] = SPREAD_DEG
    distortion: bool = False
    seed: int = 0
    sky: Sky = field(default_factory=Sky)
    sensor: Sensor = field(default_factory=Sensor)
    quality: Quality = field(default_factory=Quality)
    look: SkinAppearance = field(default_factory=SkinAppearance)
    texture_size: int = 2048
    hair: bool = False
    shirt: bool = False
    background: tuple[float, float, float] = (0.2, 0.2, 0.2)
    bits: int = 8


def render_capture(
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
    """Render one head from all cameras of a rig and write a native capture folder. Runs on the CPU.

    The rig is placed in front of the face for any pose of the head in the world. `ground_truth.npz` holds all vertices,
    `scan.ply` the exterior of skin and eyes, subdivided once, where at least one camera sees it.

    Args:
        root: the folder to write; must not exist.
        data: the model whose topology the vertices have.
        vertices: of the head, metres, world frame.
        schemes: landmark schemes by name; their points are projected into every view.
        subject: name of the subject.
        expression: name of the expression.
        tags: further tags of the capture.
        studio: the settings; defaults if None.

    Returns:
        `root`.

    Raises:
        InputError: before rendering: `root` exists, the vertices are not finite or not as many as the model's, or a
            setting is out of range.
    """
    studio = studio or Studio()
    root = Path(root)
    check_studio(root, studio)
    _check_vertices(data, vertices)
    vertices = np.asarray(vertices, np.float64)
    cameras = _rig(data, vertices, studio)
    backend.activate("llvm")
    head = _head(data, vertices, studio)
    surfaces = [head, *_garments(data, head, studio)]
    views = render_views(
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


def check_studio(root: Path, studio: Studio) -> None:
    """Check an output folder and settings before anything expensive is computed.

    Args:
        root: the capture folder to write.
        studio: the settings.

    Raises:
        InputError: the folder exists, or a setting is out of range.
    """
    if Path(root).exists():
        raise _input_error("The capture folder exists already", root, "a path that does not exist", "a file or folder")
    _rig_options(studio).check()
    if studio.seed < 0:
        raise _input_error("The seed is out of range", "studio.seed", "a whole number from 0", studio.seed)
    pixels = studio.cameras * studio.size_px[0] * studio.size_px[1]
    if pixels > MAX_PIXELS:
        expected = f"at most {MAX_PIXELS} pixels in total"
        raise _input_error("The images have too many pixels", "studio", expected, pixels)
    if not 64 <= studio.texture_size <= 8192:
        raise _input_error(
            "The texture size is out of range", "studio.texture_size", "64 to 8192 texels", studio.texture_size
        )
    quality = studio.quality
    if not (1 <= quality.pixel_samples <= 16 and 1 <= quality.light_rays <= 65536 and 0 <= quality.subdivisions <= 3):
        expected = "pixel_samples 1 to 16, light_rays 1 to 65536, subdivisions 0 to 3"
        raise _input_error("The quality is out of range", "studio.quality", expected, quality)
    if studio.bits not in (8, 16):
        raise _input_error("The bit depth is not supported", "studio.bits", "8 or 16", studio.bits)


def _check_vertices(data: GNMData, vertices: Float[np.ndarray, "V 3"]) -> None:
    count = len(data.template_vertex_positions)
    if len(vertices) != count or not np.isfinite(vertices).all():
        got = f"{len(vertices)} positions, {int(np.isfinite(vertices).all(1).sum())} of them finite"
        raise _input_error("The vertices do not fit the model", "vertices", f"{count} finite positions in metres", got)


def _input_error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="change this setting")


def _rig(data: GNMData, vertices: Float[np.ndarray, "V 3"], studio: Studio) -> tuple[Camera, ...]:
    """Return cameras around the head, placed by the rigid alignment of the template's exterior with its own."""
    rows = exterior(data)
    source = data.template_vertex_positions[rows].astype(np.float64)
    T_world_model = rigid.align(source[None], vertices[rows], np.ones((1, len(source))))[0]
    rotation, translation = T_world_model[:3, :3], T_world_model[:3, 3]
    local = (vertices[rows] - translation) @ rotation  # in the model's frame
    low, high = local.min(0), local.max(0)
    return make_rig(
        _rig_options(studio),
        centre=rotation @ ((low + high) / 2) + translation,
        R_world_head=rotation,
        head_height_m=float(high[1] - low[1]) + 2 * HAIR_M,  # the cameras are the same with and without hair
    )


def _rig_options(studio: Studio) -> RigOptions:
    return RigOptions(
        cameras=studio.cameras,
        size_px=studio.size_px,
        seed=studio.seed,
        distortion=studio.distortion,
        spread_deg=studio.spread_deg,
    )


def label_weights(data: GNMData) -> Float[np.ndarray, "V K"]:
    """Return the vertices' weights of `LABELS` without the background; rows of labelled vertices sum to 1."""
    names, weights = vertex_classes(data)
    neck = neck_other(data)
    result = np.zeros((len(weights), len(LABELS) - 1), np.float32)
    result[:, : len(names)] = weights
    result[:, LABELS.index(NECK) - 1] = weights[:, 0] * neck
    result[:, 0] *= ~neck
    return result


@lru_cache(maxsize=2)
def _canvas(model: "_ModelKey", size: int) -> Canvas:
    return make_canvas(model.data, size)


@dataclass(frozen=True)
class _ModelKey:
    """A model as a key of a cache, compared by identity: its arrays cannot be hashed."""

    data: GNMData

    def __hash__(self) -> int:
        return id(self.data)


def _head(data: GNMData, vertices: Float[np.ndarray, "V 3"], studio: Studio) -> StudioSurface:
    return StudioSurface(
        vertices=vertices,
        triangles=data.triangles.astype(np.int64),
        corner_uvs=texture_atlas(data),
        texture=paint_head(data, _canvas(_ModelKey(data), studio.texture_size), studio.look),
        classes=label_weights(data),
        transparent=corneas(data),
    )


def _garments(data: GNMData, head: StudioSurface, studio: Studio) -> list[StudioSurface]:
    classes = np.eye(len(LABELS) - 1, dtype=np.float32)
    garments = []
    if studio.hair:
        garments.append(hair_mesh(data, head, classes[LABELS.index(HAIR) - 1], studio.look, studio.look.seed))
    if studio.shirt:
        garments.append(shirt_mesh(data, head, classes[LABELS.index(CLOTHES) - 1], studio.look.seed))
    return garments


def _scan(data: GNMData, head: StudioSurface, surfaces: list[StudioSurface], cameras: tuple[Camera, ...]) -> Scan:
    """Return what a scanner would measure: the faces of the head's exterior whose centroid a camera sees."""
    fine = subdivide(head)
    outside = exterior(data) | (group(data, "eye_exteriors") > 0.5)
    triangles = fine.triangles[np.tile(outside[head.triangles].all(1), 4)]
    centroids = fine.vertices[triangles].mean(1)
    scene = StudioScene(surfaces)
    scanned = np.zeros(len(triangles), bool)
    for camera in cameras:
        scanned |= _in_image(camera, centroids) & visible(scene, camera, centroids, _VISIBILITY_TOLERANCE_M)
    used, triangles = np.unique(triangles[scanned], return_inverse=True)
    return Scan(vertices=fine.vertices[used], triangles=triangles.reshape(-1, 3))


def _in_image(camera: Camera, points: Float[np.ndarray, "P 3"]) -> Bool[np.ndarray, "P"]:
    xy = distorted_pixels(camera, points)
    inside: Bool[np.ndarray, "P 2"] = (xy >= 0) & (xy <= (camera.width_px, camera.height_px))
    return np.all(inside, axis=1)
