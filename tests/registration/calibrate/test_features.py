import numpy as np
import pytest

from registration.calibrate.features import MIN_MATCHES, Features, find_features, match, mirrored, tracks


def texture(seed: int, size: tuple[int, int] = (200, 260)) -> np.ndarray:
    """Blobs of random brightness, colours equal."""
    import cv2

    generator = np.random.default_rng(seed)
    image = np.zeros(size)
    for sigma in (2, 4, 8):
        image += cv2.GaussianBlur(generator.normal(size=size), (0, 0), sigma) * sigma
    image = (image - image.min()) / (image.max() - image.min())
    return np.repeat((255 * image)[..., None], 3, axis=-1).astype(np.uint8)


def shifted(image: np.ndarray, x: int, y: int) -> np.ndarray:
    return np.roll(image, (y, x), axis=(0, 1))


def test_positions_count_from_the_corner_and_in_pixels_of_the_file() -> None:
    blob = np.exp(-((np.arange(64)[:, None] - 21) ** 2 + (np.arange(64) - 41) ** 2) / 18)  # around (41.5, 21.5)
    image = np.repeat((30 + 190 * blob)[..., None], 3, axis=-1).astype(np.uint8)
    small, large = find_features(image), find_features(image, 2.0)
    nearest = small.xy_px[np.linalg.norm(small.xy_px - [41.5, 21.5], axis=1).argmin()]
    np.testing.assert_allclose(nearest, [41.5, 21.5], atol=0.2)
    np.testing.assert_allclose(large.xy_px, 2 * small.xy_px)
    np.testing.assert_allclose(large.sigma_px, 2 * small.sigma_px)


def test_an_image_without_texture_has_no_features() -> None:
    flat = find_features(np.full((64, 64, 3), 128, np.uint8))
    assert len(flat.xy_px) == 0 and len(match(flat, find_features(texture(0)))) == 0


def test_a_shifted_image_matches_at_the_shift() -> None:
    image = texture(1)
    a, b = find_features(image), find_features(shifted(image, 13, -7))
    pairs = match(a, b)
    assert len(pairs) > 50
    moved = b.xy_px[pairs[:, 1]] - a.xy_px[pairs[:, 0]]
    assert np.mean(np.abs(moved - [13, -7]).max(1) < 1.0) > 0.95


def test_images_of_different_things_do_not_match() -> None:
    assert len(match(find_features(texture(2)), find_features(texture(3)))) == 0


def test_mirrored_features_match_the_mirrored_image() -> None:
    image = texture(4)
    turned = find_features(np.ascontiguousarray(image[:, ::-1]))
    plain = find_features(image)
    assert len(match(turned, plain)) < 3 * MIN_MATCHES  # round blobs
    pairs = match(mirrored(turned), plain)
    assert len(pairs) > 50 * MIN_MATCHES
    x = turned.xy_px[pairs[:, 0], 0] + plain.xy_px[pairs[:, 1], 0]
    np.testing.assert_allclose(np.median(x), image.shape[1], atol=0.1)


def features(count: int) -> Features:
    return Features(
        xy_px=np.zeros((count, 2)), sigma_px=np.ones(count), descriptors=np.zeros((count, 128), np.float32), factor=1.0
    )


def test_matches_join_to_tracks() -> None:
    found = tracks([features(5)] * 3, {(0, 1): np.array([[0, 1], [2, 2]]), (1, 2): np.array([[1, 4]])})
    view, feature, track = found
    assert sorted(zip(track.tolist(), view.tolist(), feature.tolist(), strict=True)) in (
        [(0, 0, 0), (0, 1, 1), (0, 2, 4), (1, 0, 2), (1, 1, 2)],
        [(0, 0, 2), (0, 1, 2), (1, 0, 0), (1, 1, 1), (1, 2, 4)],
    )


@pytest.mark.parametrize("joined", [np.array([[1, 0]]), np.zeros((0, 2), np.int64)])
def test_two_features_of_one_view_are_no_image_of_a_point(joined: np.ndarray) -> None:
    """Features 0 and 1 of view 0 both match feature 0 of view 1."""
    view, feature, track = tracks(
        [features(3)] * 3, {(0, 1): np.array([[0, 0], [1, 0]]), (1, 2): np.array([[0, 2]]), (0, 2): joined[:0]}
    )
    assert view.tolist() == [1, 2] and feature.tolist() == [0, 2] and track.tolist() == [0, 0]


def test_without_matches_there_are_no_tracks() -> None:
    assert all(len(part) == 0 for part in tracks([features(3)] * 2, {}))
