"""The GNM function at landmarks alone, float64, with derivatives [GNM, Model Formulation].

A landmark is a weighted mean of skinned vertices: sum_k w_k sum_j W_kj (R_j v_k + t_j). With the sums exchanged it is
sum_j (R_j m_j + W_j t_j), where m_j = sum_k w_k W_kj v_k is linear in the coefficients. A pair is a landmark and a
joint that moves it; most landmarks have one pair.

Points are returned in the frame of one joint, the anchor: that of most of the points. The head then stays where it is
when it turns relative to the neck, which landmarks of the face do not see.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from registration.model.gnm_npz import GNMData

_MIN_WEIGHT = 1e-9  # of a pair
_MOST = 0.7  # of the points


@dataclass(frozen=True, kw_only=True, eq=False)
class Posed:
    """Points at one state, the anchor at rest: its rotation and translation act on them afterwards."""

    points: Float[np.ndarray, "L 3"]
    by_identity: Float[np.ndarray, "3 L I"] | None
    by_expression: Float[np.ndarray, "3 L E"] | None
    by_joints: Float[np.ndarray, "3 L C"] | None  # C = 3 J; left rotations in the parent's frame


class LandmarkModel:
    """Points of a head model, each the weighted mean of a few vertices, as functions of the model's parameters.

    Args:
        data: the model.
        indices: vertices of each point.
        weights: of these.
        identity_map: columns are unit vectors of the identity coefficients to be used, raw = map @ coefficients.
        expression_map: the same of the expression coefficients.
        expression_mean: raw coefficients where those to be used are zero.
        offsets: of the bind pose, metres; None: zero.
        anchor: the joint that is at rest; None: that which moves most of the points.
    """

    def __init__(
        self,
        data: GNMData,
        indices: np.ndarray,
        weights: np.ndarray,
        *,
        identity_map: Float[np.ndarray, "I R"] | None = None,
        expression_map: Float[np.ndarray, "E Q"] | None = None,
        expression_mean: Float[np.ndarray, "E"] | None = None,
        offsets: Float[np.ndarray, "V 3"] | None = None,
        anchor: int | None = None,
    ):
        skinning = data.skinning_weights.astype(np.float64)
        skinning = skinning / skinning.sum(0)
        of_joint = np.einsum("lk,jlk->lj", weights, skinning[:, indices])
        self.count, joints = of_joint.shape
        self.parents = data.joint_parent_indices.tolist()
        template = data.template_vertex_positions.astype(np.float64)
        if offsets is not None:
            template = template + offsets
        regressor = data.pose_correctives_regressor
        corrective = regressor.reshape(9 * joints, -1, 3) if regressor.any() else None
        self.joint_mean = data.template_joint_positions.astype(np.float64)
        joint_basis = data.joint_identity_basis.astype(np.float64)
        self.joint_basis = _mapped(joint_basis.transpose(1, 2, 0), identity_map)  # J 3 I
        self._joints: list[_OfJoint] = []
        for j in range(joints):
            rows = np.flatnonzero(np.einsum("lk,lk->l", np.abs(weights), skinning[j][indices]) > _MIN_WEIGHT)
            if not len(rows):
                continue
            if len(rows) > _MOST * self.count:  # sums over all points are faster than over chosen ones
                rows = np.arange(self.count)
            vertices, share = indices[rows], weights[rows] * skinning[j][indices[rows]]

            def carried(basis: np.ndarray, vertices: np.ndarray = vertices, share: np.ndarray = share) -> np.ndarray:
                """(K, V, 3) -> (3, rows, K)"""
                return np.einsum("lk,clkd->dlc", share, basis[:, vertices].astype(np.float64), optimize=True)

            mean = np.einsum("lk,lkd->dl", share, template[vertices])
            expression = carried(data.expression_basis)
            if expression_mean is not None:
                mean = mean + expression @ expression_mean
            self._joints.append(
                _OfJoint(
                    joint=j,
                    rows=rows,
                    whole=len(rows) == self.count,
                    weight=of_joint[rows, j],
                    mean=mean,
                    identity=_mapped(carried(data.vertex_identity_basis), identity_map),
                    expression=_mapped(expression, expression_map),
                    corrective=None if corrective is None else carried(corrective),
                )
            )
        self.anchor = int(of_joint.sum(0).argmax()) if anchor is None else anchor
        self._joints.sort(key=lambda part: not part.whole)
        self.joint_count = joints
        self.has_correctives = corrective is not None

    def joint_positions(self, identity: Float[np.ndarray, "I"]) -> Float[np.ndarray, "J 3"]:
        """Joints in the bind pose, metres."""
        return self.joint_mean + self.joint_basis @ identity

    def __call__(
        self,
        identity: Float[np.ndarray, "I"],
        expression: Float[np.ndarray, "E"],
        joints: Float[np.ndarray, "J 3 3"],
        *,
        rows: np.ndarray | None = None,
        by_identity: bool = False,
        by_expression: bool = False,
        by_joints: bool = False,
    ) -> Posed:
        """Pose the points, the anchor at rest.

        Args:
            identity: coefficients, as `identity_map` takes them.
            expression: coefficients, as `expression_map` takes them.
            joints: rotations relative to the parents; the first is the anchor's in the world, on which pose correctives
                alone depend here.
            rows: points that count, sorted; None: all.
            by_identity: return these derivatives.
            by_expression: return these derivatives.
            by_joints: return these derivatives, for R_j <- exp(d) R_j.
        """
        count = self.count if rows is None else len(rows)
        where = None
        if rows is not None:
            where = np.full(self.count, -1)
            where[rows] = np.arange(count)
        chain = self._chain(identity, joints)
        points: np.ndarray | None = None
        identities: np.ndarray | None = None
        expressions: np.ndarray | None = None
        turned = np.zeros((3, count, 3 * self.joint_count)) if by_joints else None
        for part in self._joints:
            if where is None:
                own: slice | np.ndarray = slice(None)
                target: slice | np.ndarray = slice(None) if part.whole else part.rows
            else:
                own = np.flatnonzero(where[part.rows] >= 0)
                if not len(own):
                    continue
                target = slice(None) if len(own) == count else where[part.rows[own]]
                own = _slice(own)
            R, weight = chain.rotations[part.joint], part.weight[own]
            moved = R @ part.local(identity, expression, chain.feature, own) + weight * chain.shift(part.joint)[:, None]
            points = _added(points, target, count, moved)
            if by_identity:
                basis = part.identity[:, own]
                turned_basis = (R @ basis.reshape(3, -1)).reshape(basis.shape)
                turned_basis += weight[:, None] * chain.shift_by_identity(part.joint)[:, None]
                identities = _added(identities, target, count, turned_basis)
            if by_expression:
                basis = part.expression[:, own]
                expressions = _added(expressions, target, count, (R @ basis.reshape(3, -1)).reshape(basis.shape))
            if turned is not None:
                for joint, axes in self._turning(part.joint, chain):
                    arm = moved - weight * chain.positions[joint][:, None]
                    turns = np.cross(axes.T[None, :, :], arm.T[:, None, :]).transpose(2, 0, 1)
                    turned[:, target, 3 * joint : 3 * joint + 3] += turns
                if part.corrective is not None:
                    by_local = _corrective_turns(part.corrective[:, own], joints)
                    turned[:, target] += (R @ by_local.reshape(3, -1)).reshape(by_local.shape)
        assert points is not None
        return Posed(points=points.T, by_identity=identities, by_expression=expressions, by_joints=turned)

    def subset(self, rows: np.ndarray) -> "LandmarkModel":
        """The model of some of the points.

        Args:
            rows: of the points, sorted.
        """
        result = copy(self)
        result.count, result._joints = len(rows), []
        for part in self._joints:
            _, own, target = np.intersect1d(part.rows, rows, assume_unique=True, return_indices=True)
            if len(own):
                result._joints.append(
                    replace(
                        part,
                        rows=target,
                        whole=len(own) == len(rows),
                        weight=part.weight[own],
                        mean=part.mean[:, own],
                        identity=part.identity[:, own],
                        expression=part.expression[:, own],
                        corrective=None if part.corrective is None else part.corrective[:, own],
                    )
                )
        return result

    def pulled_back(
        self,
        identity: Float[np.ndarray, "I"],
        expression: Float[np.ndarray, "E"],
        joints: Float[np.ndarray, "J 3 3"],
        forces: Float[np.ndarray, "L 3"],
    ) -> tuple[Float[np.ndarray, "I"], Float[np.ndarray, "E"], Float[np.ndarray, "C"]]:
        """Gradients of sum(forces * points) by identity, expression and joints, without the matrices of derivatives.

        Args:
            identity: coefficients.
            expression: coefficients.
            joints: rotations relative to the parents.
            forces: gradient of a function by the points.
        """
        chain = self._chain(identity, joints)
        by_identity, by_expression = np.zeros(len(identity)), np.zeros(len(expression))
        by_joints = np.zeros(3 * self.joint_count)
        for part in self._joints:
            R, weight, own = chain.rotations[part.joint], part.weight, forces[part.rows].T
            local = R.T @ own
            flat = local.ravel()
            by_identity += flat @ part.identity.reshape(len(flat), -1)
            by_identity += (own @ weight) @ chain.shift_by_identity(part.joint)
            by_expression += flat @ part.expression.reshape(len(flat), -1)
            moved = R @ part.local(identity, expression, chain.feature) + weight * chain.shift(part.joint)[:, None]
            for joint, axes in self._turning(part.joint, chain):
                arm = moved - weight * chain.positions[joint][:, None]
                by_joints[3 * joint : 3 * joint + 3] += axes.T @ np.cross(arm.T, own.T).sum(0)
            if part.corrective is not None:
                by_joints += np.einsum("dp,dpc->c", local, _corrective_turns(part.corrective, joints))
        return by_identity, by_expression, by_joints

    def _chain(self, identity: np.ndarray, joints: np.ndarray) -> "_Chain":
        rest = self.joint_positions(identity)
        rotations, positions, by_identity = [np.eye(3)], [rest[0]], [self.joint_basis[0]]
        for j, parent in enumerate(self.parents[1:], start=1):
            above = rotations[parent]
            positions.append(positions[parent] + above @ (rest[j] - rest[parent]))
            by_identity.append(by_identity[parent] + above @ (self.joint_basis[j] - self.joint_basis[parent]))
            rotations.append(above @ joints[j])
        back, origin, origin_by_identity = rotations[self.anchor].T, positions[self.anchor], by_identity[self.anchor]
        feature = None
        if self.has_correctives:
            local = joints.copy()
            local[0] = joints[0] @ back
            feature = (local - np.eye(3)).ravel()
        at = self.joint_basis[self.anchor]
        return _Chain(
            rest=rest,
            rest_by_identity=self.joint_basis,
            rotations=[back @ R for R in rotations],
            positions=[back @ (p - origin) + rest[self.anchor] for p in positions],
            positions_by_identity=[back @ (d - origin_by_identity) + at for d in by_identity],
            feature=feature,
        )

    def root(
        self, identity: Float[np.ndarray, "I"], joints: Float[np.ndarray, "J 3 3"]
    ) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """Rotation and translation that bring the pose with the anchor at rest to that with the root at rest."""
        rest = self.joint_positions(identity)
        R, position = np.eye(3), rest[0]
        for j in reversed(list(self._path(self.anchor))):
            position = position + R @ (rest[j] - rest[self.parents[j]])
            R = R @ joints[j]
        return R, position - R @ rest[self.anchor]

    def _path(self, joint: int) -> Iterator[int]:
        """A joint and its ancestors, without the root."""
        while joint > 0:
            yield joint
            joint = self.parents[joint]

    def _turning(self, joint: int, chain: "_Chain") -> Iterator[tuple[int, np.ndarray]]:
        """Joints whose turns move the points of `joint` relative to the anchor, and the axes, as columns."""
        own, of_anchor = set(self._path(joint)), set(self._path(self.anchor))
        for j in own - of_anchor:
            yield j, chain.rotations[self.parents[j]]
        for j in of_anchor - own:
            yield j, -chain.rotations[self.parents[j]]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Chain:
    """The joints at one state, the anchor at rest."""

    rest: Float[np.ndarray, "J 3"]
    rest_by_identity: Float[np.ndarray, "J 3 I"]
    rotations: list[np.ndarray]
    positions: list[np.ndarray]
    positions_by_identity: list[np.ndarray]
    feature: Float[np.ndarray, "_"] | None  # of pose correctives

    def shift(self, joint: int) -> Float[np.ndarray, "3"]:
        """Translation of the points that turn with a joint."""
        return self.positions[joint] - self.rotations[joint] @ self.rest[joint]

    def shift_by_identity(self, joint: int) -> Float[np.ndarray, "3 I"]:
        """Its derivatives."""
        return self.positions_by_identity[joint] - self.rotations[joint] @ self.rest_by_identity[joint]


@dataclass(frozen=True, kw_only=True, eq=False)
class _OfJoint:
    """The points that one joint moves."""

    joint: int
    rows: np.ndarray
    whole: bool  # rows are all points
    weight: Float[np.ndarray, "P"]
    mean: Float[np.ndarray, "3 P"]
    identity: Float[np.ndarray, "3 P I"]
    expression: Float[np.ndarray, "3 P E"]
    corrective: Float[np.ndarray, "3 P _"] | None

    def local(
        self, identity: np.ndarray, expression: np.ndarray, feature: np.ndarray | None, own: Any = slice(None)
    ) -> Float[np.ndarray, "3 P"]:
        """Points in the bind pose, with pose correctives, times their weights."""
        points = self.mean[:, own] + self.identity[:, own] @ identity + self.expression[:, own] @ expression
        return points if feature is None or self.corrective is None else points + self.corrective[:, own] @ feature


def _slice(rows: Int[np.ndarray, "N"]) -> slice | np.ndarray:
    """Sorted rows as a slice, which needs no copy, if none is left out between them."""
    return slice(rows[0], rows[-1] + 1) if rows[-1] - rows[0] + 1 == len(rows) else rows


def _added(total: np.ndarray | None, target: Any, count: int, part: np.ndarray) -> np.ndarray:
    """The sum over joints; the part itself if it is the first and of all points."""
    if isinstance(target, slice):
        return part if total is None else total + part
    if total is None:
        total = np.zeros((3, count, *part.shape[2:]))
    total[:, target] += part
    return total


def _corrective_turns(corrective: Float[np.ndarray, "3 P _"], joints: np.ndarray) -> Float[np.ndarray, "3 P _"]:
    """Derivatives of pose correctives by left rotations: d (exp(d) R) = [d]x R."""
    result = np.empty((*corrective.shape[:2], 3 * len(joints)))
    for j, joint in enumerate(joints):
        for axis, unit in enumerate(np.eye(3)):
            change = np.cross(unit, joint.T).T
            result[:, :, 3 * j + axis] = corrective[:, :, 9 * j : 9 * j + 9] @ change.ravel()
    return result


def _mapped(basis: np.ndarray, columns: np.ndarray | None) -> np.ndarray:
    return basis if columns is None else basis @ columns


def turned(rotations: Float[np.ndarray, "*B 3 3"], steps: Float[np.ndarray, "*B 3"]) -> Float[np.ndarray, "*B 3 3"]:
    """exp(steps) @ rotations."""
    turns = Rotation.from_rotvec(steps.reshape(-1, 3)).as_matrix().reshape(rotations.shape)
    return turns @ rotations


def differences(a: Float[np.ndarray, "*B 3 3"], b: Float[np.ndarray, "*B 3 3"]) -> Float[np.ndarray, "*B 3"]:
    """log(a @ b^T), radians."""
    between = a @ np.swapaxes(b, -1, -2)
    return Rotation.from_matrix(between.reshape(-1, 3, 3)).as_rotvec().reshape(between.shape[:-1])
