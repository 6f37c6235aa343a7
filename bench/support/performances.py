"""Subjects of the population whose expressions are known, and what a registration of them would look like: turned and
shifted heads with smooth and white noise, and patches that no camera sees."""

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
_STRENGTH = (0.7, 1.0)  # no two people do the same: each unit of an expression has a strength of its own
_WAVES = 200  # of a random smooth field


@dataclass(frozen=True, kw_only=True)
class Performed:
    """One subject's truth, the skull where the neutral has it: metres, the model's frame."""

    name: str
    neutral: np.ndarray  # V 3
    labels: tuple[str, ...]
    vertices: np.ndarray  # S V 3


@dataclass(frozen=True, kw_only=True)
class Seen:
    """The same as a registration would give it."""

    neutral: np.ndarray  # V 3
    neutral_confidence: np.ndarray  # V
    vertices: np.ndarray  # S V 3
    confidence: np.ndarray  # S V
    T_expression_neutral: np.ndarray  # S 4 4: the motion that was added


def perform(anatomy: HeadAssembly, seed: int, names: tuple[str, ...] = NAMES) -> Performed:
    """A person that the first model does not span, and expressions of varying strength."""
    rng = np.random.default_rng(seed)
    person = population.sample_unspanned_person(anatomy.source, rng)
    moves = {name: anatomy.source.target(name) for name in person.weights}
    neutral, joints = anatomy.assemble(person, moves)
    heads = []
    for name in names:
        act = EXPRESSIONS[name]
        units = {unit: weight * rng.uniform(*_STRENGTH) for unit, weight in act.units.items()}
        varied = Expression(category=act.category, units=units, gaze_deg=act.gaze_deg, tongue=act.tongue)
        heads.append(expressions.apply_expression(anatomy, varied, neutral, joints))
    return Performed(name=f"synth_{seed:04d}", neutral=neutral, labels=names, vertices=np.stack(heads))


def smooth_noise(points: np.ndarray, length: float, rng: np.random.Generator) -> np.ndarray:
    """A random field of unit variance in each coordinate, correlated as exp(-d^2 / 2 length^2) (Rahimi and Recht)."""
    waves = rng.normal(0, 1 / length, (_WAVES, 3))
    phases = points @ waves.T + rng.uniform(0, 2 * np.pi, _WAVES)
    return np.sqrt(2 / _WAVES) * np.cos(phases) @ rng.normal(size=(_WAVES, 3))


def motion(rng: np.random.Generator, most_deg: float, most_mm: float, centre: np.ndarray) -> np.ndarray:
    """A turn about a random axis through `centre` and a shift, each evenly up to its most."""
    transform = np.eye(4)
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(rng.uniform(0, most_deg)) * axis / np.linalg.norm(axis)).as_matrix()
    way = rng.normal(size=3)
    shift = 1e-3 * rng.uniform(0, most_mm) * way / np.linalg.norm(way)
    transform[:3, :3], transform[:3, 3] = turn, centre - turn @ centre + shift
    return transform


def seen(
    truth: Performed,
    seed: int,
    *,
    most_deg: float = 5.0,
    most_mm: float = 10.0,
    smooth_mm: float = 0.3,
    white_mm: float = 0.1,
    unseen: float = 0.1,
) -> Seen:
    """Motions, noise (standard deviations of each coordinate; smooth over 15 mm) and unseen patches added.

    An unseen patch is wrong, smoothly, by 3 mm, and has no confidence.
    """
    rng = np.random.default_rng([seed, 1])

    def noisy(head: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        noise = 1e-3 * (smooth_mm * smooth_noise(head, 15e-3, rng) + white_mm * rng.normal(size=head.shape))
        hidden = _patches(head, unseen, rng)
        noise[hidden] += 3e-3 * smooth_noise(head[hidden], 15e-3, rng)
        return head + noise, np.where(hidden, 0, rng.uniform(0.5, 0.9, len(head))).astype(np.float32)

    neutral, neutral_confidence = noisy(truth.neutral)
    motions = np.stack([motion(rng, most_deg, most_mm, truth.neutral.mean(0)) for _ in truth.labels])
    heads = [noisy(head) for head in truth.vertices]
    return Seen(
        neutral=neutral.astype(np.float32),
        neutral_confidence=neutral_confidence,
        vertices=np.stack([transform_points(T, head) for T, (head, _) in zip(motions, heads, strict=True)]).astype(
            np.float32
        ),
        confidence=np.stack([confidence for _, confidence in heads]),
        T_expression_neutral=motions,
    )


def _patches(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Balls around random vertices, 15 mm in radius, until this share of the vertices lies in one."""
    hidden, tree = np.zeros(len(points), bool), cKDTree(points)
    while hidden.mean() < share:
        hidden[tree.query_ball_point(points[rng.integers(len(points))], 15e-3)] = True
    return hidden


def body_stays(seen: Seen, data: GNMData) -> Seen:
    """The same heads turned on necks, as the model's skinning has them, while the body stays where it was."""
    weights = data.skinning_weights.astype(np.float64)
    still = (weights[0] / weights.sum(0))[:, None]  # the root's share
    back = np.linalg.inv(seen.T_expression_neutral)
    heads = [head + still * (transform_points(T, head) - head) for T, head in zip(back, seen.vertices, strict=True)]
    return replace(seen, vertices=np.stack(heads).astype(np.float32))


def meshes(truth: Performed, seen: Seen) -> SubjectMeshes:
    """What a registration gave, as stabilization takes it."""
    return SubjectMeshes(
        subject=truth.name,
        neutral=seen.neutral,
        neutral_confidence=seen.neutral_confidence,
        names=truth.labels,
        labels=truth.labels,
        vertices=seen.vertices,
        confidence=seen.confidence,
    )


def moved(meshes: SubjectMeshes, motions: np.ndarray) -> SubjectMeshes:
    """The expressions turned and shifted, one motion each."""
    heads = [transform_points(T, head) for T, head in zip(motions, meshes.vertices, strict=True)]
    return replace(meshes, vertices=np.stack(heads).astype(np.float32))
