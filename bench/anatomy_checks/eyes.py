"""Eyes and pupils: against the analytic eye of two spheres, and left against right."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from bench.anatomy_checks import Figure
from coregister.anatomy import eye_sections
from coregister.anatomy.assemble import AnatomySettings, RegeneratedModel, identity_order, regenerate
from registration.anatomy.eye_structure import EyeStructure, find_eyes
from registration.frames import MM_PER_M
from registration.model.gnm_npz import GNMData

_DIRECTIONS = np.stack([np.cos(a := np.radians(np.arange(0, 360, 15))), np.sin(a)], 1)  # on the ellipse of 2 sigma
_CORNERS = np.array([(a, b) for a in (-1.0, 1.0) for b in (-1.0, 1.0)])


def figures(data: GNMData) -> Iterator[Figure]:
    """Regenerate eyes and pupils and measure the written model's arrays."""
    made = regenerate(data, AnatomySettings(parts=("eyes", "pupils")))
    eyes = find_eyes(made.data)
    record = made.anatomy["parts"]["eyes"]
    yield Figure(name="sclera radius", value=record["sclera_radius_mm"], unit="mm")
    yield Figure(name="cross-sections rejected", value=record["rejected"], unit=f"of {record['samples']}")
    yield Figure(name="variance kept by three components", value=record["variance_kept"], unit="", least=0.99)
    yield Figure(name="template moved at most", value=record["template_moved_mm"], unit="mm")
    rows = _own_frames(made, eyes)
    for name, radii, most in (
        ("radius, on the ellipse of 2 sigma", 2 * _DIRECTIONS, 0.02),
        ("radius, both radii at 2 sigma", 2 * _CORNERS, None),
    ):
        worst = max(_radius_error(eyes, rows, *pair) for pair in radii)
        yield Figure(name=f"{name}, from two spheres", value=MM_PER_M * worst, unit="mm", most=most)
    worst = max(_shell_gap(eyes, rows, sign * vector) for sign in (-2, 2) for vector in np.eye(3))
    yield Figure(name="interior outside the exterior at 2 sigma", value=MM_PER_M * worst, unit="mm", most=0.0)
    yield Figure(name="left from right, eyes", value=_asymmetry(made.data, eyes), unit="m", most=1e-7)
    yield from _pupil(made.data, eyes)


def _own_frames(made: RegeneratedModel, eyes: EyeStructure) -> Float[np.ndarray, "1+K N 3"]:
    """The left eye's vertices and components, in its own frame."""
    data = made.data
    rest = data.template_vertex_positions[eyes.left.vertices].astype(np.float64) - eyes.left.centre
    rows = data.vertex_identity_basis[identity_order(data)["eyes"]][:, eyes.left.vertices].astype(np.float64)
    return eyes.left.to_own(np.concatenate([rest[None], rows]))


def _radius_error(eyes: EyeStructure, rows: Float[np.ndarray, "1+K N 3"], limbus: float, cornea: float) -> float:
    """The largest difference of radius outside the smoothed zone, of the best coefficients for the analytic eye; m.

    The radii are given in standard deviations.
    """
    r_s = eyes.sclera_radius
    r_l = eye_sections.LIMBUS_RADIUS + limbus * eye_sections.LIMBUS_DEVIATION
    r_c = eye_sections.CORNEA_RADIUS + cornea * eye_sections.CORNEA_DEVIATION
    wanted = eye_sections.surface(eyes.polar_angle[eyes.exterior], np.array(r_l), np.array(r_c), r_s)
    wanted = wanted[..., :1] * eyes.outward[eyes.exterior] + wanted[..., 1:] * [0, 0, 1]
    basis = rows[1:, eyes.exterior].reshape(len(rows) - 1, -1)
    coefficients = np.linalg.lstsq(basis.T, (wanted - rows[0, eyes.exterior]).ravel(), rcond=None)[0]
    points = rows[0, eyes.exterior] + np.einsum("k,knc->nc", coefficients, rows[1:, eyes.exterior])
    radius = np.linalg.norm(points, axis=1)
    angle = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    edge = np.arcsin(r_l / r_s)
    centre = np.sqrt(r_s**2 - r_l**2) - np.sqrt(r_c**2 - r_l**2)
    inside = angle < edge
    sphere = np.full(len(angle), r_s)
    sphere[inside] = centre * np.cos(angle[inside]) + np.sqrt(r_c**2 - (centre * np.sin(angle[inside])) ** 2)
    outside = np.abs(angle - edge) > eye_sections.half_blend(r_s)
    return float(np.abs(radius - sphere)[outside].max())


def _shell_gap(eyes: EyeStructure, rows: Float[np.ndarray, "1+K N 3"], coefficients: Float[np.ndarray, "K"]) -> float:
    """How far the interior reaches out of the exterior, at its vertices; metres, negative: it lies inside."""
    points = rows[0] + np.einsum("k,knc->nc", coefficients, rows[1:])
    radius, angle = np.linalg.norm(points, axis=1), np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    outer = np.flatnonzero(eyes.exterior)
    outer = outer[np.argsort(angle[outer])]
    return float((radius - np.interp(angle, angle[outer], radius[outer]))[~eyes.exterior].max())


def _asymmetry(data: GNMData, eyes: EyeStructure) -> float:
    """The largest difference between the eyes' components, each in its own frame, metres."""
    basis = np.concatenate(
        [data.vertex_identity_basis[identity_order(data)["eyes"]], data.expression_basis[_pupil_row(data)]]
    ).astype(np.float64)
    left, right = (eye.to_own(basis[:, eye.vertices]) for eye in (eyes.left, eyes.right))
    return float(np.linalg.norm(left - right, axis=2).max())


def _pupil_row(data: GNMData) -> list[int]:
    return [data.expression_names.tolist().index("pupils_000")]


def _pupil(data: GNMData, eyes: EyeStructure) -> Iterator[Figure]:
    """The pupil's radius at -3, 0 and 3, of both eyes in the model's own arrays."""
    basis = data.expression_basis[_pupil_row(data)[0]].astype(np.float64)
    template = data.template_vertex_positions.astype(np.float64)
    distance = {
        c: np.stack(
            [
                np.linalg.norm((eye.to_own((template + c * basis)[eye.vertices] - eye.centre))[:, :2], axis=1)
                for eye in (eyes.left, eyes.right)
            ]
        )
        for c in (-3, 0, 3)
    }
    iris = distance[0][:, eyes.iris].max()
    edge = eyes.pupil & (distance[0][0] > 0.98 * distance[0][0, eyes.pupil].max())
    yield Figure(name="iris radius", value=MM_PER_M * iris, unit="mm")
    for name, error in (
        ("at -3: from a point", distance[-3][:, eyes.pupil]),
        ("at 0: from half the iris", distance[0][:, edge] - iris / 2),
        ("at 3: from the whole iris", distance[3][:, edge] - iris),
    ):
        yield Figure(name=f"pupil {name}", value=float(np.abs(error).max()), unit="m", most=1e-6)
