"""Where a landmark fit begins: the mean head, posed from each frame's and view's landmarks by linear equations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.landmark_fit.facing import check_facing, landmark_normals
from registration.landmark_fit.initial_pose import combined, orthographic, placed
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.state import State
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.types import HeadPose

_MIN_ANGLE = np.radians(3.0)  # between the rays of two views, for a position by intersection


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """Poses of the mean head in F frames and N views, and what is known of the cameras."""

    pivot: Float[np.ndarray, "3"]
    group: Int[np.ndarray, "N"]
    group_known: tuple[bool, ...]
    log_focal: Float[np.ndarray, "G"]
    centre_px: Float[np.ndarray, "N 2"]
    centre_known: tuple[bool, ...]  # of a calibrated view, whose lens does not distort
    pose_known: tuple[bool, ...]
    view_rotations: Float[np.ndarray, "N 3 3"]
    view_translations: Float[np.ndarray, "N 3"]
    rotations: Float[np.ndarray, "F 3 3"]
    positions: Float[np.ndarray, "F 3"]
    pixels_per_metre: float
    first_view: int  # whose pose is known or defines the world

    def at(self, poses: Sequence[HeadPose]) -> "Start":
        """The same with these poses of the head in the frames."""
        return replace(
            self,
            rotations=np.stack([pose.rotation for pose in poses]),
            positions=np.stack([pose.scale * pose.rotation @ self.pivot + pose.translation for pose in poses]),
        )

    def state(self, identity: Float[np.ndarray, "I"], expression_count: int, joint_count: int, scale: float) -> State:
        """The state of a head without expression."""
        frames = len(self.rotations)
        joints = np.tile(np.eye(3), (frames, joint_count, 1, 1))
        joints[:, 0] = self.rotations
        return State(
            identity=identity,
            log_size=float(np.log(scale)),
            log_focal=self.log_focal,
            principal_px=self.centre_px,
            k1=np.zeros(len(self.log_focal)),
            view_rotations=self.view_rotations,
            view_translations=self.view_translations,
            expression=np.zeros((frames, expression_count)),
            joints=joints,
            position=self.positions,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanHead:
    """The landmarks of the mean head, model frame."""

    points: Float[np.ndarray, "L 3"]  # metres
    normals: Float[np.ndarray, "L 3"]


def mean_head(scheme: LandmarkScheme, data: GNMData, options: FitOptions) -> MeanHead:
    """The head that a fit begins with: of a known identity, if there is one."""
    template = data.template_vertex_positions.astype(np.float64)
    if options.offsets is not None:
        template = template + options.offsets
    if options.identity is not None:
        template = template + np.tensordot(options.identity, data.vertex_identity_basis.astype(np.float64), 1)
    return MeanHead(points=scheme.points(template), normals=landmark_normals(scheme, data))


def start_poses(observations: Observations, mean: MeanHead, options: FitOptions) -> Start:
    """Pose the mean head in every frame.

    Args:
        observations: of one subject.
        mean: the mean head.
        options: the prior of focal lengths.

    Raises:
        InputError: a frame or a view cannot be posed, or landmarks are mirrored.
    """
    points = mean.points
    pivot = points[observations.seen.any((0, 1))].mean(0)
    views = observations.views
    group, known, log_focal = _focals(observations, options)
    centre = np.array([v.principal_px or (v.width_px / 2, v.height_px / 2) for v in views], np.float64)
    poses = [[orthographic(points, pixels, pivot) for pixels in frame] for frame in observations.points_px]
    check_facing(observations, mean.normals, poses)
    focal = np.exp(log_focal)[group]
    heads = [
        [None if pose is None else placed(pose, focal[v], centre[v]) for v, pose in enumerate(frame)] for frame in poses
    ]
    pose_known = [v.T_cam_world is not None for v in views]
    R = np.stack([np.eye(3) if v.T_cam_world is None else v.T_cam_world[:3, :3] for v in views]).astype(np.float64)
    t = np.stack([np.zeros(3) if v.T_cam_world is None else v.T_cam_world[:3, 3] for v in views]).astype(np.float64)
    if not any(pose_known):
        pose_known[_most_seen(observations)] = True  # this camera's frame is the world
    posed = list(pose_known)
    frames: list[tuple[np.ndarray, np.ndarray] | None] = [None] * len(poses)
    while True:
        for f, frame in enumerate(poses):
            if frames[f] is None:
                usable = [v for v in range(len(views)) if posed[v] and frame[v] is not None]
                if usable:
                    frames[f] = _in_world(usable, frame, heads[f], R, t, focal, centre)
        added = _pose_views(posed, frames, poses, heads, R, t)
        if not added:
            break
    _check_posed(frames, posed, observations)
    frames = _filled(frames)
    scales = [pose.scale_px for frame in poses for pose in frame if pose is not None]
    return Start(
        pivot=pivot,
        group=group,
        group_known=known,
        log_focal=log_focal,
        centre_px=centre,
        centre_known=tuple(view.principal_px is not None for view in views),
        pose_known=tuple(pose_known),
        view_rotations=R,
        view_translations=t,
        rotations=np.stack([frame[0] for frame in frames if frame is not None]),
        positions=np.stack([frame[1] for frame in frames if frame is not None]),
        pixels_per_metre=float(np.median(scales)),
        first_view=pose_known.index(True),
    )


def _focals(observations: Observations, options: FitOptions) -> tuple[np.ndarray, tuple[bool, ...], np.ndarray]:
    """Group of each view, whether the group's focal length is known, and its logarithm."""
    keys: list[object] = []
    known, values, group = [], [], []
    for i, view in enumerate(observations.views):
        key: object = ("unknown", view.group) if view.focal_px is None else ("known", i)
        if key not in keys:
            keys.append(key)
            known.append(view.focal_px is not None)
            guess = options.focal_guess * max(view.width_px, view.height_px)
            values.append(np.log(guess if view.focal_px is None else view.focal_px))
        group.append(keys.index(key))
    return np.array(group), tuple(known), np.array(values)


