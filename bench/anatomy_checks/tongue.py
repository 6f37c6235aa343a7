"""Tongue: components, penetration of random tongues in an open mouth, and recovery of key points."""

import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from bench.anatomy_checks import Figure
from coregister.anatomy.part_basis import PartBasis
from coregister.anatomy.tongue import tongue_basis
from coregister.anatomy.tongue_fit import KeyPointFit
from coregister.anatomy.tongue_keypoints import TONGUE_POINTS, TongueRecording
from coregister.anatomy.tongue_mouth import JawOpening, Mouth
from coregister.anatomy.tongue_poses import PoseSettings, draw_controls
from coregister.anatomy.tongue_rig import TongueRig
from registration.anatomy.tongue_structure import find_tongue
from registration.frames import MM_PER_M
from registration.geometry.winding import Winding, closed
from registration.model import regions
from registration.model.gnm_npz import GNMData

_GAP_M = 30e-3  # between the incisors of the open mouth, beyond the template's
_RANDOM, _POSES = 200, 20
_DEEP_MM = 0.5
_FITTED_MM = 0.2  # the same of poses fitted to key points
_GAPS_M = 4e-3, 20e-3  # between the incisors of these
_REST = 8
_MOVES, _STEP_S = 8, 0.15  # poses of the movement, and from one to the next: four syllables a second
_COMPONENTS, _MORE = 31, 8  # of the paper


def figures(data: GNMData) -> Iterator[Figure]:
    """Regenerate the tongue and measure its components."""
    start = time.perf_counter()
    basis = tongue_basis(data)
    record = basis.record
    yield Figure(name=f"time of {record['samples']} samples", value=time.perf_counter() - start, unit="s")
    yield Figure(name="poses rejected", value=record["rejected"], unit=f"for {record['samples'] // 2} accepted")
    count = record["components_beside_the_mean"]
    bounds = {"most": _COMPONENTS + _MORE, "least": _COMPONENTS - _MORE}
    yield Figure(name=f"components for {record['variance_kept']:.2%} of the variance", value=count, unit="", **bounds)
    yield Figure(name="components for 99 % of the variance", value=record["components_for_0.99"], unit="")
    yield Figure(name="mean's motion, rms", value=record["mean_rms_mm"], unit="mm")
    yield Figure(name="other motion, rms", value=record["rms_mm"], unit="mm")
    yield Figure(name="tongue at rest outside the lips", value=_outside(data), unit="vertices", most=0)
    for name, components in (("", basis.components), (" (the model's before)", _previous(data, basis))):
        teeth, skin = _penetrations(data, components)
        most = None if name else 5.0
        yield Figure(name=f"random tongues in teeth or palate{name}", value=teeth, unit="%", most=most)
        yield Figure(name=f"random tongues in lips, cheeks or lining{name}", value=skin, unit="%")
    yield from _recovered(data)


def _outside(data: GNMData) -> int:
    """How many vertices of the template's tongue lie outside the outer skin, its openings closed."""
    exterior = regions.exterior(data)
    skin = data.triangles[exterior[data.triangles].all(1)]
    points = data.template_vertex_positions.astype(np.float64)
    return int((Winding(*closed(points, skin)).numbers(points[regions.tongue(data)]) < 0.5).sum())


def _previous(data: GNMData, basis: PartBasis) -> Float[np.ndarray, "K N 3"]:
    rows = regions.expression_modes(data)["tongue"]
    return data.expression_basis[rows][:, basis.vertices].astype(np.float64)


def _penetrations(data: GNMData, components: Float[np.ndarray, "K N 3"]) -> tuple[float, float]:
    """Percentages of random tongues, the mean plus a draw of all other components, that are deeper than allowed."""
    jaw, rng = JawOpening.of(data), np.random.default_rng(0)
    mouth = Mouth(data, data.template_vertex_positions + jaw.displacement(jaw.coefficients(_GAP_M)))
    deep = np.zeros(2)
    for _ in range(_RANDOM):
        moved = components[0] + np.tensordot(rng.normal(size=len(components) - 1), components[1:], 1)
        deep += [depth > _DEEP_MM for depth in mouth.excess_mm(mouth.carried + moved).values()]
    return tuple(100 * deep / _RANDOM)


