"""Training data with known ground truth: heads with exact statistics, in random poses; subjects with expressions."""

import numpy as np
from scipy.spatial.transform import Rotation

from bench.support import performances
from coregister.first_model.assembly import HeadAssembly
from coregister.next_model.training_data import TrainingMesh, TrainingSubject
from registration.model import regions
from registration.model.gnm_npz import GNMData


def whitened(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    """Coefficients with mean zero and, with N - 1, unit covariance, up to rounding."""
    values = rng.normal(size=(count, size))
    q, _ = np.linalg.qr(values - values.mean(0))
    return q * np.sqrt(count - 1)


def head_components(model: GNMData) -> np.ndarray:
    """The identity components that move the skin."""
    basis = model.vertex_identity_basis.astype(np.float64)
    return basis[np.abs(basis[:, regions.skin(model)]).max((1, 2)) > 0]


def heads(model: GNMData, coefficients: np.ndarray) -> np.ndarray:
    return model.template_vertex_positions + np.tensordot(coefficients, head_components(model), 1)


def transformed(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each head rotated by about ten degrees and translated by some centimetres."""
    rotations = Rotation.from_rotvec(rng.normal(0, 0.1, (len(vertices), 3))).as_matrix()
    return np.einsum("ncd,nvd->nvc", rotations, vertices) + rng.normal(0, 0.03, (len(vertices), 1, 3))


def mesh(name: str, vertices: np.ndarray, model: GNMData, confidence: np.ndarray | None = None) -> TrainingMesh:
    confidence = np.ones(len(vertices)) if confidence is None else confidence
    return TrainingMesh(
        name=name,
        label=name,
        vertices=vertices.astype(np.float32),
        confidence=confidence.astype(np.float32),
        triangles=model.triangles,
    )


def subjects(
    assembly: HeadAssembly, model: GNMData, seeds: range, expressions: tuple[str, ...]
) -> list[TrainingSubject]:
    """Subjects outside the first model's span, with expressions of random strength."""
    result = []
    for seed in seeds:
        truth = performances.true_subject(assembly, seed, expressions)
        meshes = tuple(mesh(name, v, model) for name, v in zip(truth.labels, truth.vertices, strict=True))
        tags = {"age": 20 + seed % 50, "gender": ("female", "male")[seed % 2]}
        neutral = mesh("neutral", truth.neutral, model)
        result.append(TrainingSubject(name=truth.name, neutral=neutral, expressions=meshes, tags=tags))
    return result
