"""The types that several rooms share. Axis letters: N views, H W pixels, V vertices, F triangles, I identity,
E expression, J joints, L landmarks, K classes. Units: metres, radians, pixels (`_px`), millimetres (`_mm`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

Status = Literal["converged", "stopped", "failed"]
NormalsFrame = Literal["camera_opencv", "camera_opengl", "world"]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A calibrated camera: pinhole plus OpenCV distortion."""

    width_px: int
    height_px: int
    intrinsics: Float[np.ndarray, "3 3"]  # K in px, centre of pixel (0, 0) at (0.5, 0.5)
    T_cam_world: Float[np.ndarray, "4 4"]
    distortion: tuple[float, ...] = ()  # OpenCV order k1 k2 p1 p2 [k3 [k4 k5 k6]]; empty = none

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """The camera's position in the world, metres."""
        return -self.T_cam_world[:3, :3].T @ self.T_cam_world[:3, 3]

    def relative_to(self, origin: Float[np.ndarray, "3"]) -> "Camera":
        """The same camera in a world whose origin is at `origin`, metres."""
        if not origin.any():
            return self
        T = self.T_cam_world.copy()
        T[:3, 3] += T[:3, :3] @ origin
        return replace(self, T_cam_world=T)

    def scaled(self, width_px: int, height_px: int) -> "Camera":
        """The same camera for an image resampled to this size."""
        scale = np.diag([width_px / self.width_px, height_px / self.height_px, 1.0])
        return replace(self, width_px=width_px, height_px=height_px, intrinsics=scale @ self.intrinsics)

    def cropped(self, x_px: int, y_px: int, width_px: int, height_px: int) -> "Camera":
        """The same camera for the window of its image whose first pixel is (x_px, y_px); may reach outside."""
        intrinsics = self.intrinsics.copy()
        intrinsics[:2, 2] -= (x_px, y_px)
        return replace(self, width_px=width_px, height_px=height_px, intrinsics=intrinsics)

    def project(self, points: Float[np.ndarray, "P 3"]) -> tuple[Float[np.ndarray, "P 2"], Float[np.ndarray, "P"]]:
        """World points (m) to pixels and depths (m), *without* distortion."""
        local = points @ self.T_cam_world[:3, :3].T + self.T_cam_world[:3, 3]
        image = local @ self.intrinsics.T
        return image[:, :2] / image[:, 2:], local[:, 2]


@dataclass(frozen=True, kw_only=True)
class Colour:
    """How the values of an image become linear sRGB light: decode, then apply the matrix and the gain."""

    encoding: str = "srgb"  # transfer function of the file: "srgb", "linear" or a log curve (capture.colour)
    matrix: tuple[tuple[float, ...], ...] | None = None  # 3 x 3 or, with an offset, 3 x 4
    matrix_space: Literal["encoded", "linear"] = "linear"  # values in [0, 1] that the matrix applies to
    gain: float = 1.0  # of linear light


@dataclass(frozen=True, kw_only=True)
class View:
    """One image of a capture, as it lies on disk: nothing is decoded, landmarks are in distorted pixels."""

    name: str  # image name without its suffix, e.g. "cam00"
    camera: Camera
    image: Path
    mask: Path | None = None
    normals: Path | None = None
    normals_frame: NormalsFrame = "camera_opencv"  # axes of the stored normals
    depth: Path | None = None
    depth_unit_m: float | None = None  # of the stored depths; None: metres, of floating-point numbers only
    confidence: Path | None = None  # of normals and depths, 8 bit; None: all count fully
    segmentation: Path | None = None
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]] = field(default_factory=dict)  # scheme -> x_px y_px confidence
    # Scheme -> standard deviation of each landmark's position along each axis, px; not all schemes have it.
    landmark_spread_px: Mapping[str, Float[np.ndarray, "_"]] = field(default_factory=dict)
    colour: Colour = Colour()

    @property
    def has_normals(self) -> bool:
        """Whether a file gives normals: a map of them, or of depths."""
        return self.normals is not None or self.depth is not None


