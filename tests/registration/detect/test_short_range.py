import numpy as np

from registration.detect import short_range
from registration.detect.short_range import Detection


def test_anchors() -> None:
    anchors = short_range.anchors()
    assert anchors.shape == (896, 2)
    np.testing.assert_allclose(anchors[:4], [[1 / 32, 1 / 32], [1 / 32, 1 / 32], [3 / 32, 1 / 32], [3 / 32, 1 / 32]])
    np.testing.assert_allclose(anchors[512:518], np.full((6, 2), 1 / 16))  # three layers of stride 16, two anchors each
    np.testing.assert_allclose(anchors[-1], 15 / 16)


def test_overlapping_boxes_are_one_face() -> None:
    points = np.zeros((3, 8, 2))
    points[:, 0], points[:, 1] = [[0, 0], [0.1, 0], [3, 3]], [[1, 1], [1.1, 1], [4, 4]]
    merged = short_range._merged(points, np.array([0.6, 0.9, 0.7]))
    assert [score for _, score in merged] == [0.9, 0.7]
    np.testing.assert_allclose(merged[0][0][0], [0.06, 0])  # weighted by the scores


def test_the_crop_is_upright() -> None:
    right, left = np.array([10.0, 10]), np.array([10.0, 30])  # the eyes one above the other
    key_points = np.stack([right, left, *np.zeros((4, 2))])
    detection = Detection(box=np.array([0.0, 0, 40, 40]), key_points=key_points, score=0.9)
    local = detection.crop(1.5).from_image(key_points[:2])
    np.testing.assert_allclose(local[0, 1], local[1, 1])
    assert local[0, 0] < local[1, 0] and detection.crop(1.5).side == 60
