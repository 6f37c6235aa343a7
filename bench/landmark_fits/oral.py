"""Teeth and tongue of open mouths, from landmarks of scheme `oral` where the mouth shows them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from bench.landmark_fits.heads import HeadModel
from bench.landmark_fits.pictures import Pinhole, cameras_around, observe
from bench.landmark_fits.rows import Row, at_most
from coregister.first_model import makehuman, population
from coregister.first_model.assembly import build_assembly
from coregister.first_model.build import TargetDisplacements
from coregister.synthetic.expressions import Expression, apply_expression
from registration.evaluate.audit import BEYOND_KEY, audit_penetration
from registration.geometry.rasterizer import RayCaster
from registration.geometry.rigid import similarity_transform
from registration.landmark_fit.fit import fit_many
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.result import LandmarkFit
from registration.model import regions
from registration.model.landmarks import LandmarkScheme

VIEWS = (1, 3)
POSES = {"jaw open": 0.15, "tongue out": 1.0}  # protrusion of the tongue at most
TEETH = 12  # the first landmarks of `oral`; six of the tongue follow
LEAST_SEEN = 2
TEETH_LIMIT_MM, TONGUE_LIMIT_MM, PENETRATION_LIMIT = 2.0, 3.0, 2.0  # the last: per cent of the fits
_SEEN_M = 1e-3  # a surface nearer to the camera by less does not hide a landmark


def mouths(model: HeadModel, count: int, out: float, seed: int = 21) -> list[Float[np.ndarray, "V 3"]]:
    """Heads with open mouths, of MakeHuman people that the first model spans; none has penetrations.

    Args:
        model: the first model.
        count: number of heads.
        out: protrusion of the tongue at most, from 0 to 1.
        seed: of the random people.
    """
    rng = np.random.default_rng(seed)
    assembly = build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    targets = TargetDisplacements(assembly.source)
    result: list[np.ndarray] = []
    while len(result) < count:
        units = {"jawOpen": rng.uniform(0.5, 1.0), "mouthStretchLeft": rng.uniform(0, 0.4)}
        units["mouthStretchRight"] = units["mouthStretchLeft"]
        units["mouthUpperUpLeft"] = units["mouthUpperUpRight"] = rng.uniform(0, 0.5)
        tongue = {"out": out * rng.uniform(0.7, 1.0), "bend": 0.2 * rng.normal(), "turn": 0.05 * rng.normal()}
        expression = Expression(category="mouth", units=units, tongue=tongue)
        person = population.sample_spanned_person(assembly.source, rng)
        head = apply_expression(assembly, expression, *assembly.assemble(person, targets))
        if not audit_penetration(head, model.data).metrics[BEYOND_KEY]:
            result.append(head)
    return result


def scheme_of(model: HeadModel) -> tuple[LandmarkScheme, Bool[np.ndarray, "L"]]:
    """The landmarks of 68, dense and oral, and which are oral."""
    parts = [model.schemes[name] for name in ("68", "dense", "oral")]
    indices, weights = (np.concatenate([getattr(part, name) for part in parts]) for name in ("indices", "weights"))
    oral_rows = np.arange(len(indices)) >= len(indices) - len(parts[-1].indices)
    return LandmarkScheme(name="mouth", indices=indices, weights=weights), oral_rows


def visible_only(
    observations: Observations, vertices: np.ndarray, triangles: np.ndarray, cameras: Sequence[Pinhole]
) -> Observations:
    """Without the landmarks that the head hides from a camera."""
    points = observations.scheme.points(vertices)
    caster = RayCaster(vertices, triangles)
    pixels = observations.points_px.copy()
    for v, camera in enumerate(cameras):
        pixels[0, v, ~caster.visible(points, camera.calibrated(), _SEEN_M)] = np.nan
    return replace(observations, points_px=pixels)


def oral(model: HeadModel, count: int) -> list[Row]:
    """Errors of teeth and tongue, and penetrations, with the anatomical term and without; one view and three.

    A head counts for the teeth or the tongue if a camera sees at least `LEAST_SEEN` of its landmarks.
    """
    rows = []
    for pose, out in POSES.items():
        heads = mouths(model, count, out)
        for views in VIEWS:
            rows += _measured(model, heads, views, f"{pose}, {views} view{'s'[: views > 1]}")
    return rows


def _measured(model: HeadModel, heads: list[np.ndarray], views: int, name: str) -> list[Row]:
    rng = np.random.default_rng(22)
    scheme, is_oral = scheme_of(model)
    triangles = model.data.triangles.astype(np.int64)
    parts = {"teeth": regions.teeth(model.data), "tongue": regions.tongue(model.data)}
    cameras = cameras_around(model.template[model.face].mean(0), views)
    batch = [
        visible_only(
            observe(scheme, [head], cameras, sigma_px=1.0, known=views > 1, noise=rng), head, triangles, cameras
        )
        for head in heads
    ]
    seen = np.array([of.seen[0][:, is_oral].any(0) for of in batch])
    counts = {"teeth": seen[:, :TEETH].sum(1), "tongue": seen[:, TEETH:].sum(1)}
    limits = {"teeth": TEETH_LIMIT_MM, "tongue": TONGUE_LIMIT_MM}
    rows = []
    for weight in (1.0, 0.0):
        options = FitOptions(expression_sigma=model.expression_sigma, anatomy=weight, covariance=False)
        fits = list(fit_many(batch, model.data, options))
        errors, crossing, excess = _errors(model, fits, heads)
        case = f"{name}, anatomical term {'on' if weight else 'off'}"
        for part, rows_of in parts.items():
            chosen = counts[part] >= LEAST_SEEN
            if chosen.any():
                what = f"{case}: {part}, {int(chosen.sum())} heads, {counts[part][chosen].mean():.1f} landmarks seen"
                rows.append(at_most(what, float(errors[chosen][:, rows_of].mean()), limits[part], "mm"))
        what = f"{case}: fits with penetrations > 0.3 mm beyond the template's"
        rows.append(at_most(what, 100 * float(np.mean(crossing)), PENETRATION_LIMIT, "%"))
        seconds = np.mean([fit.seconds for fit in fits])
        measured = f"{np.mean(excess):.2f}, {np.max(excess):.2f} mm; {seconds:.2f} s"
        rows.append(Row(what=f"{case}: deepest excess, mean and largest; time of a fit", measured=measured))
    return rows


def _errors(
    model: HeadModel, fits: list[LandmarkFit], heads: list[np.ndarray]
) -> tuple[Float[np.ndarray, "N V"], list[bool], list[float]]:
    """Errors of all vertices after a similarity of the faces, mm; which fits penetrate; their deepest excess, mm."""
    errors, crossing, excess = [], [], []
    for fit, truth in zip(fits, heads, strict=True):
        vertices = model.posed(fit.parameters(0))
        s, R, t = similarity_transform(vertices[model.face], truth[model.face], free_scale=True)
        errors.append(1e3 * np.linalg.norm(s * vertices @ R.T + t - truth, axis=1))
        audit = audit_penetration(vertices, model.data, fit.scale)
        crossing.append(bool(audit.metrics[BEYOND_KEY]))
        excess.append(max(pair.metrics["max_excess_mm"] for pair in audit.pairs))
    return np.array(errors), crossing, excess
