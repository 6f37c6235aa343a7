"""Visibility by rasterization, against rays that are cast at the same points."""

from __future__ import annotations  # mi.Float exists only after a variant is set

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh

from registration.render import backend, visibility
from registration.render.cameras import PixelList, upload
from registration.render.renderer import Renderer
from registration.render.shading import NO_FACE, rows, rows_of_four
from registration.types import Camera, Pixels

RADIUS_M = 0.1


@pytest.fixture(autouse=True)
def llvm() -> None:
    backend.activate()


def camera(yaw_rad: float, distance_m: float = 0.5) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(yaw_rad), 0, -np.sin(yaw_rad)], [0, -1, 0], [-np.sin(yaw_rad), 0, -np.cos(yaw_rad)]]
    pose[2, 3] = distance_m
    intrinsics = np.array([[400.0, 0, 97.3], [0, 410.0, 101.8], [0, 0, 1]])
    return Camera(width_px=200, height_px=190, intrinsics=intrinsics, T_cam_world=pose)


def shells() -> trimesh.Trimesh:
    """A dented ball with a smaller one inside and a large triangle that cuts through both."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_M)
    ball.vertices *= 1 + 0.1 * np.sin(40 * ball.vertices[:, :1])
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.7 * RADIUS_M)
    cut = trimesh.Trimesh([[-0.15, -0.02, 0.15], [0.2, 0.01, 0.1], [0.0, 0.02, -0.2]], [[0, 1, 2]])
    return trimesh.util.concatenate([ball, inner, cut])


def table(mesh: trimesh.Trimesh) -> tuple[mi.UInt32, mi.Float]:
    positions = rows_of_four(mi.Float(mesh.vertices.astype(np.float32).ravel()))
    return mi.UInt32(rows(mesh.faces.astype(np.uint32))), positions


def seen_by_rays(mesh: trimesh.Trimesh, pixels: PixelList, offset: tuple[float, float]) -> visibility.VisibleFaces:
    scene = Renderer(np.asarray(mesh.faces), np.zeros((len(mesh.faces), 3, 2)), np.ones((len(mesh.vertices), 1)))._scene
    scene.update_vertices(torch.as_tensor(np.asarray(mesh.vertices, np.float32)))
    hit = scene.cast_rays(*pixels.rays(offset), mi.Bool(True), coherent=True)
    face = dr.select(hit.is_valid(), hit.prim_index, NO_FACE)
    return visibility.VisibleFaces(face=face, depth=hit.t, b1=hit.prim_uv.x, b2=hit.prim_uv.y)


@pytest.mark.parametrize("offset", ((0.5, 0.5), (0.13, 0.77)))
def test_faces_are_those_that_rays_hit(offset: tuple[float, float]) -> None:
    mesh = shells()
    chosen = torch.rand(3, 190, 200, generator=torch.Generator().manual_seed(0)) < 0.7
    pixels = upload(Pixels.from_mask([camera(yaw_rad) for yaw_rad in (0.0, 1.2, -2.5)], chosen))
    ours, theirs = visibility.rasterize(*table(mesh), pixels, offset), seen_by_rays(mesh, pixels, offset)
    assert ours is not None
    faces = [seen.face.numpy() for seen in (ours, theirs)]
    same = (faces[0] == faces[1]) & (faces[0] != NO_FACE)
    assert (faces[0] != faces[1]).mean() < 2e-4 and same.mean() > 0.3  # at edges the two may round differently
    assert len(np.unique(faces[0][same])) > 3000 and len(mesh.faces) - 1 in faces[0]
    np.testing.assert_allclose(ours.depth.numpy()[same], theirs.depth.numpy()[same], rtol=2e-5)
    assert np.isinf(ours.depth.numpy()[faces[0] == NO_FACE]).all()
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[faces[0][same]]]
    points = [
        np.einsum("pk,pkc->pc", np.stack([1 - b1 - b2, b1, b2], 1), corners)
        for b1, b2 in ((seen.b1.numpy()[same], seen.b2.numpy()[same]) for seen in (ours, theirs))
    ]
    assert np.linalg.norm(points[0] - points[1], axis=1).max() < 2e-5


def test_no_pixel_falls_between_faces() -> None:
    """A closed ball of 20,480 faces has no holes, and nothing outside its outline."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_M)
    view = camera(0.3)
    pixels = Pixels.full([view])
    seen = visibility.rasterize(*table(mesh), upload(pixels), (0.5, 0.5))
    assert seen is not None
    y, x = np.mgrid[:190, :200] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.intrinsics).T
    miss_m = 0.5 * np.sqrt(1 - (rays[..., 2] / np.linalg.norm(rays, axis=-1)) ** 2)
    hit = pixels.image((torch.as_tensor(seen.face.numpy().astype(np.int64)) != NO_FACE).float()[:, None])[0, ..., 0]
    assert hit.numpy()[miss_m < 0.999 * RADIUS_M].all() and not hit.numpy()[miss_m > RADIUS_M].any()


def test_faces_beside_a_camera_are_left_to_rays() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS_M)
    pixels = upload(Pixels.full([camera(0.0), camera(0.0, distance_m=0.05)]))
    assert visibility.rasterize(*table(mesh), pixels, (0.5, 0.5)) is None
