"""Compare what a changed capture gives the fit with what its source gives."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from registration.capture.native import read_capture
from registration.capture.pixels import read_view
from registration.capture.scan import read_scan
from registration.capture.triangulation import MIN_CONFIDENCE
from registration.errors import InputError
from registration.evaluate.evaluation import evaluate_registration
from registration.types import Capture, Registration, ViewPixels

_DOWNSAMPLE = 8
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_MAX_IMAGE, _MAX_COVERAGE, _MAX_ANGLE_DEG, _MAX_LANDMARK_PX, _MAX_SCAN_MM = 0.02, 0.01, 2.0, 0.01, 0.002


def moved_by(source: Capture, target: Capture) -> np.ndarray:
    """Return how far the cameras' mean position moved, metres."""
    means = [np.mean([view.camera.centre for view in capture.views], 0) for capture in (source, target)]
    return np.asarray(means[1] - means[0])


def differences(source: Path, target: Path, registration: Registration | None) -> list[str]:
    """Return what differs between two captures of one moment, as the fit and the evaluation use them.

    Args:
        source: the capture folder.
        target: the changed one; its views are in the same order, names may differ.
        registration: of the source, to compare the figures of both scans; None: they are not compared.
    """
    first, second = read_capture(source), read_capture(target)
    if len(first.views) != len(second.views):
        return [f"{len(second.views)} of {len(first.views)} views"]
    seen: list[str] = []
    for a, b in zip(first.views, second.views, strict=True):
        pixels = (read_view(a, first, downsample=_DOWNSAMPLE), read_view(b, second, downsample=_DOWNSAMPLE))
        seen += [f"{b.name}: {text}" for text in _pixel_differences(*pixels)]
        for scheme, points in a.landmarks.items():
            other = b.landmarks.get(scheme)
            if other is None:
                seen.append(f"{b.name}: no landmarks")
                continue
            both = (points[:, 2] > MIN_CONFIDENCE) & (other[:, 2] > MIN_CONFIDENCE)
            lost = int((points[:, 2] > MIN_CONFIDENCE).sum() - both.sum())
            apart = np.abs(points[both, :2] - other[both, :2]).max(initial=0.0)
            seen += [f"{b.name}: {lost} landmarks less"] if lost else []
            seen += [f"{b.name}: landmarks {apart:.1f} px apart"] if apart > _MAX_LANDMARK_PX else []
    return seen + ([] if registration is None else _scan_difference(first, second, registration))


def _pixel_differences(a: ViewPixels, b: ViewPixels) -> list[str]:
    seen = []
    if a.rgb.shape != b.rgb.shape:
        return [f"{b.rgb.shape} pixels, not {a.rgb.shape}"]
    if (apart := float(np.abs((a.rgb - b.rgb) @ _LUMINANCE).mean())) > _MAX_IMAGE:
        seen.append(f"image differs by {apart:.3f}")
    for name, x, y in (("mask", a.mask, b.mask), ("labels", a.label_coverage, b.label_coverage)):
        if (x is None) != (y is None):
            seen.append(f"no {name}" if y is None else f"{name} added")
        elif x is not None and y is not None:
            apart = float(np.abs(x - y).mean()) if x.shape == y.shape else 1.0
            seen += [f"{name} differ by {apart:.3f}"] if apart > _MAX_COVERAGE else []
    if (a.normals is None) != (b.normals is None):
        seen.append("no normals" if b.normals is None else "normals added")
    elif a.normals is not None and b.normals is not None:
        both = (np.abs(a.normals).sum(-1) > 0) & (np.abs(b.normals).sum(-1) > 0)
        cosine = np.clip((a.normals * b.normals).sum(-1)[both], -1, 1)
        angle = float(np.degrees(np.arccos(cosine)).mean()) if both.any() else 180.0
        seen += [f"normals differ by {angle:.0f} degrees"] if angle > _MAX_ANGLE_DEG else []
    return seen


def _scan_difference(first: Capture, second: Capture, registration: Registration) -> list[str]:
    if first.scan is None or second.scan is None:
        return [] if first.scan is None else ["no scan"]
    scans = read_scan(first.scan), read_scan(second.scan)
    if bool(len(scans[0].triangles)) != bool(len(scans[1].triangles)):  # visibility, and so the figure, is another
        apart_mm = 1000 * float(cKDTree(scans[0].vertices).query(scans[1].vertices)[0].max())
        return [f"scan's points up to {apart_mm:.3f} mm apart"] if apart_mm > _MAX_SCAN_MM else []
    shift = moved_by(first, second)
    moved = replace(
        registration,
        vertices=registration.vertices + shift,
        landmarks={scheme: points + shift for scheme, points in registration.landmarks.items()},
    )
    figures = []
    for capture, mesh in ((first, registration), (second, moved)):
        try:
            metrics = evaluate_registration(mesh, capture).metrics
        except InputError as error:
            return [error.line]
        figures.append(metrics["scan_to_mesh"]["face"]["mean_mm"])
    apart = abs(figures[1] - figures[0])
    return [f"scan {figures[1]:.3f} mm, was {figures[0]:.3f}"] if not apart <= _MAX_SCAN_MM else []
