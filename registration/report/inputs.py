"""The contents of a report, in NumPy arrays: the page needs neither the renderer nor a GPU."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from registration.frames import axis_angle_to_matrix
from registration.types import Registration, Rendered, Targets

THUMBNAIL_HEIGHT = 150  # px
_BACKGROUND = 0.92  # linear; shown where the targets list no pixel


@dataclass(frozen=True, kw_only=True)
class ReportView:
    """One view: the capture and the rendered registration on the same pixels."""

    name: str
    target_rgb: Float[np.ndarray, "H W 3"]  # linear
    rendered_rgb: Float[np.ndarray, "H W 3"]  # linear
    compared: Bool[np.ndarray, "H W"]  # pixels whose colours the fit compared
    target_mask: Float[np.ndarray, "H W"] | None = None  # coverage of the subject
    rendered_mask: Float[np.ndarray, "H W"]
    target_normals: Float[np.ndarray, "H W 3"] | None = None  # world, unit length; 0 where there is none
    rendered_normals: Float[np.ndarray, "H W 3"]
    target_classes: Int[np.ndarray, "H W"] | None = None  # index into `class_names`; -1 where not compared
    rendered_classes: Int[np.ndarray, "H W"]  # -1 where the mesh is not visible


@dataclass(frozen=True, kw_only=True)
class HeatMap:
    """Distances at the vertices of a mesh, for images of the mesh."""

    vertices: Float[np.ndarray, "V 3"]  # m, capture world
    triangles: Int[np.ndarray, "F 3"]
    distance_mm: Float[np.ndarray, "V"]  # NaN where nothing was measured
    T_head_world: Float[np.ndarray, "4 4"]  # to a frame with +Y up and +Z out of the face


@dataclass(frozen=True, kw_only=True)
class PictureSection:
    """A section of pictures at the head of a report."""

    title: str
    text: str  # below the title
    pictures: tuple[tuple[str, UInt8[np.ndarray, "_ _ 3"]], ...] = ()  # caption and sRGB; sizes differ
    svg: str = ""  # a chart; not escaped
    limit_mm: float | None = None  # end of the colour scale of distances that the pictures use


@dataclass(frozen=True, kw_only=True)
class ReportInputs:
    """All inputs of the report's page."""

    registration: Registration
    subject: str
    expression: str
    views: tuple[ReportView, ...] = ()  # those that are shown in full
    thumbnails: tuple[ReportView, ...] = ()  # all views, small
    class_names: tuple[str, ...] = ()
    sections: tuple[PictureSection, ...] = ()  # before all others
    heat_map: HeatMap | None = None
    made: bytes | None = None  # a JPEG of the channels that were made from the photographs
    versions: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)  # of the registration folder -> what each is


def distance_heat_map(registration: Registration, distance_mm: Float[np.ndarray, "V"]) -> HeatMap:
    """Return the heat map of distances of the registered vertices, with the head upright.

    Args:
        registration: its root joint's rotation is undone.
        distance_mm: NaN where not measured.
    """
    T_head_world = np.eye(4)
    root = torch.from_numpy(registration.rotations[0].astype(np.float64))
    T_head_world[:3, :3] = axis_angle_to_matrix(root).numpy().T
    return HeatMap(
        vertices=registration.vertices,
        triangles=registration.triangles,
        distance_mm=distance_mm,
        T_head_world=T_head_world,
    )


def thumbnail(view: ReportView) -> ReportView:
    """Return a view's colours and outline at `THUMBNAIL_HEIGHT`, without normals and classes."""
    height, width = view.rendered_mask.shape
    size = (max(1, round(width * min(1.0, THUMBNAIL_HEIGHT / height))), min(height, THUMBNAIL_HEIGHT))

    def reduced(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)

    return replace(
        view,
        target_rgb=reduced(view.target_rgb),
        rendered_rgb=reduced(view.rendered_rgb),
        compared=reduced(view.compared) > 0.5,
        rendered_mask=reduced(view.rendered_mask),
        rendered_normals=reduced(view.rendered_normals),
        target_mask=None,
        target_normals=None,
        target_classes=None,
        rendered_classes=np.full(size[::-1], -1),
    )


def report_views(targets: Targets, rendered: Rendered) -> tuple[ReportView, ...]:
    """Return one `ReportView` for each view of a batch of targets.

    Args:
        targets: of the views.
        rendered: the registration at the pixels of `targets`.
    """

    def images(values: Tensor, background: float = 0.0) -> np.ndarray:
        flat = values.detach().float().reshape(len(values), -1)
        return targets.pixels.image(flat, background).cpu().numpy()

    target_rgb, compared = images(targets.rgb, _BACKGROUND), images(targets.rgb_weight)[..., 0] > 0
    normals, classes = images(targets.normals), images(targets.classes)
    normals *= images(targets.normal_weight) > 0
    classed = (images(targets.class_weight)[..., 0] > 0) & (classes.max(-1) > 0.5)
    mask, mask_weight = images(targets.mask)[..., 0], images(targets.mask_weight)[..., 0]
    rendered_mask, rendered_classes = images(rendered.mask)[..., 0], images(rendered.classes).argmax(-1)
    rendered_rgb, rendered_normals = images(rendered.rgb), images(rendered.normals)
    return tuple(
        ReportView(
            name=name,
            target_rgb=target_rgb[n],
            rendered_rgb=rendered_rgb[n],
            compared=compared[n],
            target_mask=mask[n] if mask_weight[n].any() else None,
            rendered_mask=rendered_mask[n],
            target_normals=normals[n] if normals[n].any() else None,
            rendered_normals=rendered_normals[n],
            target_classes=np.where(classed[n], classes[n].argmax(-1), -1) if classed[n].any() else None,
            rendered_classes=np.where(rendered_mask[n] > 0.5, rendered_classes[n], -1),
        )
        for n, name in enumerate(targets.names)
    )
