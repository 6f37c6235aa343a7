"""A head model on the face alone, as [GNM, Intrinsic Evaluation of GNM] fits it: identity, expression, joints.

With the joints at rest a model is linear. Joints that move the face as a whole add nothing to the rigid motion, which
is part of every fit; only a joint that deforms the face, such as FLAME's jaw, needs an `Articulation`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from coregister.evaluate.linear_fit import pseudo_inverse
from registration.linear_models.data import LinearModelData
from registration.linear_models.model import LinearModel
from registration.types import Parameters

IDENTITY = "identity"  # key of `FaceModel.components`


@dataclass(frozen=True, kw_only=True, eq=False)
class Articulation:
    """The face of a model whose joints deform it."""

    data: LinearModelData  # the vertices and components of the face alone
    free: tuple[int, ...]  # joints that a fit rotates

    @cached_property
    def model(self) -> LinearModel:
        """The model in torch."""
        return LinearModel(self.data, torch.float64)

    def parameters(self, coefficients: Float[np.ndarray, "K"], angles: Float[np.ndarray, "A 3"]) -> Parameters:
        """Return the parameters of the model."""
        neutral, identity = self.model.neutral(), len(self.data.identity_basis)
        rotations = neutral.rotations.clone()
        rotations[list(self.free)] = torch.from_numpy(angles)
        values = torch.from_numpy(coefficients)
        return replace(neutral, identity=values[:identity], expression=values[identity:], rotations=rotations)


@dataclass(frozen=True, kw_only=True, eq=False)
class FaceModel:
    """A model on the vertices of the face and one ring around it. Metres, model frame, float64."""

    name: str
    content: str  # digest of the model
    rows: Int[np.ndarray, "P"]  # of the model's vertices
    rest: Float[np.ndarray, "P 3"]
    basis: Float[np.ndarray, "K P 3"]
    triangles: Int[np.ndarray, "F 3"]  # between these vertices
    face: Bool[np.ndarray, "P"]  # where meshes in correspondence are compared
    components: Mapping[str, Int[np.ndarray, "_"]]  # "identity" and regions of the expression -> rows of the basis
    articulation: Articulation | None = None
    _products: dict[bytes, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, init=False, repr=False)
    _inverses: dict[bytes, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    @property
    def angles(self) -> int:
        """Number of joints that a fit rotates."""
        return 0 if self.articulation is None else len(self.articulation.free)

    @cached_property
    def columns32(self) -> Float[np.ndarray, "C K"]:
        """The components as columns, float32: rows of a Jacobian are sparse combinations of these rows."""
        return np.ascontiguousarray(self.basis.reshape(len(self.basis), -1).T, np.float32)

    def shape(self, coefficients: Float[np.ndarray, "K"], angles: Float[np.ndarray, "A 3"]) -> Float[np.ndarray, "P 3"]:
        """Return the vertices, metres, model frame."""
        if (joints := self.articulation) is None:
            return self.rest + np.tensordot(coefficients, self.basis, 1)
        with torch.no_grad():
            return joints.model(joints.parameters(coefficients, angles)).numpy()

    def derivative(
        self, coefficients: Float[np.ndarray, "K"], angles: Float[np.ndarray, "A 3"]
    ) -> Float[np.ndarray, "C N"]:
        """Return the derivative of the vertices by the coefficients, then by the angles."""
        if (joints := self.articulation) is None:
            return self.columns32
        exact = joints.model.derivatives(joints.parameters(coefficients, angles))
        parts = exact.identity, exact.expression, exact.rotations[list(joints.free)].flatten(0, 1)
        return torch.cat(parts).flatten(1).T.numpy()

    def products(self, rows: Bool[np.ndarray, "P"]) -> tuple[Float[np.ndarray, "K C"], Float[np.ndarray, "K K"]]:
        """Return the components on some vertices, and their products; kept for the next call."""
        key = rows.tobytes()
        if key not in self._products:
            flat = self.basis[:, rows].reshape(len(self.basis), -1)
            self._products[key] = flat, flat @ flat.T
        return self._products[key]

    def normal_inverse(
        self, rows: Bool[np.ndarray, "P"], active: Int[np.ndarray, "k"] | None = None
    ) -> tuple[Float[np.ndarray, "K C"], Float[np.ndarray, "K K"]]:
        """Return the components on some vertices, and the pseudo-inverse of their products; kept for the next call.

        Args:
            rows: the vertices.
            active: components that a fit may use; None: all. The inverse is zero for the others.
        """
        members = np.arange(len(self.basis)) if active is None else active
        key = rows.tobytes() + members.tobytes()
        flat, products = self.products(rows)
        if key not in self._inverses:
            inverse = np.zeros_like(products)
            inverse[np.ix_(members, members)] = pseudo_inverse(products[np.ix_(members, members)])
            self._inverses[key] = inverse
        return flat, self._inverses[key]
