"""Where the head lies in a scan, and in which unit: from landmarks, or by trying units, orientations and places.

Without landmarks every orientation of the axes, with tilts between them, is tried at every place where the scan has
something that may be the tip of a nose: the foremost point of a slab. That does not depend on the scan's extent, so
that shoulders, hair or a missing back of the head do no harm.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.closest_point import ClosestPointQuery
from registration.geometry.rigid import similarity_transform
from registration.geometry.topology import boundary_vertices, vertex_normals
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.scan_capture.hygiene import RawScan
from registration.scan_capture.surface_fit import STIFF_M, ModelSample, Pairs, Placement, SurfacePoints, pair, refine

UNITS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
_SIZES_M = (0.1, 1.3)  # largest extent of a scan, from a face to a half-length figure
_MAX_SCALE = 0.25  # of the logarithm of a head's size against the model's: beyond, the unit is another
_COARSE_M, _FINE_M = 6e-3, 2e-3  # distance of the scan's points while searching, and at the end
_SLAB_M = 0.02
_STARTS = 160  # that are improved, of some thousand that are rated
_FINALISTS = 8
_NEAR_M = 2.5e-3  # of the model's span: a point of the face that lies on the scan
_LEAST_LIKENESS = 0.65  # of a scan with a face: balls and the backs of heads have up to 0.55
_SECOND_HEAD = 0.85  # of the best one's likeness, at another place
_ALIKE = 0.85  # cosine between the normals of a pair that is alike
_APART_M = 0.1
_LANDMARK_M = 0.015  # median distance of landmarks from the surface that they were picked on
MIN_LANDMARKS = 6


@dataclass(frozen=True, kw_only=True)
class Placed:
    """The model placed in a scan; metres, the scan's axes."""

    placement: Placement
    sample: ModelSample
    unit: str  # of the file
    inliers: float  # share of the face's points that lie on the scan
    median_m: float  # their distance from it
    inside_out: bool  # the scan's faces point inwards
    figures: dict[str, Any]
    notes: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class _Candidate:
    """A place where a face may be."""

    placement: Placement
    unit: str
    likeness: float


