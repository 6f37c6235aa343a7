"""A subject's page and its thumbnails."""

import base64
import re

import cv2
import numpy as np

from tests.registration.report.test_page import a_registration
from workflows.pages.subject import render_subject_page, thumbnail
from workflows.records.subject import CaptureRow, SubjectRecord


def a_subject(*rows: CaptureRow) -> SubjectRecord:
    return SubjectRecord(subject="a<b>", model="ab" * 32, recipe="draft", neutral="rest", rows=rows)


def test_the_page_shows_every_row_and_is_self_contained():
    figures = {"scan_to_mesh": {"face": {"mean_mm": 0.1234, "median_mm": 0.0456}}, "drift": {"face": {"mean_mm": 0.5}}}
    page = render_subject_page(
        a_subject(
            CaptureRow(
                name="rest", expression="neutral", status="converged", figures=figures, seconds=66.4, folder="rest"
            ),
            CaptureRow(name="big <smile>", expression="x&y", status="failed", reason="<off>", folder="big <smile>"),
            CaptureRow(name="gone", expression="gone", status="error", reason="lost"),
            CaptureRow(name="later", expression="later"),
        ),
        {"rest": "data:image/jpeg;base64,AAAA"},
    )
    assert "<b>" not in page and "<smile>" not in page and "<off>" not in page
    assert "a&lt;b&gt;" in page and "x&amp;y" in page and "&lt;off&gt;" in page
    for text in ("0.123", "0.046", "0.500", "66 s", "lost", "1 of 4", "1 is waiting"):
        assert text in page, text
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert set(links) == {"data:image/jpeg;base64,AAAA", "rest/report.html", "big%20%3Csmile%3E/report.html"}
    assert not re.search("<script|@import|url", page)
    rows = page.split("<tr>")
    assert "waiting" in rows[-1] and "href" not in rows[-1] and "href" not in rows[-2]


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
    encoded = base64.b64decode(thumbnail(square).removeprefix("data:image/jpeg;base64,"))
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    height, width, _ = image.shape
    centre, step = np.array([height // 2, width // 2]), width // 4
    for (row, column), colour in np.ndenumerate(np.array(["red", "green", "blue", "black"]).reshape(2, 2)):
        y, x = centre + step * (2 * np.array([row, column]) - 1)
        expected = {"red": (255, 0, 0), "green": (0, 255, 0), "blue": (0, 0, 255), "black": (0, 0, 0)}[colour]
        assert np.abs(image[y, x].astype(int) - expected).max() < 40, (colour, image[y, x])
    assert image[4, 4].min() > 235
    assert thumbnail(a_registration(vertices=np.full((4, 3), np.nan, np.float32))) is None
