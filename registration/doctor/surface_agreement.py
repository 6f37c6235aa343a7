"""Whether views agree on colours, labels and normals of a surface: they do only with the right cameras."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from registration.capture.samples import ViewSample
from registration.doctor.silhouettes import Silhouettes
from registration.types import Camera

_CELLS = 24  # per side of the coarse images in which the nearest points are visible
_DEPTH = 1.5  # voxels behind the nearest point that are still visible
_MIN_POINTS = 100  # seen by two views
_CLASSES = 32


@dataclass(frozen=True, kw_only=True)
class BodyWitness:
    """The agreement of views on the hull of their masks: colours, labels and normals on it, times its coverage."""

    silhouettes: Silhouettes
    samples: Sequence[ViewSample]  # of all views
    sure: float = 0.2
    better: float = 0.12

    def __call__(self, cameras: Sequence[Camera]) -> float:
        """0 to 1; with the right cameras and colours only 0.3 to 0.6, with others below 0.15."""
        hull = self.silhouettes.hull(cameras)
        if hull is None or not len(hull.surface):
            return 0.0
        chosen = self.silhouettes.numbers
        samples, used = [self.samples[k] for k in chosen], [cameras[k] for k in chosen]
        agreement = surface_agreement(hull.surface, samples, used, _DEPTH * hull.voxel)
        return hull.coverage**2 * agreement


@dataclass(frozen=True, kw_only=True)
class ScanWitness:
    """The agreement of views on the surface of the scan, times the share of it that they see."""

    points: Float[np.ndarray, "P 3"]  # m, world
    samples: Sequence[ViewSample]  # of all views
    sure: float = 0.2
    better: float = 0.12

    def __call__(self, cameras: Sequence[Camera]) -> float:
        """0 to 1."""
        seen = []
        for camera in cameras:
            with np.errstate(divide="ignore", invalid="ignore"):
                xy, depth = camera.project(self.points)
            inside = (depth > 0) & (xy > 0).all(1) & (xy < [camera.width_px, camera.height_px]).all(1)
            seen.append(float(inside.mean()))
        depth_m = 0.03 * float(np.ptp(self.points, axis=0).max())
        return float(np.median(seen)) ** 2 * surface_agreement(self.points, self.samples, cameras, depth_m)


def surface_agreement(
    points: Float[np.ndarray, "P 3"], samples: Sequence[ViewSample], cameras: Sequence[Camera], depth_m: float
) -> float:
    """The share of what varies over a surface on which the views agree, in the mean over colours, labels and normals.

    Args:
        points: on the surface, m, world.
        samples: of the views.
        cameras: of the views.
        depth_m: behind the nearest point in its neighbourhood a point is hidden.

    Returns:
        1: complete agreement; 0: as for points drawn at random.
    """
    seen, at = [], []
    for sample, camera in zip(samples, cameras, strict=True):
        visible, xy = _visible(points, camera, depth_m)
        row, column = sample.at(xy)
        seen.append(visible & sample.subject[row, column])
        at.append((row, column))
    weights = np.stack(seen).astype(np.float32)[..., None]
    shared = weights.sum(0)[:, 0] > 1
    if shared.sum() < _MIN_POINTS:
        return 0.0
    found = [
        _explained(np.stack(values)[:, shared], weights[:, shared])
        for values in _values(samples, cameras, at)
        if values is not None
    ]
    return max(0.0, float(np.mean(found))) if found else 0.0


def _visible(
    points: Float[np.ndarray, "P 3"], camera: Camera, depth_m: float
) -> tuple[Bool[np.ndarray, "P"], Float[np.ndarray, "P 2"]]:
    with np.errstate(divide="ignore", invalid="ignore"):
        xy, depth = camera.project(points)
        cell = np.nan_to_num(_CELLS * xy / [camera.width_px, camera.height_px], nan=-1).clip(-1, _CELLS)
    column, row = np.floor(cell).astype(np.int64).T
    inside = (depth > 0) & (column >= 0) & (column < _CELLS) & (row >= 0) & (row < _CELLS)
    nearest = np.full((_CELLS, _CELLS), np.inf)
    np.minimum.at(nearest, (row[inside], column[inside]), depth[inside])
    visible = inside.copy()
    visible[inside] = depth[inside] < nearest[row[inside], column[inside]] + depth_m
    return visible, xy


def _values(
    samples: Sequence[ViewSample], cameras: Sequence[Camera], at: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Iterator[list[np.ndarray] | None]:
    """Of each channel that all views have: its values at the points, a list over the views."""
    if all(sample.grey is not None for sample in samples):
        yield [
            sample.grey[place][:, None] for sample, place in zip(samples, at, strict=True) if sample.grey is not None
        ]
    if all(sample.labels is not None for sample in samples):
        names = np.eye(_CLASSES, dtype=np.float32)
        yield [
            names[sample.labels[place] % _CLASSES]
            for sample, place in zip(samples, at, strict=True)
            if sample.labels is not None
        ]
    if all(sample.normals is not None for sample in samples):
        yield [
            sample.normals[place] @ camera.T_cam_world[:3, :3]
            for sample, camera, place in zip(samples, cameras, at, strict=True)
            if sample.normals is not None
        ]


def _explained(values: Float[np.ndarray, "N P D"], weights: Float[np.ndarray, "N P 1"]) -> float:
    """1 minus the variance within points, over that of all observations."""
    count = weights.sum(0)
    mean = (values * weights).sum(0) / count
    within = (((values - mean) ** 2) * weights).sum() / (count - 1).sum()
    overall = (values * weights).sum((0, 1)) / weights.sum()
    total = (((values - overall) ** 2) * weights).sum() / weights.sum()
    return 1 - float(within / max(total, 1e-9))
