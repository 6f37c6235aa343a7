"""The unknowns of a landmark fit, and how a step changes them."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.landmark_fit.landmark_model import turned


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """Values of all unknowns: R identity and Q expression coefficients in the reduced basis, N views, G focal groups.

    A point y of the posed model, anchor at rest, is at size * R @ (y - pivot) + position in the world, with R the first
    rotation of the joints.
    """

    identity: Float[np.ndarray, "R"]
    log_size: float
    log_focal: Float[np.ndarray, "G"]
    principal_px: Float[np.ndarray, "N 2"]
    k1: Float[np.ndarray, "G"]
    view_rotations: Float[np.ndarray, "N 3 3"]  # camera from world
    view_translations: Float[np.ndarray, "N 3"]
    expression: Float[np.ndarray, "F Q"]
    joints: Float[np.ndarray, "F J 3 3"]  # relative to the parents; the first is the anchor's in the world
    position: Float[np.ndarray, "F 3"]  # of the pivot, world, metres


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Columns of the unknowns: those of a frame are expression, joints, root, position."""

    identity: int
    groups: int
    views: int
    expression: int
    joints: int

    @property
    def local_names(self) -> tuple[tuple[str, int], ...]:
        """Blocks of a frame's columns, and their widths."""
        joints = 3 * (self.joints - 1)
        return (("expression", self.expression), ("joints", joints), ("root", 3), ("position", 3))

    @property
    def shared_names(self) -> tuple[tuple[str, int], ...]:
        """Blocks of the shared columns, and their widths."""
        return (
            ("identity", self.identity),
            ("size", 1),
            ("focal", self.groups),
            ("principal", 2 * self.views),
            ("k1", self.groups),
            ("poses", 6 * self.views),
        )

    def local(self, name: str) -> slice:
        """Columns of a frame's block."""
        return _columns(self.local_names, name)

    def shared(self, name: str) -> slice:
        """Columns of a shared block."""
        return _columns(self.shared_names, name)

    @property
    def local_count(self) -> int:
        """Width of a frame's blocks."""
        return sum(width for _, width in self.local_names)

    @property
    def shared_count(self) -> int:
        """Width of the shared blocks."""
        return sum(width for _, width in self.shared_names)


@dataclass(frozen=True, kw_only=True, eq=False)
class Free:
    """Which columns a stage estimates."""

    local: Int[np.ndarray, "n"]
    shared: Int[np.ndarray, "m"]


def free_columns(layout: Layout, local: Bool[np.ndarray, "n"], shared: Bool[np.ndarray, "m"]) -> Free:
    """Columns whose masks are true."""
    assert len(local) == layout.local_count and len(shared) == layout.shared_count
    return Free(local=np.flatnonzero(local), shared=np.flatnonzero(shared))


def moved(
    state: State,
    layout: Layout,
    free: Free,
    local_step: Float[np.ndarray, "F n"],
    shared_step: Float[np.ndarray, "m"],
) -> State:
    """The state after a step in the free columns; rotations are multiplied from the left."""
    local = np.zeros((len(state.expression), layout.local_count))
    local[:, free.local] = local_step
    shared = np.zeros(layout.shared_count)
    shared[free.shared] = shared_step
    joints = state.joints.copy()
    turns = local[:, layout.local("joints")].reshape(len(joints), layout.joints - 1, 3)
    joints[:, 1:] = turned(state.joints[:, 1:], turns)
    joints[:, 0] = turned(state.joints[:, 0], local[:, layout.local("root")])
    poses = shared[layout.shared("poses")].reshape(-1, 6)
    return replace(
        state,
        identity=state.identity + shared[layout.shared("identity")],
        log_size=state.log_size + float(shared[layout.shared("size")][0]),
        log_focal=state.log_focal + shared[layout.shared("focal")],
        principal_px=state.principal_px + shared[layout.shared("principal")].reshape(-1, 2),
        k1=state.k1 + shared[layout.shared("k1")],
        view_rotations=turned(state.view_rotations, poses[:, :3]),
        view_translations=state.view_translations + poses[:, 3:],
        expression=state.expression + local[:, layout.local("expression")],
        joints=joints,
        position=state.position + local[:, layout.local("position")],
    )


def _columns(names: tuple[tuple[str, int], ...], name: str) -> slice:
    start = 0
    for block, width in names:
        if block == name:
            return slice(start, start + width)
        start += width
    raise KeyError(name)
