"""Heads of which the truth is known: samples of a model with exact statistics, moved at will; people who perform."""

import numpy as np
from scipy.spatial.transform import Rotation

from bench.support import performances
from coregister.first_model.assembly import HeadAssembly
from coregister.next_model.training_data import TrainingMesh, TrainingSubject
from registration.model import regions
from registration.model.gnm_npz import GNMData


def whitened(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Draws whose mean is zero and whose covariance, with N - 1, is the identity, to rounding."""
    draws = rng.normal(size=(count, size))
    q, _ = np.linalg.qr(draws - draws.mean(0))
    return q * np.sqrt(count - 1)


def head_components(model: GNMData) -> np.ndarray:
    """The identity components in which the skin moves."""
    basis = model.vertex_identity_basis.astype(np.float64)
    return basis[np.abs(basis[:, regions.skin(model)]).max((1, 2)) > 0]


def heads(model: GNMData, coefficients: np.ndarray) -> np.ndarray:
    return model.template_vertex_positions + np.tensordot(coefficients, head_components(model), 1)


def moved(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each head turned by about ten degrees and shifted by some centimetres."""
    turns = Rotation.from_rotvec(rng.normal(0, 0.1, (len(vertices), 3))).as_matrix()
    return np.einsum("ncd,nvd->nvc", turns, vertices) + rng.normal(0, 0.03, (len(vertices), 1, 3))


def mesh(name: str, vertices: np.ndarray, model: GNMData, confidence: np.ndarray | None = None) -> TrainingMesh:
    sure = np.ones(len(vertices), np.float32) if confidence is None else confidence.astype(np.float32)
    shape = vertices.astype(np.float32)
    return TrainingMesh(name=name, label=name, vertices=shape, confidence=sure, triangles=model.triangles)


def people(anatomy: HeadAssembly, model: GNMData, seeds: range, acts: tuple[str, ...]) -> list[TrainingSubject]:
    """Subjects beyond the first model's span, with expressions of their own strength."""
    found = []
    for seed in seeds:
        truth = performances.perform(anatomy, seed, acts)
        expressions = tuple(mesh(name, v, model) for name, v in zip(truth.labels, truth.vertices, strict=True))
        tags = {"age": 20 + seed % 50, "gender": ("female", "male")[seed % 2]}
        neutral = mesh("neutral", truth.neutral, model)
        found.append(TrainingSubject(name=truth.name, neutral=neutral, expressions=expressions, tags=tags))
    return found
