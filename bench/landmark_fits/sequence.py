"""A talking head in one view: time, jitter and the closures of the lips, with the temporal prior and without."""

import time
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from bench.landmark_fits.heads import Head, HeadModel
from bench.landmark_fits.pictures import cameras_around, observe
from bench.landmark_fits.rows import Row, at_most
from registration.evaluate.audit import BEYOND_KEY, audit_penetration
from registration.export.arkit import arkit_shapes
from registration.export.arkit_anatomy import Anatomy
from registration.geometry.rigid import similarity_transform
from registration.landmark_fit.fit import fit_landmarks, fit_many
from registration.landmark_fit.options import FitOptions, TemporalPrior

FRAMES = 300
RATE_HZ = 30.0
SCHEME = "face478"
_SHAPES = ("jawOpen", "mouthFunnel", "mouthPucker", "mouthStretchLeft", "mouthStretchRight", "eyeBlinkLeft")
_SHAPES += ("eyeBlinkRight", "browInnerUp")
_SYLLABLE_S = 0.23
_FIT_M = 5e-3  # of all vertices' displacement, against one standard deviation of a coefficient
_CLOSED = 0.02  # weight of the jaw, below which the lips touch
_STILL_M = 5e-5  # motion by expressions of vertices that count as still
_MIDDLE_M = 0.01  # from the midline, where the gap between the lips is measured
_SINGLE_FRAMES = 40  # of the comparison with separate fits
SECONDS_LIMIT, GAP_LIMIT_MM = 0.3, 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Talk:
    """The true sequence of F frames."""

    heads: list[Head]
    vertices: Float[np.ndarray, "F V 3"]  # metres, world
    closed: Bool[np.ndarray, "F"]  # the lips touch as in the template
    still: Int[np.ndarray, "S"]  # vertices of the face that no expression of the sequence moves


def talk(model: HeadModel, frames: int, seed: int = 7) -> Talk:
    """Sample a person who talks, with bilabial closures, blinks and small motions of the head."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(frames) / RATE_HZ
    weights = _weights(seconds, rng)
    shapes = arkit_shapes(model.data, model.template)
    solved = {**shapes.shapes, **shapes.missing}
    basis = model.data.expression_basis.reshape(len(model.data.expression_basis), -1).astype(np.float64)
    wanted = np.stack([solved[name].displacement.reshape(-1) for name in _SHAPES])
    # The most probable coefficients, as in the shapes themselves: their basis is the model's with its mirror image.
    coefficients = np.linalg.solve(basis @ basis.T + _FIT_M**2 * np.eye(len(basis)), basis @ wanted.T).T
    expressions = weights @ coefficients
    person = _person(model, rng)
    phases = rng.uniform(0, 2 * np.pi, 7)

    def wave(k: int, size: float, hertz: float) -> np.ndarray:
        return size * np.sin(2 * np.pi * hertz * seconds + phases[k])

    rotations = np.zeros((frames, *person.rotations.shape))
    rotations[:, 0] = np.stack([wave(0, 0.05, 0.5), wave(1, 0.1, 0.3), wave(2, 0.03, 0.4)], 1)
    rotations[:, 1] = np.stack([wave(3, 0.02, 0.6), wave(3, 0.03, 0.4), 0 * seconds], 1)
    rotations[:, 2:] = np.stack([wave(4, 0.05, 0.3), wave(5, 0.1, 0.2), 0 * seconds], 1)[:, None]
    shifts = np.stack([wave(6, 8e-3, 0.3), wave(5, 4e-3, 0.5), wave(4, 8e-3, 0.2)], 1)
    heads = [
        Head(identity=person.identity, expression=e, rotations=r, translation=t)
        for e, r, t in zip(expressions, rotations, shifts, strict=True)
    ]
    spread = np.zeros(len(model.template))
    zero = np.zeros(len(person.identity))
    for expression in expressions[:: max(1, frames // 20)]:
        spread = np.maximum(spread, np.linalg.norm(model.shape(zero, expression), axis=1))
    return Talk(
        heads=heads,
        vertices=np.stack([model.vertices(head) for head in heads]),
        closed=weights[:, 0] < _CLOSED,
        still=np.flatnonzero(model.face & (spread < _STILL_M)),
    )


def _person(model: HeadModel, rng: np.random.Generator) -> Head:
    """Sample a person whose parts do not lie in one another at rest: the fit's anatomical term assumes so."""
    while True:
        person = model.sample(rng)
        rest = model.template + model.shape(person.identity, np.zeros_like(person.expression))
        if not audit_penetration(rest, model.data).metrics[BEYOND_KEY]:
            return person


