"""Head models of the experiments, and heads sampled from them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from coregister.first_model.build import bootstrap
from registration.geometry.surface_samples import sample_surface
from registration.model import gnm_npz, regions
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme, schemes_beside, shipped_schemes
from registration.types import Parameters

# Standard deviations of expression coefficients, sampled and expected. The first model's basis has that of the samples
# of which it is made; four real expressions of the GNM basis have coefficients of 0.20 to 0.27 (rms).
FIRST_SIGMA, GNM_SIGMA = 1.0, 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class Head:
    """Parameters of one posed head: J joints, each relative to its parent, axis-angle."""

    identity: Float[np.ndarray, "I"]
    expression: Float[np.ndarray, "E"]
    rotations: Float[np.ndarray, "J 3"]
    translation: Float[np.ndarray, "3"]  # metres


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadModel:
    """A model with what the experiments need of it."""

    name: str
    data: GNMData
    path: Path
    expression_sigma: float

    @classmethod
    def read(cls, name: str, path: Path | None) -> "HeadModel":
        """Read a model's file; None: the first model."""
        sigma = FIRST_SIGMA if path is None else GNM_SIGMA
        path = path or bootstrap()
        return cls(name=name, data=gnm_npz.read(path), path=path, expression_sigma=sigma)

    @cached_property
    def _torch(self) -> GNM:
        return GNM(self.data, dtype=torch.float64)

    @cached_property
    def schemes(self) -> dict[str, LandmarkScheme]:
        """Landmark schemes beside the file, and the shipped ones."""
        return {**shipped_schemes(self.data), **schemes_beside(self.path, self.data.template_vertex_positions)}

    @cached_property
    def template(self) -> Float[np.ndarray, "V 3"]:
        """Template vertices, metres."""
        return self.data.template_vertex_positions.astype(np.float64)

    @cached_property
    def face(self) -> Bool[np.ndarray, "V"]:
        """Vertices of the face: the outer skin inside the face mask."""
        return (regions.group(self.data, "hockey_mask") > 0.5) & regions.exterior(self.data)

    @cached_property
    def face_triangles(self) -> Int[np.ndarray, "F 3"]:
        """Triangles of the face."""
        triangles = self.data.triangles.astype(np.int64)
        return triangles[self.face[triangles].all(1)]

    @cached_property
    def outer_triangles(self) -> Int[np.ndarray, "F 3"]:
        """Triangles of the outer skin."""
        triangles = self.data.triangles.astype(np.int64)
        return triangles[regions.exterior(self.data)[triangles].all(1)]

    def vertices(self, head: Head) -> Float[np.ndarray, "V 3"]:
        """Vertices of a posed head, metres, world."""
        parts = {
            "identity": head.identity,
            "expression": head.expression,
            "rotations": head.rotations,
            "translation": head.translation,
            "scale": np.ones(()),
        }
        return self.posed(Parameters(**{name: torch.as_tensor(np.array(value)) for name, value in parts.items()}))

    def posed(self, parameters: Parameters) -> Float[np.ndarray, "*F V 3"]:
        """Vertices of parameters, metres, world."""
        with torch.no_grad():
            return self._torch(parameters).numpy()

    def shape(self, identity: np.ndarray, expression: np.ndarray) -> Float[np.ndarray, "V 3"]:
        """Displacements of the bind pose, metres."""
        return np.tensordot(identity, self.data.vertex_identity_basis, 1) + np.tensordot(
            expression, self.data.expression_basis, 1
        )

    def sample(self, rng: np.random.Generator, *, turn: float = 0.15) -> Head:
        """Sample a head of the model's prior.

        Args:
            rng: source of randomness.
            turn: standard deviation of the head's rotation in the world about each axis, radians; twice about y.
        """
        rotations = np.zeros((len(self.data.joint_names), 3))
        rotations[0] = rng.normal(size=3) * turn * (1, 2, 1)
        rotations[1] = rng.normal(size=3) * 0.05
        rotations[2:] = rng.normal(size=(len(rotations) - 2, 3)) * 0.1
        return Head(
            identity=rng.normal(size=len(self.data.vertex_identity_basis)),
            expression=rng.normal(size=len(self.data.expression_basis)) * self.expression_sigma,
            rotations=rotations,
            translation=rng.normal(size=3) * 0.02,
        )

    def vertex_scheme(self, rows: Int[np.ndarray, "L"], name: str) -> LandmarkScheme:
        """A scheme of single vertices."""
        return LandmarkScheme(
            name=name, indices=np.repeat(rows[:, None], 3, 1), weights=np.tile([1.0, 0, 0], (len(rows), 1))
        )

    def face_scheme(self, count: int, seed: int = 0) -> LandmarkScheme:
        """Points of the face's surface, uniform by area."""
        faces, barycentric = sample_surface(self.template, self.face_triangles, count, np.random.default_rng(seed))
        return LandmarkScheme(name=f"face_{count}", indices=self.face_triangles[faces], weights=barycentric)