@dataclass(frozen=True, kw_only=True)
class LabelCode:
    """What the pixels of label maps are: positions in `Capture.classes`, or indices or colours that stand for them."""

    indices: tuple[int, ...] = ()  # stored index -> position, -1: it has no name; (): the indices are the positions
    colours: tuple[tuple[int, int, int, int], ...] = ()  # red, green, blue, position; (): maps in colour are refused
    renamed: tuple[tuple[str, str], ...] = ()  # a class' name in the capture, and what it was taken for


@dataclass(frozen=True, kw_only=True)
class HeadPose:
    """Where the model's head is: world = scale * rotation @ model + translation."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]  # metres
    scale: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Capture:
    """One moment of one subject, recorded by several cameras."""

    root: Path
    subject: str
    expression: str
    views: tuple[View, ...]
    classes: tuple[str, ...] = ()  # names of the label indices in `segmentation`, each once
    labels: LabelCode = LabelCode()
    tags: Mapping[str, Any] = field(default_factory=dict)
    scan: Path | None = None
    ground_truth: Path | None = None
    photographs: bool = True  # whether the images' colours count; else they only help a person to see the views
    head: HeadPose | None = None  # where a fit without landmarks starts

    def cameras_relative_to(self, origin: Float[np.ndarray, "3"]) -> "Capture":
        """The same capture with cameras in a world whose origin is at `origin`, metres; files keep the old world."""
        views = tuple(replace(view, camera=view.camera.relative_to(origin)) for view in self.views)
        return replace(self, views=views)


@dataclass(frozen=True, kw_only=True)
class ViewPixels:
    """One view decoded, undistorted and resampled; arrays share one pixel grid."""

    camera: Camera  # without distortion, at this size
    rgb: Float[np.ndarray, "H W 3"]  # linear
    mask: Float[np.ndarray, "H W"] | None  # coverage of the subject in [0, 1]
    normals: Float[np.ndarray, "H W 3"] | None  # unit, camera frame; 0 where there is none
    label_coverage: Float[np.ndarray, "H W K"] | None  # coverage by each of Capture.classes; sums to 1 where valid
    valid: Float[np.ndarray, "H W"]  # fraction of the pixel that undistortion has a source for
    depth: Float[np.ndarray, "H W"] | None = None  # along the optical axis, metres; 0 where there is none
    confidence: Float[np.ndarray, "H W"] | None = None  # of normals and depth, in [0, 1]


_BLOCK = 4  # pixels, width and height of the blocks that order a list


@dataclass(frozen=True, kw_only=True)
class Pixels:
    """The P pixels of some views that take part in a step, as a list with an index from the images into it.

    All cameras have one image size and no distortion. Arrays of pixels are ordered by view, within a view by blocks of
    4 x 4 pixels: rays are cast sixteen at a time, and those of a block hit the same few faces.
    """

    cameras: tuple[Camera, ...]
    view: Int[Tensor, "P"]  # int32, as the next two
    x: Int[Tensor, "P"]
    y: Int[Tensor, "P"]
    index: Int[Tensor, "N H W"]  # position in the list, or -1

    @classmethod
    def from_mask(cls, cameras: Sequence[Camera], mask: Bool[Tensor, "N H W"]) -> "Pixels":
        """Return the list of the pixels where the mask is true."""
        views, height, width = mask.shape
        padded = torch.nn.functional.pad(mask, (0, -width % _BLOCK, 0, -height % _BLOCK))
        blocks = padded.view(views, -(-height // _BLOCK), _BLOCK, -(-width // _BLOCK), _BLOCK).transpose(2, 3)
        view, row, column, y, x = blocks.nonzero(as_tuple=True)
        view, y, x = view, _BLOCK * row + y, _BLOCK * column + x
        index = torch.full(mask.shape, -1, dtype=torch.int32, device=mask.device)
        index[view, y, x] = torch.arange(len(view), dtype=torch.int32, device=mask.device)
        view, y, x = (axis.to(torch.int32) for axis in (view, y, x))
        return cls(cameras=tuple(cameras), view=view, x=x, y=y, index=index)

    @classmethod
    def full(cls, cameras: Sequence[Camera], device: torch.device | str = "cpu") -> "Pixels":
        """Return the list of all pixels of all views."""
        shape = (len(cameras), cameras[0].height_px, cameras[0].width_px)
        return cls.from_mask(cameras, torch.ones(shape, dtype=torch.bool, device=device))

    def image(self, values: Float[Tensor, "P D"], background: float = 0.0) -> Float[Tensor, "N H W D"]:
        """Return images with these values at the listed pixels and `background` elsewhere; differentiable."""
        image = values.new_full((self.index.numel(), values.shape[-1]), background)
        return image.index_copy(0, self.position, values).view(*self.index.shape, values.shape[-1])

    def of_image(self, image: Shaped[Tensor, "N H W *D"]) -> Shaped[Tensor, "P *D"]:
        """Return an image's values at the listed pixels."""
        return image.reshape(self.index.numel(), *image.shape[3:]).index_select(0, self.position)

    @cached_property
    def rows_by_view(self) -> tuple[slice, ...]:
        """The rows of the list that belong to each view."""
        ends = self.view.bincount(minlength=len(self.cameras)).cumsum(0).tolist()
        return tuple(slice(first, end) for first, end in zip([0, *ends], ends, strict=False))

    @cached_property
    def position(self) -> Int[Tensor, "P"]:
        """The pixels' positions in the images, one after the other, row by row (int64)."""
        _, height, width = self.index.shape
        return (self.view.long() * height + self.y) * width + self.x


