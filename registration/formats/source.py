"""A capture as another program's files describe it: what every reader of this room returns."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.types import Colour, LabelCode, NormalsFrame


@dataclass(frozen=True, kw_only=True)
class Distortion:
    """A lens: maps undistorted to distorted points of the plane z = 1, see `registration.formats.distortions`."""

    model: str  # key of `distortions.MODELS`
    coefficients: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class VideoFrame:
    """One frame of a video file."""

    file: Path
    index: int  # from 0


@dataclass(frozen=True, kw_only=True)
class SourceView:
    """One image with its camera. Nothing is decoded."""

    name: str  # of the view in the native capture: no suffix, may hold subfolders
    image: Path | VideoFrame
    width_px: int
    height_px: int
    intrinsics: Float[np.ndarray, "3 3"]  # K in px, centre of pixel (0, 0) at (0.5, 0.5); skew allowed
    T_cam_world: Float[np.ndarray, "4 4"]  # OpenCV's axes (x right, y down, z forward); translation in world units
    distortion: Distortion = Distortion(model="none")
    colour: Colour = Colour()
    mask: Path | None = None
    normals: Path | None = None  # in the native encoding, or a map of COLMAP's dense reconstruction
    normals_frame: NormalsFrame = "camera_opencv"  # axes of the stored normals
    depth: Path | None = None  # along the optical axis, of a kind that native captures have
    depth_unit_m: float | None = None  # metres per stored unit; None: the values are lengths of the world
    confidence: Path | None = None  # of normals and depths
    segmentation: Path | None = None
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]] = field(default_factory=dict)  # x_px y_px confidence, distorted
    landmark_spread_px: Mapping[str, Float[np.ndarray, "L"]] = field(default_factory=dict)  # of schemes that have it


@dataclass(frozen=True, kw_only=True)
class SourceCapture:
    """One moment of one subject in another program's layout."""

    format: str  # name of the reader
    root: Path
    subject: str
    expression: str
    views: tuple[SourceView, ...]
    unit_m: float | None  # metres per world unit; None: the format does not state it
    scan: Path | None = None  # mesh in the same world and unit
    classes: tuple[str, ...] = ()  # names of the label maps' indices
    labels: LabelCode = LabelCode()  # what their pixels stand for
    tags: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # what the reader decided or left out, for the user


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What a reader cannot know from the files.

    Attributes:
        subject: Name of the subject; None: from the files or the folder's name.
        expression: Name of the expression; None: from the files, else "neutral".
        frame: Frame number or time step, of layouts that hold sequences; None: the first.
    """

    subject: str | None = None
    expression: str | None = None
    frame: int | None = None


@dataclass(frozen=True, kw_only=True)
class Format:
    """A layout that can be read."""

    name: str  # of --format
    title: str  # for people, as "nerfstudio transforms.json"
    files: str  # the files by which it is recognized, for messages
    detect: Callable[[Path], bool]  # looks at names and first bytes only
    read: Callable[[Path, ReadOptions], SourceCapture]  # raises InputError
    physical: bool = False  # whether its world has a known or at least a common unit; else any scale, as SfM gives
    sequences: bool = False  # whether it holds several frames, so that `ReadOptions.frame` has a meaning
