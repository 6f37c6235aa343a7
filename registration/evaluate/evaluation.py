"""The metrics of one registration, as docs/formats.md, "Figures", defines them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from registration.capture.scan import SCAN, Scan, read_scan, read_truth, unread_scans
from registration.errors import InputError
from registration.evaluate.distances import (
    TriangleSurface,
    distance_statistics,
    distances_mm,
    scan_to_mesh_area_uniform,
)
from registration.evaluate.face import FaceSphere, face_sphere, views_of, visible_in_two_views
from registration.evaluate.truth import drift, face_vertices, require_same_topology, vertex_error
from registration.frames import MM_PER_M
from registration.types import METRIC_TITLES, Capture, Registration

# Metres. A point cloud occludes nothing, so the registered surface must: also points that it misses by a little.
CLOUD_TOLERANCE = 5e-3


@dataclass(frozen=True, kw_only=True)
class RegistrationEvaluation:
    """Metrics of a registration for its manifest, and the distances behind them. P scan vertices, V mesh vertices."""

    metrics: Mapping[str, Any]  # docs/formats.md, "Figures"
    scan: Scan
    scan_distance_mm: Float[np.ndarray, "P"]  # of each scan vertex to the registered surface
    scan_visible: Bool[np.ndarray, "P"]  # to at least two cameras
    scan_face: Bool[np.ndarray, "P"]  # visible, and in the face sphere
    vertex_distance_mm: Float[np.ndarray, "V"]  # of each registered vertex to the scan; NaN where not visible


def evaluate_registration(
    registration: Registration,
    capture: Capture,
    *,
    neutral: Registration | None = None,
    neutral_capture: Capture | None = None,
    regions: Mapping[str, Bool[np.ndarray, "V"]] | None = None,
) -> RegistrationEvaluation:
    """Measure a registration against its capture's scan and, where the topologies permit, against true vertices.

    Args:
        registration: of the capture.
        capture: with a scan.
        neutral: registration of the subject's neutral, for drift.
        neutral_capture: its capture; needed with `neutral`.
        regions: name -> vertices for which the mesh-to-scan distances are also computed.

    Returns:
        Metrics in millimetres, and the distances behind them.

    Raises:
        InputError: the capture has no scan, the face cannot be located, only one of `neutral` and `neutral_capture` is
            given, or the neutral's topology differs.
    """
    if (neutral is None) != (neutral_capture is None):
        raise InputError(
            "The neutral is incomplete",
            where="evaluate",
            expected="a neutral registration together with its capture",
            got="only one of them",
            fix="give both --neutral and --neutral-capture",
        )
    if neutral is not None:
        require_same_topology(registration, neutral)
    seen = _visible_scan(registration, capture)
    scan, sphere, scan_visible = seen.scan, seen.sphere, seen.visible
    cameras = [view.camera for view in capture.views]
    mesh = _surface(registration)
    face = scan_visible & sphere.contains(scan.vertices)
    distance = distances_mm(scan.vertices, mesh)
    metrics: dict[str, Any] = {
        "face_ball": {
            "centre": sphere.centre.tolist(),
            "radius_mm": sphere.radius * MM_PER_M,
            "landmarks": sphere.landmarks,
        },
        "scan_to_mesh": {
            "face": distance_statistics(distance[face]),
            "seen": distance_statistics(distance[scan_visible]),
        },
    }
    vertex_distance = np.full(len(mesh.vertices), np.nan)
    if len(scan.triangles):
        scan_surface = TriangleSurface(vertices=scan.vertices, triangles=scan.triangles)
        metrics["scan_to_mesh_by_area"] = {"face": scan_to_mesh_area_uniform(scan_surface, face, mesh, seen.towards)}
        visible = np.flatnonzero(visible_in_two_views(mesh.vertices, mesh.vertices, mesh.triangles, cameras))
        vertex_distance[visible] = distances_mm(mesh.vertices[visible], scan_surface)
        vertex_regions = {"face": sphere.contains(mesh.vertices), **(regions or {})}
        metrics["mesh_to_scan"] = {
            name: distance_statistics(vertex_distance[region & np.isfinite(vertex_distance)])
            for name, region in vertex_regions.items()
        }
    truth = _truth_metrics(registration, scan.vertices[face], capture, neutral, neutral_capture)
    metrics |= {name: figure for name, figure in truth.items() if not isinstance(figure, str)}
    reasons = _scan_reasons(metrics, seen) | {name: why for name, why in truth.items() if isinstance(why, str)}
    metrics["unmeasured"] = {name: why for name in METRIC_TITLES if (why := reasons.get(name))}
    return RegistrationEvaluation(
        metrics=metrics,
        scan=scan,
        scan_distance_mm=distance,
        scan_visible=scan_visible,
        scan_face=face,
        vertex_distance_mm=vertex_distance,
    )


@dataclass(frozen=True, kw_only=True)
class _SeenScan:
    """A scan, and what of it the cameras see."""

    scan: Scan
    sphere: FaceSphere
    visible: Bool[np.ndarray, "P"]  # to at least two cameras
    towards: Float[np.ndarray, "P 3"]  # a direction from each vertex to the cameras that see it


def without_scan(capture: Capture) -> dict[str, str]:
    """Return the entry `unmeasured` of the metrics of a capture without a scan."""
    others = unread_scans(capture.root)
    beside = f"; {', '.join(others)} is not read" if others else ""
    return {"scan_to_mesh": f"the capture has no {SCAN}{beside}"}


def _visible_scan(registration: Registration, capture: Capture) -> _SeenScan:
    """Read the scan, and find the face and what at least two cameras see."""
    if capture.scan is None:
        raise InputError(
            "The capture has no scan to compare with",
            where=capture.root,
            expected=SCAN,
            got=without_scan(capture)["scan_to_mesh"],
            fix="add the scan as PLY; registration itself does not need it",
        )
    sphere = face_sphere(capture, registration)
    scan = read_scan(capture.scan)
    cameras = [view.camera for view in capture.views]
    if len(scan.triangles):
        count, towards = views_of(scan.vertices, scan.vertices, scan.triangles, cameras)
    else:
        mesh = _surface(registration)
        count, towards = views_of(scan.vertices, mesh.vertices, mesh.triangles, cameras, CLOUD_TOLERANCE)
    return _SeenScan(scan=scan, sphere=sphere, visible=count >= 2, towards=towards)


def _scan_reasons(metrics: Mapping[str, Any], seen: _SeenScan) -> dict[str, str]:
    """Metric -> why it has no value on the face."""
    empty = {name for name in METRIC_TITLES if name in metrics and metrics[name]["face"]["mean_mm"] is None}
    reasons = dict.fromkeys(empty, "")
    within = seen.sphere.contains(seen.scan.vertices)
    if not within.any():
        nearest = np.linalg.norm(seen.scan.vertices - seen.sphere.centre, axis=1).min() * MM_PER_M
        reasons = dict.fromkeys(empty, f"no vertex of the scan lies in the face; the nearest is {nearest:.0f} mm away")
    elif not (within & seen.visible).any():
        reasons = dict.fromkeys(empty, "no vertex of the scan's face is seen by two cameras")
    elif (by_area := metrics.get("scan_to_mesh_by_area", {}).get("face")) and by_area["mean_mm"] is None:
        opposed, boundary = by_area["dropped_normals"], by_area["dropped_boundary"]
        reasons["scan_to_mesh_by_area"] = (
            "no face of the scan lies in the face with all corners"
            if opposed is None
            else f"all points are dropped: {opposed:.0%} for their normals, {boundary:.0%} at boundaries"
        )
    if "mesh_to_scan" in empty:
        reasons["mesh_to_scan"] = "no registered vertex of the face is seen by two cameras"
    if not len(seen.scan.triangles):
        reasons |= dict.fromkeys(("scan_to_mesh_by_area", "mesh_to_scan"), "the scan is a point cloud, without faces")
    return reasons


def _surface(registration: Registration) -> TriangleSurface:
    return TriangleSurface(vertices=registration.vertices.astype(np.float64), triangles=registration.triangles)


def _truth_metrics(
    registration: Registration,
    face_points: Float[np.ndarray, "P 3"],
    capture: Capture,
    neutral: Registration | None,
    neutral_capture: Capture | None,
) -> dict[str, dict[str, Any] | str]:
    """Vertex error and drift; in place of one that cannot be measured, why."""
    if capture.ground_truth is None:
        return dict.fromkeys(("vertex_error", "drift"), "the capture has no ground_truth.npz")
    if not len(face_points):
        return dict.fromkeys(("vertex_error", "drift"), "no vertex of the scan's face is seen")
    truth = read_truth(capture.ground_truth).astype(np.float64)
    metrics: dict[str, dict[str, Any] | str] = {}
    metrics["vertex_error"] = f"the ground truth has {len(truth)} vertices, the mesh {len(registration.vertices)}"
    if truth.shape == registration.vertices.shape:
        metrics["vertex_error"] = {"face": vertex_error(registration, truth, face_vertices(truth, face_points))}
    metrics["drift"] = _drift(registration, truth, neutral, neutral_capture)
    return metrics


def _drift(
    registration: Registration,
    truth: Float[np.ndarray, "N 3"],
    neutral: Registration | None,
    neutral_capture: Capture | None,
) -> dict[str, Any] | str:
    """The drift, or why it cannot be measured."""
    if neutral is None or neutral_capture is None:
        return "it needs the registration and the capture of the subject's neutral"
    if neutral_capture.ground_truth is None:
        return "the neutral's capture has no ground_truth.npz"
    if neutral_capture.scan is None:
        return "the neutral's capture has no scan"
    neutral_truth = read_truth(neutral_capture.ground_truth).astype(np.float64)
    if neutral_truth.shape != truth.shape:
        return f"the neutral's ground truth has {len(neutral_truth)} vertices, the capture's {len(truth)}"
    seen = _visible_scan(neutral, neutral_capture)
    points = seen.scan.vertices[seen.visible & seen.sphere.contains(seen.scan.vertices)]
    if not len(points):
        return "no vertex of the face of the neutral's scan is seen"
    return {"face": drift(registration, truth, neutral, neutral_truth, face_vertices(neutral_truth, points))}