class Search:
    """A scan and a model, prepared for placing one in the other."""

    def __init__(self, scan: RawScan, data: GNMData, where: object):
        """Prepare the model's samples.

        Args:
            scan: cleaned, in the file's unit.
            data: the model.
            where: the scan's file, for messages.
        """
        self._scan, self._where = scan, where
        faces = torch.as_tensor(data.triangles.astype(np.int64))
        normals = vertex_normals(torch.as_tensor(data.template_vertex_positions.astype(np.float64)), faces).numpy()
        self._coarse = ModelSample.of(data, normals, 0.012, shape=False)
        self._fine = ModelSample.of(data, normals, 0.007, shape=True)
        own = torch.as_tensor(scan.triangles.astype(np.int64))
        centred = scan.vertices - scan.vertices.mean(0)
        size = float(np.ptp(centred, axis=0).max())
        self._normals = vertex_normals(torch.as_tensor(centred / size), own).numpy()
        self._border = boundary_vertices(scan.triangles, len(scan.vertices))
        self._size = size

    def from_landmarks(
        self, points: Float[np.ndarray, "L 3"], scheme: LandmarkScheme, data: GNMData, unit: str | None
    ) -> Placed:
        """Place the model by landmarks of the scan.

        Args:
            points: in the file's unit and axes; NaN where not given.
            scheme: of the model, the same points.
            data: the model.
            unit: of the file; None: by the landmarks' size.

        Raises:
            InputError: too few landmarks, or they are no head's, mirrored, in another unit, or not on the scan.
        """
        valid = np.isfinite(points).all(1)
        if valid.sum() < MIN_LANDMARKS:
            raise self._refuse(
                "Too few landmarks of the scan",
                f"at least {MIN_LANDMARKS} finite points",
                int(valid.sum()),
                "pick more, or register without --scan-landmarks",
            )
        distance = ClosestPointQuery(self._scan.vertices, self._scan.triangles).closest(points[valid])[0]
        template = scheme.points(data.template_vertex_positions.astype(np.float64))
        scale, rotation, shift = similarity_transform(template[valid], points[valid], free_scale=True)
        if self._mirrored(template[valid], points[valid]):
            raise self._refuse(
                "The landmarks and the scan are mirrored",
                "a right-handed scan with the subject's own right and left",
                "points that fit the model as a mirror image only",
                "export the scan without mirroring, or exchange right and left in the landmark file",
            )
        found = self._unit_of(scale, unit)
        if np.median(distance) * UNITS_M[found] > _LANDMARK_M:
            raise self._refuse(
                "The landmarks do not lie on the scan",
                f"points within {_LANDMARK_M * MM_PER_M:.0f} mm of its surface, in its unit and axes",
                f"{np.median(distance) * UNITS_M[found] * MM_PER_M:.0f} mm in the median",
                "pick them on this scan, or export both in one unit and one frame",
            )
        factor = UNITS_M[found]
        start = Placement(rotation=rotation, shift=shift * factor, scale=scale * factor)
        surface = self._surface(factor, _FINE_M)
        refined = refine(start, self._fine, surface, (0.02, 0.015, 0.01, 0.01, 0.007, 0.005, 0.005))
        return self._placed(refined, surface, found, f"{int(valid.sum())} landmarks", ())

    def without_landmarks(self, unit: str | None) -> Placed:
        """Place the model by its face alone.

        Args:
            unit: of the file; None: all units in which the scan may be a head's are tried.

        Raises:
            InputError: no face is found, or two.
        """
        units = (
            [unit] if unit else [name for name, f in UNITS_M.items() if _SIZES_M[0] <= f * self._size <= _SIZES_M[1]]
        )
        if not units:
            raise self._refuse(
                "The scan has no head's size in any unit",
                "a head, in mm, cm, m or inches",
                f"an extent of {self._size:.3g}",
                "export the head alone, or give --unit",
            )
        finalists = []
        for name in units:
            surface = self._surface(UNITS_M[name], _FINE_M)
            for start in self._starts(self._surface(UNITS_M[name], _COARSE_M)):
                stiff = refine(start, self._fine, surface, (0.02, 0.015, *[0.01] * 5), noise_m=STIFF_M)
                finalists.append(_Candidate(placement=stiff, unit=name, likeness=self._likeness(stiff, surface)))
        finalists.sort(key=lambda candidate: -candidate.likeness)
        best = finalists[0] if finalists else None
        if best is None or best.likeness < _LEAST_LIKENESS:
            share = "no orientation fits" if best is None else f"at best {best.likeness:.0%}"
            raise self._refuse(
                "No face is found in the scan",
                f"a surface that at least {_LEAST_LIKENESS:.0%} of the model's face is like",
                share,
                "if there is a face, give landmarks with --scan-landmarks, or its unit with --unit; pieces that do not "
                "fit each other must be aligned first",
            )
        least = max(_LEAST_LIKENESS, _SECOND_HEAD * best.likeness)
        for other in finalists[1:]:
            apart = float(np.linalg.norm(self._face_centre(other) - self._face_centre(best)))
            if other.unit == best.unit and apart > _APART_M and other.likeness > least:
                raise self._refuse(
                    "There are two heads in the scan",
                    "one",
                    f"two faces {apart * MM_PER_M:.0f} mm apart",
                    "cut one of them off, or give the landmarks of the one that is meant with --scan-landmarks",
                )
        rivals = (other for other in finalists if other.unit != best.unit or self._elsewhere(other, best))
        rival = max((other.likeness for other in rivals), default=0.0)
        surface = self._surface(UNITS_M[best.unit], _FINE_M)
        refined = refine(best.placement, self._fine, surface, (0.01, 0.008, 0.006, 0.005, 0.005))
        note = f"{best.likeness:.0%} of the face is like the model's, {rival:.0%} in the next best orientation or unit"
        placed = self._placed(refined, surface, best.unit, "the shape of the face", (note,))
        figures = {"likeness": round(best.likeness, 3), "sureness": round(1 - rival / best.likeness, 3)}
        return replace(placed, figures={**placed.figures, **figures})

    def _likeness(self, placement: Placement, surface: SurfacePoints) -> float:
        """The share of the face's points that lie on the scan and are turned as it is."""
        found = pair(placement, self._fine, surface, placement.points(self._fine))
        alike = self._near(found) & (np.abs(found.outward) > _ALIKE)
        size = float(np.exp(-((np.log(placement.scale) / (2 * _MAX_SCALE)) ** 2)))  # a head of an odd size is unlikely
        return float(alike[self._fine.face].mean()) * size

    def _elsewhere(self, a: "_Candidate", b: "_Candidate") -> bool:
        """Whether two candidates are different heads, or differently turned, not one that slid a little."""
        turn = Rotation.from_matrix(a.placement.rotation @ b.placement.rotation.T).magnitude()
        return bool(turn > np.radians(30) or np.linalg.norm(self._face_centre(a) - self._face_centre(b)) > _APART_M / 2)

    def _face_centre(self, candidate: "_Candidate") -> Float[np.ndarray, "3"]:
        return candidate.placement.points(self._fine)[self._fine.face].mean(0)

    def _surface(self, factor: float, cell_m: float) -> SurfacePoints:
        return SurfacePoints.of(self._scan.vertices * factor, self._normals, self._border, cell_m)

    def _starts(self, surface: SurfacePoints) -> list[Placement]:
        """The best placements of the template, rated by its face."""
        nose = self._coarse.template[self._coarse.template[:, 2].argmax()]
        starts = []
        for rotation in _orientations():
            local = surface.points @ rotation  # in the model's axes
            slab = np.floor(local[:, 1] / _SLAB_M).astype(np.int64)
            order = np.lexsort((-local[:, 2], slab))
            first = np.r_[True, np.diff(slab[order]) != 0]
            starts += [
                Placement(rotation=rotation, shift=surface.points[tip] - rotation @ nose) for tip in order[first]
            ]
        rated = sorted(starts, key=lambda start: self._cost(start, surface))[:_STARTS]
        reaches = (0.03, 0.025, 0.02, 0.02, 0.015, 0.015)
        improved = [refine(start, self._coarse, surface, reaches, free_scale=False) for start in rated]
        improved.sort(key=lambda start: self._cost(start, surface))
        chosen: list[Placement] = []
        for start in improved:
            if all(_far(start, other) for other in chosen):
                chosen.append(start)
            if len(chosen) == _FINALISTS:
                break
        return chosen

    def _cost(self, placement: Placement, surface: SurfacePoints, reach: float = 0.012) -> float:
        found = pair(placement, self._coarse, surface, placement.points(self._coarse))
        near = np.minimum((found.distance / reach) ** 2, 1)
        return float(np.where(found.valid, near, 1.0).mean())

    def _placed(
        self, placement: Placement, surface: SurfacePoints, unit: str, by: str, notes: tuple[str, ...]
    ) -> Placed:
        found = pair(placement, self._fine, surface, placement.points(self._fine))
        near = self._near(found)
        face = self._fine.face
        inliers = float(near[face].mean())
        median = float(np.median(np.abs(found.residual[face & near]))) if (face & near).any() else np.inf
        inside_out = bool((found.outward[face & near] < 0).mean() > 0.5) if (face & near).any() else False
        figures = {
            "unit": unit,
            "placed_by": by,
            "face_on_scan": round(inliers, 3),
            "median_mm": round(median * MM_PER_M, 3),
            "size_of_model": round(placement.scale, 4),
        }
        return Placed(
            placement=placement,
            sample=self._fine,
            unit=unit,
            inliers=inliers,
            median_m=median,
            inside_out=inside_out,
            figures=figures,
            notes=notes,
        )

    def _near(self, found: Pairs) -> Bool[np.ndarray, "S"]:
        return found.valid & (np.abs(found.residual) < _NEAR_M) & (found.distance < 3 * _NEAR_M)

    def _unit_of(self, scale: float, unit: str | None) -> str:
        """The unit in which landmarks have a head's size."""
        logs = {name: abs(np.log(scale * factor)) for name, factor in UNITS_M.items()}
        best = min(logs, key=lambda name: logs[name])
        if logs[unit or best] > _MAX_SCALE:
            got = f"a head of {scale * UNITS_M[unit or best]:.2g} times the model's size in {unit or best}"
            fix = f"give --unit {best}" if logs[best] <= _MAX_SCALE else "check the landmarks' order and scheme"
            raise self._refuse("The landmarks have no head's size", "a head in mm, cm, m or inches", got, fix)
        return unit or best

    @staticmethod
    def _mirrored(model: Float[np.ndarray, "L 3"], points: Float[np.ndarray, "L 3"]) -> bool:
        """Whether a reflection fits clearly better than a rotation."""

        def error(source: np.ndarray) -> float:
            scale, rotation, shift = similarity_transform(source, points, free_scale=True)
            return float(np.median(np.linalg.norm(scale * source @ rotation.T + shift - points, axis=1))) / scale

        plain, mirrored = error(model), error(model * [-1, 1, 1])
        return mirrored < 0.5 * plain and plain > 5e-3

    def _refuse(self, what: str, expected: object, got: object, fix: str) -> InputError:
        return InputError(what, where=self._where, expected=expected, got=got, fix=fix)


def _orientations() -> list[Float[np.ndarray, "3 3"]]:
    """Scan from model: the 24 turns of the axes, each also tilted by 25 degrees in four directions."""
    tilts = [np.eye(3)] + [
        Rotation.from_euler(axis, a, degrees=True).as_matrix() for axis, a in product("xy", (-25, 25))
    ]
    turns = Rotation.create_group("O").as_matrix()
    return [turn @ tilt for turn in turns for tilt in tilts]


def _far(a: Placement, b: Placement) -> bool:
    turn = Rotation.from_matrix(a.rotation @ b.rotation.T).magnitude()
    return bool(turn > np.radians(20) or np.linalg.norm(a.shift - b.shift) > 0.03)
