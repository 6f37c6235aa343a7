"""The GNM function at landmarks alone, float64, with derivatives [GNM, Model Formulation].

A landmark is a weighted mean of skinned vertices: sum_k w_k sum_j W_kj (R_j v_k + t_j). With the sums exchanged it is
sum_j (R_j m_j + W_j t_j), where m_j = sum_k w_k W_kj v_k is linear in the coefficients. A pair is a landmark and a
joint that moves it; most landmarks have one pair.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.model.gnm_npz import GNMData

_MIN_WEIGHT = 1e-9  # of a pair


@dataclass(frozen=True, kw_only=True, eq=False)
class Posed:
    """Points at one state, root at rest: its rotation and translation act on them afterwards."""

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
        """Pose the points, the root at rest.

        Args:
            identity: coefficients, as `identity_map` takes them.
            expression: coefficients, as `expression_map` takes them.
            joints: rotations relative to the parents; that of the root acts on pose correctives alone.
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
        rest = self.joint_positions(identity)
        chain, position = [np.eye(3)], [rest[0]]
        chain_by_identity = [self.joint_basis[0]]
        for j, parent in enumerate(self.parents[1:], start=1):
            bone = rest[j] - rest[parent]
            position.append(position[parent] + chain[parent] @ bone)
            chain_by_identity.append(
                chain_by_identity[parent] + chain[parent] @ (self.joint_basis[j] - self.joint_basis[parent])
            )
            chain.append(chain[parent] @ joints[j])
        feature = None
        if self.has_correctives:
            feature = (joints - np.eye(3)).ravel()
        points = np.zeros((3, count))
        identities = np.zeros((3, count, self.joint_basis.shape[2])) if by_identity else None
        expressions = np.zeros((3, count, len(expression))) if by_expression else None
        turned = np.zeros((3, count, 3 * self.joint_count)) if by_joints else None
        for part in self._joints:
            if where is None:
                own: slice | np.ndarray = slice(None)
                target: slice | np.ndarray = slice(None) if part.whole else part.rows
            else:
                own = np.flatnonzero(where[part.rows] >= 0)
                if not len(own):
                    continue
                target = where[part.rows[own]]
            j, R, weight = part.joint, chain[part.joint], part.weight[own]
            shift = position[j] - R @ rest[j]
            local_points = part.mean[:, own] + part.identity[:, own] @ identity + part.expression[:, own] @ expression
            if feature is not None and part.corrective is not None:
                local_points = local_points + part.corrective[:, own] @ feature
            moved = R @ local_points + weight * shift[:, None]
            points[:, target] += moved
            if identities is not None:
                shift_by_identity = chain_by_identity[j] - R @ self.joint_basis[j]
                basis = part.identity[:, own]
                identities[:, target] += (R @ basis.reshape(3, -1)).reshape(basis.shape)
                identities[:, target] += weight[:, None] * shift_by_identity[:, None]
            if expressions is not None:
                basis = part.expression[:, own]
                expressions[:, target] += (R @ basis.reshape(3, -1)).reshape(basis.shape)
            if turned is not None:
                self._add_turns(turned, target, j, moved, weight, chain, position)
                if part.corrective is not None:
                    self._add_corrective_turns(turned, target, part.corrective[:, own], R, joints)
        return Posed(points=points.T, by_identity=identities, by_expression=expressions, by_joints=turned)

    def _add_turns(self, turned, target, joint, moved, weight, chain, position) -> None:  # type: ignore[no-untyped-def]
        """Points on a joint turn with each of its ancestors but the root, about that one's position."""
        ancestor = joint
        while ancestor > 0:
            arm = moved - weight * position[ancestor][:, None]
            axes = chain[self.parents[ancestor]]  # columns: the axes of the turn
            turned[:, target, 3 * ancestor : 3 * ancestor + 3] += np.cross(
                axes.T[None, :, :], arm.T[:, None, :]
            ).transpose(2, 0, 1)
            ancestor = self.parents[ancestor]

    def _add_corrective_turns(self, turned, target, corrective, R, joints) -> None:  # type: ignore[no-untyped-def]
        for j in range(self.joint_count):
            for axis in range(3):
                unit = np.zeros(3)
                unit[axis] = 1
                change = np.cross(unit, joints[j].T).T  # d (exp(d) R) = [d]x R, column by column
                bind = corrective[:, :, 9 * j : 9 * j + 9] @ change.ravel()
                turned[:, target, 3 * j + axis] += R @ bind


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
    corrective: Float[np.ndarray, "3 P 9J"] | None


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
