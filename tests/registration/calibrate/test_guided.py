import cv2
import numpy as np
import pytest

from registration.calibrate.features import find_features, joined, match
from registration.calibrate.guided import FaceImage, guided_match
from tests.registration.calibrate.test_features import texture

SIZE = (260, 300)  # rows, columns
# From one photograph to the other: squeezed to a half across, sheared, as an oblique plane looks.
AFFINE = np.array([[0.45, 0.1, 60.0], [-0.25, 0.95, 60.0]])


def moved(points: np.ndarray) -> np.ndarray:
    return points @ AFFINE[:, :2].T + AFFINE[:, 2]


def pair(seen: np.ndarray | None = None) -> tuple[FaceImage, FaceImage]:
    """A texture and its image under the affine map; landmarks are a grid, off by up to a pixel."""
    generator = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(20, 280, 7), np.linspace(20, 240, 7)), -1).reshape(-1, 2)
    image = texture(5, SIZE)
    shift = AFFINE.copy()
    shift[:, 2] += AFFINE[:, :2] @ [0.5, 0.5] - 0.5  # OpenCV's first pixel has its centre at 0
    other = cv2.warpAffine(image, shift, SIZE[::-1], flags=cv2.INTER_AREA)
    used = np.ones(len(grid), bool) if seen is None else seen
    noisy = moved(grid) + generator.uniform(-1, 1, size=grid.shape)
    return (
        FaceImage(pixels=image, points=grid, seen=used, factor=1.0),
        FaceImage(pixels=other, points=noisy, seen=used, factor=2.0),
    )


def test_what_matches_only_when_warped_is_matched_where_it_is() -> None:
    a, b = pair()
    features_b = find_features(b.pixels, b.factor)
    found, pairs = guided_match(a, b, features_b)
    assert len(pairs) > 3 * len(match(find_features(a.pixels), features_b)) and len(pairs) > 60
    error = moved(found.xy_px[pairs[:, 0]]) - features_b.xy_px[pairs[:, 1]] / b.factor
    assert np.median(np.linalg.norm(error, axis=1)) < 0.5


@pytest.mark.parametrize("case", ["few landmarks are seen", "nothing to see", "behind"])
def test_faces_that_cannot_be_warped_have_no_matches(case: str) -> None:
    a, b = pair(np.arange(49) < 10 if case == "few landmarks are seen" else None)
    if case == "nothing to see":
        b = FaceImage(pixels=np.full_like(b.pixels, 90), points=b.points, seen=b.seen, factor=1.0)
    if case == "behind":
        b = FaceImage(pixels=b.pixels, points=b.points * [-1, 1] + [300, 0], seen=b.seen, factor=1.0)
    found, pairs = guided_match(a, b, find_features(b.pixels))
    assert len(pairs) == 0 and len(found.xy_px) == 0


def test_joined_features_keep_their_order() -> None:
    a, b = find_features(texture(1)), find_features(texture(2))
    both = joined(a, b)
    np.testing.assert_array_equal(both.xy_px[len(a.xy_px) :], b.xy_px)
    assert len(both.sigma_px) == len(both.descriptors) == len(a.xy_px) + len(b.xy_px)
