"""The figures of one registration, as docs/formats.md defines them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from registration.capture.native import read_capture
from registration.capture.scan import Scan, read_scan, read_truth
from registration.errors import InputError
from registration.evaluate.console_table import print_figures
from registration.evaluate.distances import Surface, area_uniform, distances_mm, summary
from registration.evaluate.face import FaceBall, face_ball, seen
from registration.evaluate.truth import drift, face_vertices, require_same_topology, vertex_error
from registration.frames import MM_PER_M
from registration.storage.registration_folder import load_registration, update_figures
from registration.types import Capture, Registration

CLOUD_TOLERANCE = 5e-3  # m; a point cloud hides nothing itself, so the registered surface must, however well it fits


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Figures for the manifest and, for pictures, the distances behind them."""

    figures: Mapping[str, Any]
    scan: Scan
    scan_distance_mm: Float[np.ndarray, "P"]  # of each scan vertex to the registered surface
    scan_seen: Bool[np.ndarray, "P"]  # by at least two cameras
    scan_face: Bool[np.ndarray, "P"]  # seen, and in the face ball
    vertex_distance_mm: Float[np.ndarray, "V"]  # of each registered vertex to the scan; NaN where not seen


def evaluate(
    registration: Registration,
    capture: Capture,
    *,
    neutral: Registration | None = None,
    neutral_capture: Capture | None = None,
    regions: Mapping[str, Bool[np.ndarray, "V"]] | None = None,
) -> Evaluation:
    """Compare a registration with its capture's scan and, where they can be compared, with true vertices.

    Args:
        registration: of the capture.
        capture: with a scan.
        neutral: registration of the subject's neutral, for drift.
        neutral_capture: its capture; needed with `neutral`.
        regions: name -> vertices that the mesh-to-scan distances are also computed for.

    Returns:
        Figures in millimetres, and the distances behind them.

    Raises:
        InputError: the capture has no scan, the face cannot be found, one of the neutral's parts is missing, or
            the neutral's topology differs.
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
    scan, ball, seen_scan = _ground(registration, capture)
    cameras = [view.camera for view in capture.views]
    mesh = _surface(registration)
    face = seen_scan & ball.holds(scan.vertices)
    distance = distances_mm(scan.vertices, mesh)
    figures: dict[str, Any] = {
        "face_ball": {"centre": ball.centre.tolist(), "radius_mm": ball.radius * MM_PER_M, "landmarks": ball.landmarks},
        "scan_to_mesh": {"face": summary(distance[face]), "seen": summary(distance[seen_scan])},
    }
    vertex_distance = np.full(len(mesh.vertices), np.nan)
    if len(scan.triangles):
        surface = Surface(vertices=scan.vertices, triangles=scan.triangles)
        figures["scan_to_mesh_by_area"] = {"face": area_uniform(surface, face, mesh)}
        outer = np.flatnonzero(seen(mesh.vertices, mesh.vertices, mesh.triangles, cameras))
        vertex_distance[outer] = distances_mm(mesh.vertices[outer], surface)
        parts = {"face": ball.holds(mesh.vertices), **(regions or {})}
        figures["mesh_to_scan"] = {
            name: summary(vertex_distance[part & np.isfinite(vertex_distance)]) for name, part in parts.items()
        }
    figures |= _truth_figures(registration, scan.vertices[face], capture, neutral, neutral_capture)
    return Evaluation(
        figures=figures,
        scan=scan,
        scan_distance_mm=distance,
        scan_seen=seen_scan,
        scan_face=face,
        vertex_distance_mm=vertex_distance,
    )


def evaluate_folder(
    registration_dir: Path,
    capture_dir: Path,
    neutral_dir: Path | None = None,
    neutral_capture_dir: Path | None = None,
) -> Evaluation:
    """Evaluate a registration folder, print its figures and add them to its manifest.

    Raises:
        InputError: as `evaluate`, or a folder cannot be read.
    """
    registration, capture = load_registration(registration_dir), read_capture(capture_dir)
    evaluation = evaluate(
        registration,
        capture,
        neutral=load_registration(neutral_dir) if neutral_dir else None,
        neutral_capture=read_capture(neutral_capture_dir) if neutral_capture_dir else None,
    )
    update_figures(registration_dir, evaluation.figures)
    print_figures(evaluation.figures, title=f"{capture.subject} {capture.expression}: {registration.status}")
    return evaluation


def _ground(registration: Registration, capture: Capture) -> tuple[Scan, FaceBall, Bool[np.ndarray, "P"]]:
    """The scan, the face ball, and which scan points two cameras see."""
    if capture.scan is None:
        raise InputError(
            "The capture has no scan to compare with",
            where=capture.root,
            expected="scan.ply",
            got="no such file",
            fix="add the scan; registering itself needs none",
        )
    ball = face_ball(capture, registration)
    scan = read_scan(capture.scan)
    cameras = [view.camera for view in capture.views]
    if len(scan.triangles):
        return scan, ball, seen(scan.vertices, scan.vertices, scan.triangles, cameras)
    mesh = _surface(registration)
    return scan, ball, seen(scan.vertices, mesh.vertices, mesh.triangles, cameras, CLOUD_TOLERANCE)


def _surface(registration: Registration) -> Surface:
    return Surface(vertices=registration.vertices.astype(np.float64), triangles=registration.triangles)


def _truth_figures(
    registration: Registration,
    face_points: Float[np.ndarray, "P 3"],
    capture: Capture,
    neutral: Registration | None,
    neutral_capture: Capture | None,
) -> dict[str, Any]:
    """Vertex error where truth and registration share a topology, drift where the two truths do."""
    figures: dict[str, Any] = {}
    if capture.ground_truth is None:
        return figures
    truth = read_truth(capture.ground_truth).astype(np.float64)
    if truth.shape == registration.vertices.shape:
        figures["vertex_error"] = {"face": vertex_error(registration, truth, face_vertices(truth, face_points))}
    if neutral and neutral_capture and neutral_capture.ground_truth:
        start = read_truth(neutral_capture.ground_truth).astype(np.float64)
        if start.shape == truth.shape:
            scan, ball, seen_scan = _ground(neutral, neutral_capture)
            face = face_vertices(start, scan.vertices[seen_scan & ball.holds(scan.vertices)])
            figures["drift"] = {"face": drift(registration, truth, neutral, start, face)}
    return figures