@dataclass(frozen=True, kw_only=True)
class Targets:
    """Target values of the losses at one pyramid level: the pixels in and around the head.

    Levels are stored in float16; `select` returns the float32 batch of a step. Pixels of weight 0 are not compared.
    """

    names: tuple[str, ...]  # of the views
    class_names: tuple[str, ...]  # the K classes that model and capture share
    pixels: Pixels
    rgb: Float[Tensor, "P 3"]  # linear
    rgb_weight: Float[Tensor, "P"]
    normals: Float[Tensor, "P 3"]  # world frame, unit or 0
    normal_weight: Float[Tensor, "P"]
    mask: Float[Tensor, "P"]  # coverage of the subject
    mask_weight: Float[Tensor, "P"]
    classes: Float[Tensor, "P K"]
    class_weight: Float[Tensor, "P"]
    # Along the optical axes, metres, float32 in levels too; 0: none. Weighs as the normals. None: no view has depths.
    depth: Float[Tensor, "P"] | None = None
    landmarks: Mapping[str, Float[Tensor, "N L 3"]]  # scheme -> x_px y_px confidence
    landmark_spread_px: Mapping[str, Float[Tensor, "N _"]] = field(default_factory=dict)  # NaN: unknown
    px_per_head: float  # the subject's height in pixels, median over views

    def select(self, views: Sequence[int], device: torch.device) -> "Targets":
        """The batch of some views, float32, on a device."""
        views = list(views)
        first = torch.searchsorted(self.pixels.view, torch.arange(len(self.names) + 1, dtype=torch.int32)).tolist()

        def take(values: Tensor) -> Tensor:
            return torch.cat([values[first[v] : first[v + 1]] for v in views]).to(device)

        sizes = torch.tensor([first[v + 1] - first[v] for v in views], dtype=torch.int32)
        shift = (sizes.cumsum(0) - sizes - torch.tensor([first[v] for v in views])).to(torch.int32)[:, None, None]
        index = self.pixels.index[views]
        pixels = Pixels(
            cameras=tuple(self.pixels.cameras[v] for v in views),
            view=torch.repeat_interleave(torch.arange(len(views), dtype=torch.int32), sizes).to(device),
            x=take(self.pixels.x),
            y=take(self.pixels.y),
            index=torch.where(index < 0, index, index + shift).to(device),
        )
        values: dict[str, Any] = {
            f.name: take(getattr(self, f.name)).to(torch.float32)
            for f in fields(self)
            if isinstance(getattr(self, f.name), Tensor)
        }
        names = tuple(self.names[v] for v in views)
        values["landmarks"] = {scheme: points[views].to(device) for scheme, points in self.landmarks.items()}
        spreads = {scheme: spread_px[views].to(device) for scheme, spread_px in self.landmark_spread_px.items()}
        return replace(self, names=names, pixels=pixels, landmark_spread_px=spreads, **values)


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """The rendering of the model at some pixels, without shading."""

    rgb: Float[Tensor, "P 3"]  # the texture's colour, linear
    normals: Float[Tensor, "P 3"]  # world frame, unit, of the visible side; 0 on a miss
    classes: Float[Tensor, "P K"]  # soft membership of each class; 0 on a miss
    mask: Float[Tensor, "P"]  # 1 on a hit


