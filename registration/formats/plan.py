"""What is done with each view when a capture is imported, decided and checked before anything is written."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from registration.capture.dense_maps import is_colmap_map
from registration.capture.headers import require_complete, require_size
from registration.errors import InputError
from registration.formats.distortions import MODELS
from registration.formats.files import TURNED, orientation, stored_size
from registration.formats.source import SourceCapture, SourceView, VideoFrame
from registration.formats.undistort import Undistortion, is_native, native_camera, undistortion
from registration.storage.reading import path_defect
from registration.types import Camera

_ROTATION_TOLERANCE = 1e-4
_CHANNELS = {"mask": "mask", "normals": "normal map", "confidence": "confidence map", "segmentation": "label map"}


@dataclass(frozen=True, kw_only=True)
class ViewPlan:
    """How one view becomes one of the native capture.

    Attributes:
        view: as the reader returned it.
        camera: of the native view, in the source's world unit.
        stored_px: width and height of the image's stored pixels.
        orientation: EXIF orientation by which stored pixels are turned, because the calibration refers to turned ones.
        lens: undistorts the image and what belongs to it; None: the camera has the lens.
    """

    view: SourceView
    camera: Camera
    stored_px: tuple[int, int]
    orientation: int = 1
    lens: Undistortion | None = None

    @property
    def as_it_is(self) -> bool:
        """Whether the image file is copied byte for byte."""
        return self.orientation == 1 and self.lens is None and isinstance(self.view.image, Path)


def plan_views(source: SourceCapture) -> tuple[tuple[ViewPlan, ...], list[str]]:
    """Check every view and decide how to import it; of images only the headers are read.

    Returns:
        The plans, and notes for the user.

    Raises:
        InputError: there is no view, a name is used twice or cannot be a file's, a camera is singular, a lens cannot be
            undistorted, or a file is missing, damaged or of another size than its camera's.
    """
    if not source.views:
        raise InputError("The capture has no views", where=source.root, expected="calibrated images", got="none")
    seen: set[str] = set()
    for view in source.views:
        _check_name(source, view, seen)
        _check_camera(source, view)
    notes: list[str] = []
    plans = tuple(_plan(view, notes) for view in source.views)
    if lost := [plan.view.name for plan in plans if plan.lens is not None]:
        models = ", ".join(sorted({_lens_name(plan.view) for plan in plans if plan.lens is not None}))
        notes.append(f"{len(lost)} of {len(plans)} views were undistorted: no native camera holds their lens, {models}")
    return plans, notes


def _lens_name(view: SourceView) -> str:
    parts = (view.distortion.model, "skew" if view.intrinsics[0, 1] else "none")
    return " with ".join(part for part in parts if part != "none")


def _plan(view: SourceView, notes: list[str]) -> ViewPlan:
    stored_px, turn = _size(view, notes)
    for part, role in _CHANNELS.items():
        if (file := getattr(view, part)) is not None and not is_colmap_map(file):
            require_size(file, role, view.width_px, view.height_px)
            require_complete(file, role)
    lens = None if is_native(view) else undistortion(view)
    camera = native_camera(view) if lens is None else lens.camera
    return ViewPlan(view=view, camera=camera, stored_px=stored_px, orientation=turn, lens=lens)


def _size(view: SourceView, notes: list[str]) -> tuple[tuple[int, int], int]:
    """Return the stored size of a view's image, and the orientation by which it must be turned."""
    expected = (view.width_px, view.height_px)
    if isinstance(view.image, VideoFrame):
        return expected, 1  # known when the frame is decoded
    stored_px, turn = stored_size(view.image), orientation(view.image)
    require_complete(view.image, "image")
    if stored_px == expected:
        if turn != 1 and not (turn in TURNED and stored_px[0] != stored_px[1]):
            notes.append(
                f"{view.name}: the image has the EXIF orientation {turn}, and its size does not tell whether the "
                "calibration refers to stored or turned pixels; stored ones were assumed"
            )
        return stored_px, 1
    if turn in TURNED and stored_px == expected[::-1]:
        notes.append(f"{view.name}: turned by its EXIF orientation {turn}, as the calibration's size says")
        return stored_px, turn
    factor = stored_px[0] / expected[0]
    fix = "import the images that were calibrated, or correct the size in the calibration"
    if abs(stored_px[1] - factor * expected[1]) <= 1:
        fix = (
            f"the images are {factor:.4g} times as large: import the images that were calibrated, or multiply width, "
            f"height, focal lengths and principal point of the calibration by {factor:.4g}"
        )
    raise InputError(
        "The image's size is not the camera's",
        where=view.image,
        expected=f"{expected[0]} x {expected[1]} px",
        got=f"{stored_px[0]} x {stored_px[1]} px",
        fix=fix,
    )


def _check_name(source: SourceCapture, view: SourceView, seen: set[str]) -> None:
    path = Path(view.name)
    defect = path_defect(view.name)
    if path.is_absolute() or ".." in path.parts or not path.name:
        defect = "no path below a folder"
    elif defect is None and view.name in seen:
        defect = "a name that another view has"
    if defect is not None:
        fix = "rename the image in the calibration"
        got = f"{view.name}: {defect}"
        raise InputError("A view cannot be named", where=source.root, expected="unique paths", got=got, fix=fix)
    seen.add(view.name)


def _check_camera(source: SourceCapture, view: SourceView) -> None:
    """Refuse a camera that is singular, mirrored or not rigid. Raises InputError."""

    def refuse(what: str, expected: str, got: object) -> InputError:
        where = f"{source.root}: view {view.name}"
        return InputError(what, where=where, expected=expected, got=got, fix="calibrate or export the camera again")

    K, R = view.intrinsics, view.T_cam_world[:3, :3]
    focals = np.array([K[0, 0], K[1, 1]])
    plain = np.allclose(K[[1, 2, 2], [0, 0, 1]], 0) and np.isclose(K[2, 2], 1)
    if not np.isfinite(K).all() or not (focals > 0).all() or not plain:
        expected = "finite intrinsics with focal lengths above 0 and last row 0 0 1"
        raise refuse("The intrinsics of a view are singular", expected, K.tolist())
    if not np.isfinite(view.T_cam_world).all():
        raise refuse("The pose of a view is not finite", "finite numbers", view.T_cam_world.tolist())
    wrong = np.abs(R @ R.T - np.eye(3)).max()
    if wrong > _ROTATION_TOLERANCE:
        got = f"a matrix whose rows differ from orthonormal ones by {wrong:.2g}"
        raise refuse("The pose of a view is not rigid", "a rotation", got)
    if np.linalg.det(R) < 0:
        raise refuse("The pose of a view is mirrored", "a rotation, determinant 1", "determinant -1")
    model = MODELS.get(view.distortion.model)
    count = len(view.distortion.coefficients)
    if model is None or count > len(model.names) or not np.isfinite(view.distortion.coefficients).all():
        raise refuse("The lens of a view is unknown", ", ".join(MODELS), f"{view.distortion.model}, {count} numbers")
