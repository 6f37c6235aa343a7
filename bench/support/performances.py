"""Synthetic subjects with known expressions, and what a registration of them would give: rotated and translated heads
with smooth and white noise, and unobserved patches."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from coregister.first_model import population
from coregister.first_model.assembly import HeadAssembly
from coregister.synthetic import expressions
from coregister.synthetic.expressions import EXPRESSIONS, Expression
from registration.frames import transform_points
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SubjectMeshes

# Twenty of the capture protocol, in every category that moves the skin.
NAMES = (
    *("stretch", "compress", "smile", "viseme_aa", "viseme_ee", "viseme_oo", "lips_rolled", "pucker", "funnel"),
    *("sadness", "fear", "anger", "tongue_out", "jaw_open", "jaw_left", "jaw_right", "wink_left", "brows_up"),
    *("brows_down", "cheeks_blown"),
)
COUNT = len(NAMES)
JAW, BROWS = ("jaw_open", "jaw_left", "jaw_right"), ("brows_up", "brows_down")
_STRENGTH = (0.7, 1.0)  # range of each unit's weight, sampled for each subject
_WAVES = 200  # of a random smooth field


@dataclass(frozen=True, kw_only=True)
class TrueSubject:
    """A subject's true meshes with the skull at its position in the neutral: metres, the model's frame."""

    name: str
    neutral: np.ndarray  # V 3
    labels: tuple[str, ...]
    vertices: np.ndarray  # S V 3


@dataclass(frozen=True, kw_only=True)
class ObservedSubject:
    """The meshes of a subject as a registration would give them."""

    neutral: np.ndarray  # V 3
    neutral_confidence: np.ndarray  # V
    vertices: np.ndarray  # S V 3
    confidence: np.ndarray  # S V
    T_expression_neutral: np.ndarray  # S 4 4: the added motions


def true_subject(head_assembly: HeadAssembly, seed: int, names: tuple[str, ...] = NAMES) -> TrueSubject:
    """Return a random subject outside the first model's span with expressions of random strength."""
    rng = np.random.default_rng(seed)
    person = population.sample_unspanned_person(head_assembly.source, rng)
    moves = {name: head_assembly.source.target(name) for name in person.weights}
    neutral, joints = head_assembly.assemble(person, moves)
    heads = []
    for name in names:
        expression = EXPRESSIONS[name]
        units = {unit: weight * rng.uniform(*_STRENGTH) for unit, weight in expression.units.items()}
        varied = Expression(
            category=expression.category, units=units, gaze_deg=expression.gaze_deg, tongue=expression.tongue
        )
        heads.append(expressions.apply_expression(head_assembly, varied, neutral, joints))
    return TrueSubject(name=f"synth_{seed:04d}", neutral=neutral, labels=names, vertices=np.stack(heads))


def smooth_noise(points: np.ndarray, length: float, rng: np.random.Generator) -> np.ndarray:
    """Return a random field of unit variance, correlated as exp(-d^2 / 2 length^2) (random Fourier features)."""
    waves = rng.normal(0, 1 / length, (_WAVES, 3))
    phases = points @ waves.T + rng.uniform(0, 2 * np.pi, _WAVES)
    return np.sqrt(2 / _WAVES) * np.cos(phases) @ rng.normal(size=(_WAVES, 3))


def random_motion(rng: np.random.Generator, max_deg: float, max_mm: float, centre: np.ndarray) -> np.ndarray:
    """Return a rotation about a random axis through `centre` and a translation, each uniform up to its maximum."""
    transform = np.eye(4)
    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(np.radians(rng.uniform(0, max_deg)) * axis / np.linalg.norm(axis)).as_matrix()
    direction = rng.normal(size=3)
    translation = 1e-3 * rng.uniform(0, max_mm) * direction / np.linalg.norm(direction)
    transform[:3, :3], transform[:3, 3] = rotation, centre - rotation @ centre + translation
    return transform


def observe(
    truth: TrueSubject,
    seed: int,
    *,
    max_deg: float = 5.0,
    max_mm: float = 10.0,
    smooth_mm: float = 0.3,
    white_mm: float = 0.1,
    unobserved: float = 0.1,
) -> ObservedSubject:
    """Add motions, noise (standard deviations of each coordinate; smooth over 15 mm) and unobserved patches.

    An unobserved patch has a smooth error of 3 mm and no confidence.
    """
    rng = np.random.default_rng([seed, 1])

    def noisy(head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        noise = 1e-3 * (smooth_mm * smooth_noise(head, 15e-3, rng) + white_mm * rng.normal(size=head.shape))
        hidden = _patches(head, unobserved, rng)
        noise[hidden] += 3e-3 * smooth_noise(head[hidden], 15e-3, rng)
        return head + noise, np.where(hidden, 0, rng.uniform(0.5, 0.9, len(head))).astype(np.float32)

    neutral, neutral_confidence = noisy(truth.neutral)
    motions = np.stack([random_motion(rng, max_deg, max_mm, truth.neutral.mean(0)) for _ in truth.labels])
    heads = [noisy(head) for head in truth.vertices]
    return ObservedSubject(
        neutral=neutral.astype(np.float32),
        neutral_confidence=neutral_confidence,
        vertices=np.stack([transform_points(T, head) for T, (head, _) in zip(motions, heads, strict=True)]).astype(
            np.float32
        ),
        confidence=np.stack([confidence for _, confidence in heads]),
        T_expression_neutral=motions,
    )


def _patches(points: np.ndarray, fraction: float, rng: np.random.Generator) -> np.ndarray:
    """Return the vertices in balls of 15 mm radius around random vertices, at least this fraction of all."""
    hidden, tree = np.zeros(len(points), bool), cKDTree(points)
    while hidden.mean() < fraction:
        hidden[tree.query_ball_point(points[rng.integers(len(points))], 15e-3)] = True
    return hidden


def with_still_body(observed: ObservedSubject, data: GNMData) -> ObservedSubject:
    """Return the heads rotated on their necks by the model's skinning, without motion of the body."""
    weights = data.skinning_weights.astype(np.float64)
    root = (weights[0] / weights.sum(0))[:, None]  # weight of the root
    inverse = np.linalg.inv(observed.T_expression_neutral)
    heads = [
        head + root * (transform_points(T, head) - head) for T, head in zip(inverse, observed.vertices, strict=True)
    ]
    return replace(observed, vertices=np.stack(heads).astype(np.float32))


def observed_meshes(truth: TrueSubject, observed: ObservedSubject) -> SubjectMeshes:
    """Return the observed meshes as the input of stabilization."""
    return SubjectMeshes(
        subject=truth.name,
        neutral=observed.neutral,
        neutral_confidence=observed.neutral_confidence,
        names=truth.labels,
        labels=truth.labels,
        vertices=observed.vertices,
        confidence=observed.confidence,
    )


def transformed(meshes: SubjectMeshes, motions: np.ndarray) -> SubjectMeshes:
    """Return the meshes with a rigid motion of each expression."""
    heads = [transform_points(T, head) for T, head in zip(motions, meshes.vertices, strict=True)]
    return replace(meshes, vertices=np.stack(heads).astype(np.float32))
