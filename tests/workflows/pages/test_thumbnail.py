"""Pictures of registered heads."""

import cv2
import numpy as np

from tests.registration.report.test_page import a_registration
from workflows.pages.thumbnail import thumbnail


def test_a_thumbnail_shows_the_face_upright():
    """A square in four colours that looks out of the face (+Z); the capture's world frame is rotated."""
    corners = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]], np.float32)
    root = np.array([0.4, 0.9, -0.2], np.float32)
    uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)  # v is up: row 0 of the texture is on top
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    colours = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [0, 0, 0]]], np.float32)  # red green / blue black
    square = a_registration(
        vertices=corners @ cv2.Rodrigues(root.astype(float))[0].T.astype(np.float32) + np.float32(0.7),
        triangles=triangles,
        corner_uvs=uvs[triangles],
        texture=colours,
        rotations=root[None],
    )
    image = thumbnail(square)
    assert image is not None
    height, width, _ = image.shape
    centre, step = np.array([height // 2, width // 2]), width // 4
    for (row, column), colour in np.ndenumerate(np.array(["red", "green", "blue", "black"]).reshape(2, 2)):
        y, x = centre + step * (2 * np.array([row, column]) - 1)
        expected = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "black": (0, 0, 0)}[colour]
        assert np.abs(image[y, x].astype(int) - expected).max() < 40, (colour, image[y, x])
    assert image[4, 4].min() > 235
    assert thumbnail(a_registration(vertices=np.full((4, 3), np.nan, np.float32))) is None
