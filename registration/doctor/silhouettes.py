"""The body that the masks of all views allow, their visual hull, and how well the views agree on its surface.

With the right cameras the hull covers the masks, and a point of its surface has about one colour, one label and one
normal in all views that see it. With other poses, or with K of another size, the cones through the masks miss one
another. A head is so round that silhouettes alone do not tell a turned rig from the right one: colours do.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_erosion

from registration.capture.samples import ViewSample
from registration.doctor.rig_checks import MaskBox, meeting, undistorted_box
from registration.types import Camera, Capture

_MAX_VIEWS = 16
_MIN_VIEWS = 3  # two cones always meet if their cameras see the same heights
_CELLS = 64  # per side of the coarse masks
_VOXELS = 56  # per side of the cube around the subject
_ROOM = 1.3  # of the cube, times the largest mask
_MISSED = 6  # one of this many views may contradict a point of the hull


@dataclass(frozen=True, kw_only=True)
class Silhouettes:
    """Some views' masks, by their numbers in the capture."""

    numbers: tuple[int, ...]
    masks: Bool[np.ndarray, "N G G"]  # without distortion
    ends: Float[np.ndarray, "N 2 2"]  # corners of their boxes, px

    @classmethod
    def of(
        cls, capture: Capture, samples: Sequence[ViewSample], boxes: Mapping[str, MaskBox | None]
    ) -> "Silhouettes | None":
        """The witness of a capture; None if too few views show the subject in front of something."""
        usable = [
            number
            for number, sample in enumerate(samples)
            if boxes.get(sample.name) is not None and 0 < sample.subject.mean() < 0.98
        ]
        if len(usable) < _MIN_VIEWS:
            return None
        chosen = [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, _MAX_VIEWS).astype(int))]
        found = [(samples[k], capture.views[k].camera) for k in chosen]
        ends = [undistorted_box(camera, box) for s, camera in found if (box := boxes[s.name]) is not None]
        return cls(
            numbers=tuple(chosen),
            masks=np.stack([_coarse(sample, camera) for sample, camera in found]),
            ends=np.stack(ends),
        )

    def hull(self, cameras: Sequence[Camera]) -> "Hull | None":
        """The hull of all masks; None if their rays do not meet."""
        used = [cameras[number] for number in self.numbers]
        met = meeting(used, self.ends)
        if met.hits < math.ceil(len(used) / 2) or not np.isfinite(met.point).all():
            return None
        sides = [
            float((box[1] - box[0]).max()) / camera.intrinsics[0, 0] * depth
            for camera, box, depth in zip(used, self.ends, met.depths, strict=True)
            if depth > 0
        ]
        side = _ROOM * float(np.median(sides))
        steps = (np.arange(_VOXELS) + 0.5) / _VOXELS - 0.5
        grid = met.point + side * np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
        votes, seen = np.zeros(len(grid), np.int64), np.zeros(len(grid), np.int64)
        cells = []
        for camera, mask in zip(used, self.masks, strict=True):
            cell, front = _cells(camera, grid)
            inside = (cell >= 0).all(1) & (cell < _CELLS).all(1)
            column, row = np.clip(cell, 0, _CELLS - 1).T
            votes += front & mask[row, column]  # what an image cuts off goes on as it is at the border
            seen += front & inside
            cells.append((column, row, inside & front))
        full = (votes >= len(used) - len(used) // _MISSED) & (2 * seen >= len(used))
        shares = []
        for mask, (column, row, inside) in zip(self.masks, cells, strict=True):
            covered = np.zeros((_CELLS, _CELLS), np.uint8)
            shown = full & inside
            covered[row[shown], column[shown]] = 1
            near = cv2.dilate(covered, np.ones((3, 3), np.uint8)).astype(bool)
            shares.append(float((near & mask).sum() / max(mask.sum(), 1)))
        cube = full.reshape(_VOXELS, _VOXELS, _VOXELS)
        rim = cube & ~binary_erosion(cube)
        return Hull(coverage=float(np.mean(shares)), surface=grid[rim.ravel()], voxel=side / _VOXELS)


@dataclass(frozen=True, kw_only=True)
class Hull:
    """The body that all masks allow."""

    coverage: float  # mean share of the masks that it covers
    surface: Float[np.ndarray, "P 3"]  # m, world
    voxel: float  # m


def _cells(camera: Camera, points: Float[np.ndarray, "P 3"]) -> tuple[np.ndarray, Bool[np.ndarray, "P"]]:
    """Coarse columns and rows of points, clipped far outside, and whether they are in front."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy, depth = camera.project(points)
    cell = np.nan_to_num(_CELLS * xy / [camera.width_px, camera.height_px], nan=-1).clip(-1e6, 1e6)
    return np.floor(cell).astype(np.int64), depth > 0


def _coarse(sample: ViewSample, camera: Camera) -> Bool[np.ndarray, "G G"]:
    """The mask in coarse cells of the image without distortion."""
    rays = sample.rays[sample.subject]
    xy = (rays @ camera.intrinsics.T)[:, :2] / rays[:, 2:]
    column, row = np.floor(_CELLS * xy / [camera.width_px, camera.height_px]).astype(np.int64).T
    inside = (column >= 0) & (column < _CELLS) & (row >= 0) & (row < _CELLS)
    coarse = np.zeros((_CELLS, _CELLS), bool)
    coarse[row[inside], column[inside]] = True
    return coarse
