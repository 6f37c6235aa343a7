"""What else the numbers of a camera may mean: poses in other conventions, and K of images of another size.

Poses of other conventions are rigid motions too, so only what the cameras see tells them apart. Each meaning is tried,
and the one with which the views agree is named.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.capture.text import listed
from registration.doctor.findings import Finding
from registration.doctor.fixes import CameraFix
from registration.types import Camera, Capture

Matrix = Float[np.ndarray, "4 4"]
_OFF_CENTRE, _CENTRED = 0.1, 0.07  # of the image's side: distance of a principal point from the middle
_SCALES = (2, 1 / 2, 4, 1 / 4, 3, 1 / 3, 3 / 2, 2 / 3, 4 / 3, 3 / 4)


def _pose(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Matrix:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes to OpenCV's


@runtime_checkable
class Witness(Protocol):
    """What the views show, as evidence for cameras."""

    @property
    def sure(self) -> float:
        """From where on cameras are right."""

    @property
    def better(self) -> float:
        """By how much others must be better than those that are given."""

    def __call__(self, cameras: Sequence[Camera]) -> float:
        """How well the cameras agree with it, 0 to 1."""


def _from_centre(T: Matrix) -> Matrix:
    return _pose(T[:3, :3], -T[:3, :3] @ T[:3, 3])


def _scalar_first(T: Matrix) -> Matrix:
    """The pose of a quaternion that was stored as x y z w and read as w x y z."""
    w, x, y, z = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return _pose(Rotation.from_quat([w, x, y, z]).as_matrix(), T[:3, 3])


@dataclass(frozen=True, kw_only=True)
class Misreading:
    """A convention that poses may have been written in, and how COLMAP's come from them."""

    kind: str  # of the finding
    name: str
    edit: str
    mend: Callable[[Matrix], Matrix]

    def camera(self, camera: Camera) -> Camera:
        """The camera with COLMAP's pose."""
        return replace(camera, T_cam_world=self.mend(camera.T_cam_world))


MISREADINGS = (
    Misreading(
        kind="poses-opengl",
        name="in OpenGL's camera axes (y up, z backwards)",
        edit="multiply each rotation and translation by diag(1, -1, -1) from the left",
        mend=lambda T: _FLIP @ T,
    ),
    Misreading(
        kind="poses-inverted",
        name="camera to world",
        edit="invert each pose: R' = transpose of R, t' = -R' t",
        mend=lambda T: np.linalg.inv(T),
    ),
    Misreading(
        kind="poses-inverted",
        name="camera to world in OpenGL's axes, as nerfstudio and Blender write them",
        edit="invert each pose and turn its axes: R' = diag(1, -1, -1) times the transpose of R, t' = -R' t",
        mend=lambda T: _FLIP @ np.linalg.inv(T),
    ),
    Misreading(
        kind="poses-centre",
        name="with the camera's centre in place of the translation",
        edit="write t' = -R t",
        mend=_from_centre,
    ),
    Misreading(
        kind="poses-centre",
        name="with the camera's centre in place of the translation, in OpenGL's axes",
        edit="write R' = diag(1, -1, -1) R and t' = -R' t",
        mend=lambda T: _from_centre(_pose(_FLIP[:3, :3] @ T[:3, :3], T[:3, 3])),
    ),
    Misreading(
        kind="poses-transposed",
        name="with transposed rotations",
        edit="transpose each rotation (negate x, y and z of the quaternion) and keep the translation",
        mend=lambda T: _pose(T[:3, :3].T, T[:3, 3]),
    ),
    Misreading(
        kind="poses-quaternion",
        name="with quaternions as x y z w",
        edit="write quaternions as w x y z",
        mend=_scalar_first,
    ),
    Misreading(
        kind="poses-turned",
        name="in PyTorch3D's axes (x to the left, y up), or of images that were turned by half",
        edit="multiply each rotation and translation by diag(-1, -1, 1) from the left, or turn the images",
        mend=lambda T: np.diag([-1.0, -1.0, 1.0, 1.0]) @ T,
    ),
)


def rescaled_intrinsics(capture: Capture) -> CameraFix | None:
    """K of images of another size, as principal points far from the middle suggest: cropped images have them too."""
    scales = {view.name: scale for view in capture.views if (scale := _scale(view.camera)) is not None}
    if not scales:
        return None
    common = max(set(scales.values()), key=list(scales.values()).count)
    names = [name for name, scale in scales.items() if scale == common]
    return CameraFix(
        what=f"multiplied fx, fy, cx and cy by {common:.3g}" + _of(names, capture),
        change=lambda camera: _rescaled(camera, common),
        views=names,
    )


def _scale(camera: Camera) -> float | None:
    """The factor that brings the principal point into the middle of the image, if it is a plain one."""
    centre = camera.intrinsics[:2, 2] / [camera.width_px, camera.height_px]
    if np.abs(centre - 0.5).max() <= _OFF_CENTRE:
        return None
    best = min(_SCALES, key=lambda scale: np.abs(scale * centre - 0.5).max())
    return best if np.abs(best * centre - 0.5).max() <= _CENTRED else None


def _rescaled(camera: Camera, scale: float) -> Camera:
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] *= scale
    return replace(camera, intrinsics=intrinsics)


def check_intrinsics(capture: Capture, witness: Witness) -> None:
    """Refuse K of images of another size, if with the scaled K the views agree better in any convention of poses.

    Raises:
        InputError: they do.
    """
    if (fix := rescaled_intrinsics(capture)) is None:
        return
    given = [view.camera for view in capture.views]
    changed = [view.camera for view in fix.on_capture(capture).views]
    as_written, scaled = best_agreement(given, witness), best_agreement(changed, witness)
    if scaled < witness.sure or scaled < as_written + witness.better:
        return
    one = next(view.camera for view in capture.views if fix.views is not None and view.name in fix.views)
    cx, cy = one.intrinsics[:2, 2]
    raise Finding(
        kind="intrinsics-scale",
        severity="error",
        where=str(capture.root / "sparse"),
        believed="K is that of images of another size" + _of(fix.views or (), capture),
        expected=f"fx, fy, cx and cy in pixels of the stored images, {one.width_px} x {one.height_px} px",
        evidence=f"a principal point at {cx:.0f}, {cy:.0f}; the views agree at {scaled:.0%} if K is scaled, at "
        f"{as_written:.0%} as written",
        mend=fix.what.replace("multiplied", "multiply"),
        fix=fix,
    ).error


def best_agreement(cameras: Sequence[Camera], witness: Witness) -> float:
    """The best agreement of all conventions of poses."""
    return max(agreement for agreement, _ in agreements(cameras, witness))


def agreements(cameras: Sequence[Camera], witness: Witness) -> list[tuple[float, Misreading | None]]:
    """How well cameras agree with a witness as they are (None), and in each other convention."""
    found: list[tuple[float, Misreading | None]] = [(witness(cameras), None)]
    return found + [(witness([m.camera(camera) for camera in cameras]), m) for m in MISREADINGS]


def _of(names: Collection[str], capture: Capture) -> str:
    return "" if len(names) == len(capture.views) else f" of {listed(list(names), 5)}"