def _weights(seconds: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "F S"]:
    """Weights of `_SHAPES`: one syllable after another; about every third begins with closed lips."""
    weights = np.zeros((len(seconds), len(_SHAPES)))
    count = int(seconds[-1] / _SYLLABLE_S) + 2
    opening = rng.uniform(0.15, 0.7, count)
    rounding, spreading = rng.uniform(0, 0.4, count), rng.uniform(0, 0.4, count)
    rest = np.where(rng.uniform(size=count) < 0.35, 0.0, rng.uniform(0.06, 0.15, count))  # of the jaw between two
    number = (seconds / _SYLLABLE_S).astype(int)
    inside = seconds / _SYLLABLE_S - number
    bump = np.clip((np.sin(np.pi * inside) - 0.25) / 0.75, 0, None)  # closures last some frames
    between = rest[number] * (1 - inside) + rest[number + 1] * inside
    between = np.where((inside < 0.5) & (rest[number] == 0) & (bump == 0), 0, between)
    between = np.where((inside >= 0.5) & (rest[number + 1] == 0) & (bump == 0), 0, between)
    weights[:, 0] = between + bump * opening[number]
    weights[:, 1] = bump * rounding[number] * 0.5
    weights[:, 2] = bump * rounding[number]
    weights[:, 3:5] = (bump * spreading[number])[:, None]
    blink = np.exp(-((((seconds + 1) % 2.7) - 1.5) ** 2) / (2 * 0.05**2))
    weights[:, 5:7] = blink[:, None]
    weights[:, 7] = 0.4 * np.clip(np.sin(2 * np.pi * 0.25 * seconds), 0, None)
    return weights


def lip_gap_mm(model: HeadModel, head: Anatomy, vertices: Float[np.ndarray, "*F V 3"]) -> Float[np.ndarray, "*F"]:
    """Height of the gap between the lips' edges near the midline: between the means of their vertices."""
    edges = []
    for name in ("upper_edge", "lower_edge"):
        rows = head.areas[name]
        rows = rows[np.abs(model.template[rows, 0]) < _MIDDLE_M]
        edges.append(vertices[..., rows, :].mean(-2))
    return 1e3 * np.linalg.norm(edges[0] - edges[1], axis=-1)


def _size(fitted: Float[np.ndarray, "F N 3"], true: Float[np.ndarray, "F N 3"]) -> float:
    """Mean scale of similarities from the fit to the truth: one camera of unknown focal length leaves the size open."""
    some = range(0, len(true), 10)
    return float(np.mean([similarity_transform(fitted[f], true[f], free_scale=True)[0] for f in some]))


def jitter_mm(fitted: np.ndarray, true: np.ndarray, rows: np.ndarray) -> float:
    """Rms length of the second difference of the error, mm: vertices that stand still have none in the truth."""
    second = np.diff(fitted[:, rows] - true[:, rows], n=2, axis=0)
    return 1e3 * float(np.sqrt((second**2).sum(-1).mean()))


def sequence(model: HeadModel, frames: int) -> list[Row]:
    """Fit the sequence with the temporal prior, frame by frame with one identity, and as separate images."""
    if SCHEME not in model.schemes:
        return []
    scheme = replace(model.schemes[SCHEME], spread_m=None)  # the truth is on the map's points
    talking = talk(model, frames)
    camera = cameras_around(model.template[model.face].mean(0), 1)
    noise = np.random.default_rng(8)
    observations = observe(scheme, list(talking.vertices), camera, sigma_px=1.0, known=False, noise=noise)
    options = FitOptions(temporal=TemporalPrior(), covariance=False)
    began, cpu = time.perf_counter(), time.process_time()
    smooth = fit_landmarks(observations, model.data, options)
    seconds, cpu = (time.perf_counter() - began) / frames, (time.process_time() - cpu) / frames
    plain = fit_landmarks(observations, model.data, replace(options, temporal=None))
    few = min(_SINGLE_FRAMES, frames)
    images = (observations.frames([f]) for f in range(few))
    single = [model.posed(fit.parameters(0)) for fit in fit_many(images, model.data, replace(options, temporal=None))]
    meshes = {"temporal": model.posed(smooth.parameters()), "plain": model.posed(plain.parameters())}
    jitters = {name: jitter_mm(mesh, talking.vertices, talking.still) for name, mesh in meshes.items()}
    jitters["single"] = jitter_mm(np.stack(single), talking.vertices[:few], talking.still)
    anatomy = Anatomy.of(model.data, model.template)
    true_gap = lip_gap_mm(model, anatomy, talking.vertices)
    error = {}
    for name, mesh in meshes.items():
        gap = _size(mesh[:, model.face], talking.vertices[:, model.face]) * lip_gap_mm(model, anatomy, mesh)
        error[name] = np.abs(gap - true_gap)[talking.closed]
    rows = [
        at_most(
            f"{model.name}: time per frame of {frames}, {smooth.status}, {cpu:.2f} s of processor time",
            seconds,
            SECONDS_LIMIT,
            "s",
        ),
        at_most(
            f"jitter of {len(talking.still)} still vertices, {jitters['temporal']:.3f} mm, "
            f"against separate images, {jitters['single']:.3f} mm",
            jitters["temporal"] / jitters["single"],
            0.5,
            "",
        ),
        at_most(
            f"the same against frames that share the identity and the camera alone, {jitters['plain']:.3f} mm",
            jitters["temporal"] / jitters["plain"],
            0.5,
            "",
        ),
        at_most(
            f"error of the lips' gap in {int(talking.closed.sum())} closed frames, at the truth's size, largest",
            float(error["temporal"].max(initial=0)),
            GAP_LIMIT_MM,
            "mm",
        ),
        Row(
            what="the same, mean; without the temporal prior, mean and largest; widest true gap",
            measured=f"{error['temporal'].mean():.2f}; {error['plain'].mean():.2f}, {error['plain'].max():.2f}; "
            f"{true_gap.max():.1f} mm",
        ),
    ]
    return rows