@dataclass(frozen=True, kw_only=True)
class SurfaceHits:
    """The points of a mesh at the centres of some pixels of a list."""

    pixel: Int[Tensor, "H"]  # position in the list, as the next in int64
    face: Int[Tensor, "H"]
    barycentric: Float[Tensor, "H 3"]


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Parameters of the GNM function. Tensors may have the same leading batch axes."""

    identity: Float[Tensor, "*B I"]
    expression: Float[Tensor, "*B E"]
    rotations: Float[Tensor, "*B J 3"]  # axis-angle, each joint relative to its parent; the root rotates everything
    translation: Float[Tensor, "*B 3"]
    scale: Float[Tensor, "*B"]  # applied to the posed mesh before the translation; 1 unless a recipe frees it


@dataclass(frozen=True, kw_only=True)
class Registration:
    """The registered mesh of one capture and how it was computed. Arrays are in the model's vertex order.

    They are float32, but `translation`, `vertices` and `landmarks` are float64 where the world's origin is far.
    """

    status: Status
    reason: str
    identity: Float[np.ndarray, "I"]
    expression: Float[np.ndarray, "E"]
    rotations: Float[np.ndarray, "J 3"]
    translation: Float[np.ndarray, "3"]  # capture world, metres
    scale: Float[np.ndarray, ""]
    offsets: Float[np.ndarray, "V 3"]  # bind space, metres
    vertices: Float[np.ndarray, "V 3"]  # capture world, metres
    triangles: Int[np.ndarray, "F 3"]
    confidence: Float[np.ndarray, "V"]
    texture: Float[np.ndarray, "R R 3"]  # linear
    corner_uvs: Float[np.ndarray, "F 3 2"]  # of the texture's atlas
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]] = field(default_factory=dict)  # scheme -> points on `vertices`
    seconds: Mapping[str, float] = field(default_factory=dict)  # per stage
    history: Mapping[str, Mapping[str, list[float]]] = field(default_factory=dict)  # stage -> term -> value per step
    figures: Mapping[str, Any] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)  # the resolved configuration
    inputs: Mapping[str, str] = field(default_factory=dict)  # name -> sha256
    provenance: Mapping[str, str] = field(default_factory=dict)  # the command, and the paths of what it read


# Distance metrics among a registration's figures, as the report and the command line title them.
METRIC_TITLES = {
    "scan_to_mesh": "Scan to mesh",
    "scan_to_mesh_by_area": "Scan to mesh, by area",
    "mesh_to_scan": "Mesh to scan",
    "vertex_error": "Vertex error",
    "drift": "Drift from the neutral",
}
