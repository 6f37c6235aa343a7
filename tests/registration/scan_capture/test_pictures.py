"""Colours of a scan at the pixels of a view: interpolated at its vertices, or looked up in its texture."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from registration.errors import InputError
from registration.geometry.surface_views import SurfaceViews
from registration.scan_capture.hygiene import clean
from registration.scan_capture.pictures import Colours, camera_normals
from registration.scan_capture.rig import head_cameras
from registration.storage.mesh_files import MeshFile

BALL = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
POINTS, FACES = np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces)
CAMERA = head_cameras(np.zeros(3), np.eye(3), 1.0, size_px=96)["view00_yaw+000_up+00"]


def expected(points: np.ndarray) -> np.ndarray:
    """A colour for each place."""
    return 0.5 + 4 * points


def picture(mesh: MeshFile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The picture, and at the pixels of the ball their places."""
    scan = clean(mesh, Path("scan.obj"))[0]
    view = SurfaceViews(scan.vertices, scan.triangles, [CAMERA]).view(CAMERA)
    hit = view.face >= 0
    corners = scan.vertices[scan.triangles[view.face[hit]]]
    return Colours(scan).of(view, CAMERA), hit, np.einsum("pk,pkc->pc", view.barycentric[hit], corners)


def test_vertex_colours() -> None:
    rgb, hit, places = picture(MeshFile(vertices=POINTS, triangles=FACES, colours=expected(POINTS)))
    np.testing.assert_allclose(rgb[hit], expected(places), atol=1e-9)
    assert (rgb[~hit] < 0.1).all() and 1000 < hit.sum() < 9000


@pytest.mark.parametrize("as_file", [False, True])
def test_a_texture_with_its_rows_from_the_top(tmp_path: Path, as_file: bool) -> None:
    size = 256
    uvs = POINTS[FACES][..., :2] * 4 + 0.5  # of x and y: red grows with u, green with v
    u, v = (np.arange(size) + 0.5) / size, 1 - (np.arange(size) + 0.5) / size
    pixels = np.stack([*np.broadcast_arrays(u[None], v[:, None]), np.full((size, size), 0.25)], -1)
    texture: Path | np.ndarray = np.round(255 * pixels).astype(np.uint8)
    if as_file:
        cv2.imwrite(str(tmp_path / "skin.png"), np.asarray(texture)[..., ::-1])
        texture = tmp_path / "skin.png"
    mesh = MeshFile(
        vertices=POINTS,
        triangles=FACES,
        corner_uvs=uvs,
        face_textures=np.zeros(len(FACES), np.int64),
        textures=(texture,),
    )
    rgb, hit, places = picture(mesh)
    np.testing.assert_allclose(rgb[hit][:, :2], expected(places)[:, :2], atol=6e-3)
    np.testing.assert_allclose(rgb[hit][:, 2], 0.25, atol=6e-3)


def test_a_bare_scan_is_grey_and_brighter_where_it_faces_the_camera() -> None:
    rgb, hit, _ = picture(MeshFile(vertices=POINTS, triangles=FACES))
    assert (np.ptp(rgb, axis=-1) == 0).all()
    assert rgb[48, 48, 0] > 0.8 and rgb[hit].min() < 0.4


def test_a_damaged_texture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "skin.png").write_bytes(b"\x89PNG nothing")
    mesh = MeshFile(
        vertices=POINTS,
        triangles=FACES,
        corner_uvs=np.zeros((len(FACES), 3, 2)),
        face_textures=np.zeros(len(FACES), np.int64),
        textures=(tmp_path / "skin.png",),
    )
    with pytest.raises(InputError, match="texture"):
        picture(mesh)


def test_normals_are_in_the_cameras_frame_and_nothing_where_faces_do_not_count() -> None:
    view = SurfaceViews(POINTS, FACES, [CAMERA]).view(CAMERA)
    counted = POINTS[FACES].mean(1)[:, 0] > 0
    normals = camera_normals(view, CAMERA, counted)
    assert normals[48, 60, 2] < -0.9 and (normals[:, :40] == 0).all()
    assert np.isin(np.linalg.norm(normals, axis=-1).round(6), (0, 1)).all()
