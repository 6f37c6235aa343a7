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
    """Fit key points of known poses, exact and with noise of 1 mm rms in all three coordinates together."""
    fit, rng = KeyPointFit(data=data, rig=TongueRig(structure=find_tongue(data))), np.random.default_rng(0)
    posed: list[np.ndarray] = []
    while len(posed) < _POSES:
        tongue = fit.rig.pose(draw_controls(rng, PoseSettings().pose_spread))
        if abs(fit.rig.volume_ratio(tongue) - 1) < PoseSettings().volume_change:
            posed.append(tongue)
    gaps = np.r_[0.0, rng.uniform(0, 0.02, _POSES - 1)]
    true = [fit.points_of(tongue, gap) for tongue, gap in zip(posed, gaps, strict=True)]
    for noise, most in ((0.0, 0.5), (1.0, 1.0)):
        points = {
            name: np.array([moment[name] for moment in true]) + rng.normal(0, noise / np.sqrt(3), (_POSES, 3))
            for name in TONGUE_POINTS[:3]
        }
        points["upper_incisors"] = np.zeros((_POSES, 3))
        points["lower_incisors"] = np.stack([0 * gaps, -MM_PER_M * gaps, 0 * gaps], 1)
        times = np.arange(_POSES) / 100
        fitted = fit.fit(TongueRecording(time_s=times, points=points), _POSES)
        error, whole = [], []
        for k, displacement in enumerate(fitted.displacements):
            found = fit.points_of(fit.rig.structure.rest + displacement, float(gaps[k]))
            error.append(np.mean([((found[name] - true[k][name]) ** 2).sum() for name in TONGUE_POINTS[:3]]))
            whole.append(np.linalg.norm(fit.rig.structure.rest + displacement - posed[k], axis=1).mean() * MM_PER_M)
        name = f"with {noise:g} mm of noise" if noise else "exact"
        yield Figure(name=f"three key points, {name}: error, rms", value=np.sqrt(np.mean(error)), unit="mm", most=most)
        yield Figure(name=f"three key points, {name}: whole tongue, mean", value=np.mean(whole), unit="mm")
