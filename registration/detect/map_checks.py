"""Checks of a map of scheme "face478" on the model itself: lids, lips, irises, left against right; and its picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.detect import face478_points as named
from registration.detect.map_regions import lid_edges
from registration.frames import MM_PER_M
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.model.info import COLOURS, landmarks_in_view, rotation_y, shaded
from registration.model.landmarks import LandmarkScheme

CLOSED, OPEN_MOUTH = "closed lids", "jaw open"  # expressions that are checked where the basis can make them
APERTURE_MM = 2.0  # largest difference of the lids' distance from that of the model's own lids
SYMMETRY_MM = 2.0  # largest distance of a point from its counterpart's mirror image
PUPIL_MM = 2.0  # largest distance of the middle of an iris' border from its centre
LEAST_OPENING = 0.7  # of the mouth, between the inner lines, of that of the lips
_MIDDLE_M = 8e-3  # half width of the middle of the lips
_COLUMN_M = 2e-3  # width within which rims are compared
_ORDER_M = 5e-4  # by which lip lines may touch
_LIDS = {
    "left": (named.LEFT_LID_UPPER, named.LEFT_LID_LOWER, named.LEFT_PUPIL, named.LEFT_IRIS),
    "right": (named.RIGHT_LID_UPPER, named.RIGHT_LID_LOWER, named.RIGHT_PUPIL, named.RIGHT_IRIS),
}
_LIPS = (named.LIPS_OUTER_UPPER, named.LIPS_INNER_UPPER, named.LIPS_INNER_LOWER, named.LIPS_OUTER_LOWER)
_VIEWS = {"front": 0.0, "left, 55 degrees": -55.0}


@dataclass(frozen=True, kw_only=True)
class Check:
    """One check of a map."""

    name: str
    passed: bool
    detail: str  # what was measured


def check_map(
    data: GNMData,
    scheme: LandmarkScheme,
    opposite: tuple[int, ...],
    expressions: Mapping[str, Float[np.ndarray, "V 3"]],
) -> list[Check]:
    """Check a map on the template and, where they are given, with closed lids and open mouth.

    Args:
        data: the model.
        scheme: the map, of 478 points.
        opposite: the landmark on the other side; negative: unknown.
        expressions: displacements, metres, by name.
    """
    template = data.template_vertex_positions.astype(np.float64)
    checks = [_lids(data, scheme, template, "open")]
    if CLOSED in expressions:
        checks.append(_lids(data, scheme, template + expressions[CLOSED], "closed"))
    checks.append(_lips(scheme, template, "closed"))
    if OPEN_MOUTH in expressions:
        checks.append(_lips(scheme, template + expressions[OPEN_MOUTH], "open"))
        checks.append(_mouth(data, scheme, template, template + expressions[OPEN_MOUTH]))
    return [*checks, _irises(scheme, template), _symmetry(scheme, template, opposite)]


def lid_apertures(
    data: GNMData, scheme: LandmarkScheme, vertices: Float[np.ndarray, "V 3"]
) -> dict[str, tuple[float, float]]:
    """Return the height of each eye's opening in its middle, metres: of the map's points, and of the model's lids.

    Lids that overlap are closed: 0.

    Args:
        data: the model.
        scheme: the map, of 478 points.
        vertices: of a head in the model's frame.
    """
    points = scheme.points(vertices)
    result = {}
    for side, (upper, lower, _, _) in _LIDS.items():
        tops, bottoms = (vertices[rows] for rows in lid_edges(data, left=side == "left"))
        heights, truth = [], []
        for top, bottom in zip(upper[3:6], lower[3:6], strict=True):
            heights.append(max(0.0, points[top, 1] - points[bottom, 1]))
            middle = (points[top, 0] + points[bottom, 0]) / 2
            above, below = (edge[np.abs(edge[:, 0] - middle) < _COLUMN_M, 1] for edge in (tops, bottoms))
            truth.append(max(0.0, above.min() - below.max()) if len(above) and len(below) else np.nan)
        result[side] = (float(np.mean(heights)), float(np.nanmean(truth)))
    return result


def _lids(data: GNMData, scheme: LandmarkScheme, vertices: Float[np.ndarray, "V 3"], state: str) -> Check:
    apertures = lid_apertures(data, scheme, vertices)
    differences = [MM_PER_M * abs(own - truth) for own, truth in apertures.values()]
    detail = ", ".join(
        f"{side} {MM_PER_M * own:.1f} mm (lids {MM_PER_M * truth:.1f})" for side, (own, truth) in apertures.items()
    )
    return Check(name=f"lid aperture, {state}", passed=bool(max(differences) <= APERTURE_MM), detail=detail)


def _lips(scheme: LandmarkScheme, vertices: Float[np.ndarray, "V 3"], state: str) -> Check:
    heights = np.stack([scheme.points(vertices)[list(line[1:-1]), 1] for line in _LIPS])  # without the corners
    gaps = heights[:-1] - heights[1:]
    wrong = int((gaps < -_ORDER_M).any(0).sum())
    middle = ", ".join(f"{MM_PER_M * gap:.1f}" for gap in gaps[:, gaps.shape[1] // 2])
    detail = f"{wrong} of {gaps.shape[1]} columns out of order; outer, inner, inner, outer: {middle} mm apart"
    return Check(name=f"order of the lips, mouth {state}", passed=wrong == 0, detail=detail)


def _mouth(
    data: GNMData, scheme: LandmarkScheme, closed: Float[np.ndarray, "V 3"], opened: Float[np.ndarray, "V 3"]
) -> Check:
    """The inner lines of the lips must part as the model's lips do."""
    middle = np.abs(closed[:, 0]) < _MIDDLE_M
    gaps = []
    for vertices in (closed, opened):
        lips = [vertices[(regions.group(data, name) > 0.5) & middle, 1].mean() for name in ("upper_lip", "lower_lip")]
        points = scheme.points(vertices)[:, 1]
        inner = [points[list(line[4:7])].mean() for line in (named.LIPS_INNER_UPPER, named.LIPS_INNER_LOWER)]
        gaps.append((inner[0] - inner[1], lips[0] - lips[1]))
    own, truth = (MM_PER_M * float(gaps[1][k] - gaps[0][k]) for k in range(2))
    passed = bool(LEAST_OPENING * truth < own < truth / LEAST_OPENING)
    return Check(name="mouth opening", passed=passed, detail=f"{own:.1f} mm (lips {truth:.1f})")


