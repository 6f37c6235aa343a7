"""Our lens models against COLMAP's own, and their inverse."""

import numpy as np
import pytest

from registration.capture.colmap import PosedImage
from registration.capture.colmap_model import PARAMETER_COUNTS, ColmapCamera
from registration.formats.colmap_lenses import lens_of
from registration.formats.distortions import MODELS, distort
from registration.formats.source import Distortion
from registration.formats.undistort import undistorted

FOCALS = (410.0, 400.0)
EXTRA = {
    "SIMPLE_RADIAL": (-0.1,),
    "RADIAL": (-0.1, 0.03),
    "OPENCV": (-0.1, 0.03, 0.002, -0.001),
    "FULL_OPENCV": (-0.1, 0.03, 0.002, -0.001, 0.01, 0.02, -0.01, 0.005),
    "OPENCV_FISHEYE": (0.05, -0.02, 0.01, -0.003),
    "FOV": (0.9,),
    "SIMPLE_RADIAL_FISHEYE": (0.05,),
    "RADIAL_FISHEYE": (0.05, -0.02),
    "THIN_PRISM_FISHEYE": (0.05, -0.02, 0.002, -0.001, 0.01, -0.003, 0.001, -0.002),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.05, -0.02, 0.01, -0.003, 1e-3, -1e-4, 2e-3, -1e-3, 1e-3, 2e-3, -1e-3, 5e-4),
    "SIMPLE_DIVISION": (-0.2,),
    "DIVISION": (-0.2,),
    "EUCM": (0.55, 1.1),
}
LENSES = [name for name in PARAMETER_COUNTS if name != "EQUIRECTANGULAR"]


def parameters(model: str) -> tuple[float, ...]:
    extra = EXTRA.get(model, ())
    two = PARAMETER_COUNTS[model] - len(extra) == 4
    return (*FOCALS[: 2 if two else 1], 320.0, 240.0, *extra)


def posed(model: str) -> PosedImage:
    camera = ColmapCamera(model=model, width_px=640, height_px=480, parameters=parameters(model), where="cameras.txt")
    return PosedImage(camera=camera, T_cam_world=np.eye(4), where="image a.png")


def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.concatenate([rng.uniform(-0.9, 0.9, (200, 2)), np.zeros((1, 2)), [[1e-7, -1e-7]]])


@pytest.mark.parametrize("model", LENSES)
def test_projection_is_that_of_colmap(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    intrinsics, lens = lens_of(posed(model))
    ours = distort(lens, points()) @ intrinsics[:2, :2].T + intrinsics[:2, 2]
    camera = pycolmap.Camera(model=model, width=640, height=480, params=list(parameters(model)))
    theirs = camera.img_from_cam(np.column_stack([points(), np.ones(len(points()))]))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
def test_the_inverse_leads_back(model: str) -> None:
    _, lens = lens_of(posed(model))
    np.testing.assert_allclose(undistorted(lens, distort(lens, points())), points(), atol=1e-8)


def test_points_that_a_lens_does_not_reach_have_no_inverse() -> None:
    fisheye = Distortion(model="opencv_fisheye")
    assert np.isnan(undistorted(fisheye, np.array([[1.7, 0.0]]))).all()  # beyond a right angle
    barrel = Distortion(model="opencv", coefficients=(-0.3,))
    assert np.isnan(undistorted(barrel, np.array([[0.9, 0.0]]))).all()  # beyond the turning point at 0.7


def test_a_division_lens_ends_where_its_root_does() -> None:
    assert np.isnan(distort(Distortion(model="division", coefficients=(0.3,)), np.array([[1.0, 0.0]]))).all()


@pytest.mark.parametrize("model", [name for name in MODELS if name not in ("eucm", "realityscan_division")])
def test_missing_coefficients_are_zero(model: str) -> None:
    """Of the other two, coefficients of 0 are lenses too, or none."""
    points = np.array([[0.3, 0.2], [0.0, 0.0]])
    count = len(MODELS[model].names)
    ours = distort(Distortion(model=model), points)
    np.testing.assert_array_equal(ours, distort(Distortion(model=model, coefficients=(0.0,) * count), points))
    assert np.abs(ours - points).max() < 0.02
