"""Heads of the tiny model seen by several cameras, for the tests of this room."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from registration.landmark_fit.observations import Observations, ViewCamera
from registration.model import gnm_npz
from registration.model.gnm_numpy import evaluate
from registration.model.landmarks import LandmarkScheme

FIXTURES = Path(__file__).parents[2] / "fixtures"


def tiny(correctives: bool = False) -> gnm_npz.GNMData:
    data = gnm_npz.read(FIXTURES / "tiny_gnm.npz")
    if not correctives:
        return data
    regressor = np.random.default_rng(5).normal(size=data.pose_correctives_regressor.shape) * 2e-3
    regressor[:9] = 0  # the root's rotation bends nothing
    return replace(data, pose_correctives_regressor=regressor.astype(np.float32))


def scheme(
    data: gnm_npz.GNMData, count: int = 150, seed: int = 0, *, spread_m: float | None = None, front: bool = False
) -> LandmarkScheme:
    random = np.random.default_rng(seed)
    triangles = data.triangles
    if front:
        corners = data.template_vertex_positions[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        triangles = triangles[normals[:, 2] > 0.5 * np.linalg.norm(normals, axis=1)]
    triangles = triangles[random.choice(len(triangles), count)]
    weights = random.dirichlet(np.ones(3), count)
    spread = None if spread_m is None else np.full(count, spread_m)
    return LandmarkScheme(name="points", indices=triangles.astype(np.int64), weights=weights, spread_m=spread)


def cameras(data: gnm_npz.GNMData, count: int, focal_px: float = 700.0) -> list[ViewCamera]:
    """Around the head, 0.6 m away, 512 px."""
    centre = data.template_vertex_positions.mean(0).astype(np.float64)
    views = []
    for k in range(count):
        yaw = 0.5 * (k - (count - 1) / 2)
        eye = centre + 0.6 * np.array([np.sin(yaw), 0, np.cos(yaw)])
        z = (centre - eye) / 0.6
        R = np.stack([np.cross([0, -1.0, 0], z), [0, -1.0, 0], z])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ eye
        views.append(ViewCamera(width_px=512, height_px=512, focal_px=focal_px, T_cam_world=T))
    return views


class Scene:
    """One subject in `frames` frames."""

    def __init__(self, data: gnm_npz.GNMData, points: LandmarkScheme, *, views: int, frames: int = 1, seed: int = 0):
        random = np.random.default_rng(seed)
        self.data, self.scheme, self.views = data, points, cameras(data, views)
        self.identity = random.normal(size=len(data.vertex_identity_basis))
        self.expression = random.normal(size=(frames, len(data.expression_basis))) * 0.5
        self.rotations = random.normal(size=(frames, len(data.joint_names), 3)) * 0.1
        self.translation = random.normal(size=(frames, 3)) * 0.01
        self.vertices = np.stack(
            [
                evaluate(data, identity=self.identity, expression=e, rotations=r, translation=t)
                for e, r, t in zip(self.expression, self.rotations, self.translation, strict=True)
            ]
        )

    def observations(
        self, *, sigma: float = 1.0, noise: float = 0.0, known: bool = True, poses: bool = True, seed: int = 0
    ) -> Observations:
        pixels = np.empty((len(self.vertices), len(self.views), len(self.scheme.indices), 2))
        for f, vertices in enumerate(self.vertices):
            for v, view in enumerate(self.views):
                assert view.T_cam_world is not None and view.focal_px is not None
                T = view.T_cam_world
                local = self.scheme.points(vertices) @ T[:3, :3].T + T[:3, 3]
                pixels[f, v] = view.focal_px * local[:, :2] / local[:, 2:] + 256
        pixels += np.random.default_rng(seed).normal(size=pixels.shape) * noise
        views = [
            replace(view, focal_px=view.focal_px if known else None, T_cam_world=view.T_cam_world if poses else None)
            for view in self.views
        ]
        return Observations(
            scheme=self.scheme, views=tuple(views), points_px=pixels, sigma_px=np.full(pixels.shape[:-1], float(sigma))
        )


def rotated(matrices: np.ndarray, seed: int, size: float = 0.2) -> np.ndarray:
    steps = np.random.default_rng(seed).normal(size=(*matrices.shape[:-2], 3)) * size
    turns = Rotation.from_rotvec(steps.reshape(-1, 3)).as_matrix().reshape(matrices.shape)
    return turns @ matrices