def _irises(scheme: LandmarkScheme, vertices: Float[np.ndarray, "V 3"]) -> Check:
    points = scheme.points(vertices)
    inside, distances = [], []
    for upper, _, pupil, ring in _LIDS.values():
        low, high = sorted((points[upper[0], 0], points[upper[-1], 0]))
        inside.append(low < points[pupil, 0] < high)
        distances.append(MM_PER_M * float(np.linalg.norm(points[list(ring)].mean(0)[:2] - points[pupil, :2])))
    passed = bool(all(inside) and max(distances) <= PUPIL_MM)
    detail = f"{sum(inside)} of 2 between the lids' corners; centre to border's middle {max(distances):.1f} mm"
    return Check(name="irises", passed=passed, detail=detail)


def _symmetry(scheme: LandmarkScheme, vertices: Float[np.ndarray, "V 3"], opposite: tuple[int, ...]) -> Check:
    points, other = scheme.points(vertices), np.array(opposite)
    known = np.flatnonzero(other >= 0)
    distance = MM_PER_M * np.linalg.norm(points[known] * (-1, 1, 1) - points[other[known]], axis=1)
    detail = f"{len(known)} of {len(other)} matched; largest distance {distance.max(initial=0):.1f} mm"
    passed = bool(len(known) >= 0.9 * len(other) and distance.max(initial=0) <= SYMMETRY_MM)
    return Check(name="left against right", passed=passed, detail=detail)


def draw_map(data: GNMData, scheme: LandmarkScheme, path: Path) -> None:
    """Draw the template from two sides with the map's points, coloured by their spread."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure

    vertices = data.template_vertex_positions.astype(np.float64)
    names, membership = regions.vertex_classes(data)
    colours = membership @ np.array([COLOURS[name] for name in names])
    points = scheme.points(vertices)
    low, high = points.min(0), points.max(0)
    spread = np.full(len(points), np.nan) if scheme.spread_m is None else MM_PER_M * scheme.spread_m
    figure = Figure(figsize=(8, 4.6), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    half = 0.55 * float((high - low)[:2].max())
    axes_of_views = figure.subplots(1, 2)
    for axes, (title, angle) in zip(axes_of_views, _VIEWS.items(), strict=True):
        rotated = (vertices - (low + high) / 2) @ rotation_y(angle).T
        polygons, shades = shaded(rotated, data.triangles, 0.5 + 0.5 * colours)
        axes.add_collection(PolyCollection(list(polygons), facecolors=shades, edgecolors=shades, linewidths=0.3))
        placed, outward = landmarks_in_view(scheme, rotated, data.triangles)
        kept = placed[outward]
        shown = axes.scatter(
            kept[:, 0], kept[:, 1], c=spread[outward], s=9, cmap="turbo", vmin=0.5, vmax=6, linewidths=0.2
        )
        axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", title=title)
        axes.set_axis_off()
    figure.colorbar(shown, ax=list(axes_of_views), label="spread, mm", shrink=0.8)
    figure.savefig(path)