def _recovered(data: GNMData) -> Iterator[Figure]:
    """Fit key points of known poses: single ones, and a movement of 100 times a second."""
    fit, rng = KeyPointFit(data=data, rig=TongueRig(structure=find_tongue(data))), np.random.default_rng(0)
    gaps = rng.uniform(*_GAPS_M, _POSES)
    controls = np.stack([_fitting(fit, gap, rng) for gap in gaps])
    single = np.arange(_POSES, dtype=float), controls, gaps
    times = np.arange(0, _STEP_S * (_MOVES - 1), 0.01)
    step, share = np.divmod(times / _STEP_S, 1)
    first, share = step.astype(int), (1 - np.cos(np.pi * share)) / 2
    moving = [values[first] + (share * (values[first + 1] - values[first]).T).T for values in (controls, gaps)]
    # Noise is told as its root mean square in all three coordinates together.
    for title, poses, noise, most in (
        ("single poses, exact", single, 0.0, 0.5),
        ("single poses, noise of 1 mm", single, 1.0, 1.0),
        ("single poses, noise of 1 mm in each coordinate", single, np.sqrt(3), None),
        ("a movement, exact", (times, *moving), 0.0, 0.5),
        ("a movement, noise of 1 mm in each coordinate", (times, *moving), np.sqrt(3), 1.0),
    ):
        points, whole, deep = _fit_again(fit, poses, noise / np.sqrt(3))
        yield Figure(name=f"three key points, {title}: error, rms", value=points, unit="mm", most=most)
        yield Figure(name=f"three key points, {title}: whole tongue, mean", value=whole, unit="mm")
        yield Figure(name=f"three key points, {title}: deeper than {_FITTED_MM} mm", value=deep, unit="poses", most=0)


def _fitting(fit: KeyPointFit, gap: float, rng: np.random.Generator) -> Float[np.ndarray, "C"]:
    """Draw a pose that fits a mouth."""
    while True:
        controls = draw_controls(rng, PoseSettings().pose_spread)
        tongue, mouth = fit.rig.pose(controls), fit.mouth(gap)
        inside = max(mouth.excess_mm(mouth.carried + tongue - fit.rig.structure.rest).values())
        if abs(fit.rig.volume_ratio(tongue) - 1) < PoseSettings().volume_change and inside <= _FITTED_MM:
            return controls


def _fit_again(
    fit: KeyPointFit,
    poses: tuple[Float[np.ndarray, "T"], Float[np.ndarray, "T C"], Float[np.ndarray, "T"]],
    noise_mm: float,
) -> tuple[float, float, int]:
    """Errors of key points and of the whole tongue, mm, and how many fits lie in teeth, palate, lips or cheeks.

    Before the poses the tongue is at rest for a while, with the jaw closed: the gap is measured from there.
    """
    rest, rng = fit.rig.structure.rest, np.random.default_rng(5)
    times, controls, gaps = (np.concatenate([np.zeros((_REST, *part.shape[1:])), part]) for part in poses)
    times[:_REST] = np.arange(_REST) - 100
    posed = [fit.rig.pose(values) for values in controls]
    true = [fit.points_of(tongue, gap) for tongue, gap in zip(posed, gaps, strict=True)]
    points = {
        name: np.array([moment[name] for moment in true]) + rng.normal(0, noise_mm, (len(true), 3))
        for name in TONGUE_POINTS[:3]
    }
    points["upper_incisors"] = np.zeros((len(true), 3))
    points["lower_incisors"] = np.stack([0 * gaps, -MM_PER_M * gaps, 0 * gaps], 1)
    fitted = fit.fit(TongueRecording(time_s=times, points=points), _POSES + _REST)
    error, whole, deep = [], [], 0
    for k, displacement in zip(fitted.times.tolist(), fitted.displacements, strict=True):
        if k >= _REST:
            found, mouth = fit.points_of(rest + displacement, float(gaps[k])), fit.mouth(gaps[k])
            error.append(np.mean([((found[name] - true[k][name]) ** 2).sum() for name in TONGUE_POINTS[:3]]))
            whole.append(np.linalg.norm(rest + displacement - posed[k], axis=1).mean() * MM_PER_M)
            deep += max(mouth.excess_mm(mouth.carried + displacement).values()) > _FITTED_MM
    return float(np.sqrt(np.mean(error))), float(np.mean(whole)), deep