def _most_seen(observations: Observations) -> int:
    return int(observations.seen.any(-1).sum(0).argmax())


def _in_world(usable, poses, heads, R, t, focal, centre):  # type: ignore[no-untyped-def]
    """Rotation and position of the head in the world, from the views whose poses are known."""
    rotations = [R[v].T @ heads[v][0] for v in usable]
    # The angle of a pixel's error at the head decides how much a view counts.
    weights = [(poses[v].scale_px / max(poses[v].residual_px, 0.1)) ** 2 for v in usable]
    best = usable[int(np.argmax(weights))]
    position = R[best].T @ (heads[best][1] - t[best])
    rays = []
    for v in usable:
        ray = np.append((poses[v].position_px - centre[v]) / focal[v], 1.0)
        rays.append((-R[v].T @ t[v], R[v].T @ ray))
    directions = np.stack([ray / np.linalg.norm(ray) for _, ray in rays])
    if len(usable) > 1 and np.arccos(np.clip((directions @ directions.T).min(), -1, 1)) > _MIN_ANGLE:
        return combined(rotations, rays, weights)
    return Rotation.from_matrix(np.stack(rotations)).mean(weights).as_matrix(), position


def _pose_views(posed, frames, poses, heads, R, t) -> bool:  # type: ignore[no-untyped-def]
    """Pose views that see the head in a posed frame; whether there was one."""
    added = False
    for v in range(len(posed)):
        if posed[v]:
            continue
        both = [f for f, frame in enumerate(frames) if frame is not None and heads[f][v] is not None]
        if not both:
            continue
        f = min(both, key=lambda f: poses[f][v].residual_px / poses[f][v].scale_px)
        R[v] = heads[f][v][0] @ frames[f][0].T
        t[v] = heads[f][v][1] - R[v] @ frames[f][1]
        posed[v] = added = True
    return added


def _check_posed(frames: Sequence[object], posed: Sequence[bool], observations: Observations) -> None:
    if all(frame is None for frame in frames):
        raise InputError(
            "No image shows enough landmarks",
            where="all frames",
            expected="six landmarks or more in one view",
            got=f"{int(observations.seen.sum(-1).max())} at most",
            fix="use images that show the face",
        )


def _filled(frames: list) -> list:
    """Frames without a pose get that of the nearest one."""
    having = [f for f, frame in enumerate(frames) if frame is not None]
    return [frames[min(having, key=lambda g: abs(g - f))] for f in range(len(frames))]
