"""The metrics of one registration, as docs/formats.md, "Figures", defines them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from registration.capture.native import read_capture
from registration.capture.scan import Scan, read_scan, read_truth
from registration.errors import InputError
from registration.evaluate.console_table import print_metrics
from registration.evaluate.distances import (
    TriangleSurface,
    distance_statistics,
    distances_mm,
    scan_to_mesh_area_uniform,
)
from registration.evaluate.face import FaceSphere, face_sphere, visible_in_two_views
from registration.evaluate.truth import drift, face_vertices, require_same_topology, vertex_error
from registration.frames import MM_PER_M
from registration.storage.registration_folder import load_registration, update_figures
from registration.types import Capture, Registration

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
    scan, sphere, scan_visible = _visible_scan(registration, capture)
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
        metrics["scan_to_mesh_by_area"] = {"face": scan_to_mesh_area_uniform(scan_surface, face, mesh)}
        visible = np.flatnonzero(visible_in_two_views(mesh.vertices, mesh.vertices, mesh.triangles, cameras))
        vertex_distance[visible] = distances_mm(mesh.vertices[visible], scan_surface)
        vertex_regions = {"face": sphere.contains(mesh.vertices), **(regions or {})}
        metrics["mesh_to_scan"] = {
            name: distance_statistics(vertex_distance[region & np.isfinite(vertex_distance)])
            for name, region in vertex_regions.items()
        }
    metrics |= _truth_metrics(registration, scan.vertices[face], capture, neutral, neutral_capture)
    return RegistrationEvaluation(
        metrics=metrics,
        scan=scan,
        scan_distance_mm=distance,
        scan_visible=scan_visible,
        scan_face=face,
        vertex_distance_mm=vertex_distance,
    )


def evaluate_folder(
    registration_dir: Path,
    capture_dir: Path,
    neutral_dir: Path | None = None,
    neutral_capture_dir: Path | None = None,
) -> RegistrationEvaluation:
    """Evaluate a registration folder, print its metrics and add them to its manifest.

    Args:
        registration_dir: the registration folder.
        capture_dir: the folder of its capture, with a scan.
        neutral_dir: registration folder of the subject's neutral, for drift.
        neutral_capture_dir: the folder of the neutral's capture; needed with `neutral_dir`.

    Returns:
        The evaluation.

    Raises:
        InputError: as `evaluate_registration`, or a folder cannot be read.
    """
    registration, capture = load_registration(registration_dir), read_capture(capture_dir)
    evaluation = evaluate_registration(
        registration,
        capture,
        neutral=load_registration(neutral_dir) if neutral_dir else None,
        neutral_capture=read_capture(neutral_capture_dir) if neutral_capture_dir else None,
    )
    update_figures(registration_dir, evaluation.metrics)
    print_metrics(evaluation.metrics, title=f"{capture.subject} {capture.expression}: {registration.status}")
    return evaluation


def _visible_scan(registration: Registration, capture: Capture) -> tuple[Scan, FaceSphere, Bool[np.ndarray, "P"]]:
    """Return the scan, the face sphere, and which scan points at least two cameras see."""
    if capture.scan is None:
        raise InputError(
            "The capture has no scan to compare with",
            where=capture.root,
            expected="scan.ply",
            got="no such file",
            fix="add the scan; registration itself does not need it",
        )
    sphere = face_sphere(capture, registration)
    scan = read_scan(capture.scan)
    cameras = [view.camera for view in capture.views]
    if len(scan.triangles):
        return scan, sphere, visible_in_two_views(scan.vertices, scan.vertices, scan.triangles, cameras)
    mesh = _surface(registration)
    visible = visible_in_two_views(scan.vertices, mesh.vertices, mesh.triangles, cameras, CLOUD_TOLERANCE)
    return scan, sphere, visible


def _surface(registration: Registration) -> TriangleSurface:
    return TriangleSurface(vertices=registration.vertices.astype(np.float64), triangles=registration.triangles)


def _truth_metrics(
    registration: Registration,
    face_points: Float[np.ndarray, "P 3"],
    capture: Capture,
    neutral: Registration | None,
    neutral_capture: Capture | None,
) -> dict[str, Any]:
    """Return the vertex error if truth and registration share a topology, and the drift if the two truths do."""
    metrics: dict[str, Any] = {}
    if capture.ground_truth is None:
        return metrics
    truth = read_truth(capture.ground_truth).astype(np.float64)
    if truth.shape == registration.vertices.shape:
        metrics["vertex_error"] = {"face": vertex_error(registration, truth, face_vertices(truth, face_points))}
    if neutral and neutral_capture and neutral_capture.ground_truth:
        neutral_truth = read_truth(neutral_capture.ground_truth).astype(np.float64)
        if neutral_truth.shape == truth.shape:
            scan, sphere, visible = _visible_scan(neutral, neutral_capture)
            face = face_vertices(neutral_truth, scan.vertices[visible & sphere.contains(scan.vertices)])
            metrics["drift"] = {"face": drift(registration, truth, neutral, neutral_truth, face)}
    return metrics
