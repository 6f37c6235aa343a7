"""The single-view experiment of [GNM, Fitting Comparisons on Single-View Synthetic Data], with two models.

Every picture has 7,000 true landmarks of the face's surface, those that the head hides too, as in the paper. Its camera
is unknown to the fit, which has no anatomical term: these landmarks are on the skin alone. Landmarks of people of
another topology are placed on a model by `correspondence`.
"""

import itertools
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from jaxtyping import Float

from bench.landmark_fits.correspondence import matched_scheme
from bench.landmark_fits.heads import HeadModel
from bench.landmark_fits.people import People, turned
from bench.landmark_fits.pictures import SIZE_PX, Pinhole, look_at
from bench.landmark_fits.rows import Row
from registration.errors import InputError
from registration.geometry.closest_point import ClosestPointQuery
from registration.geometry.rigid import similarity_transform
from registration.geometry.surface_samples import sample_surface
from registration.landmark_fit.fit import fit_many
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions
from registration.landmark_fit.result import LandmarkFit
from registration.model.landmarks import LandmarkScheme

POINTS = 7000
SIGMA_PX = 1.0
# Where a model cannot reach, neighbouring landmarks err alike: as many independent ones as the paper's detector has.
CORRELATED = POINTS / 600
IN_MODEL_LIMIT_MM = 1.7
PAPER = {"GNM": (1.683, 1.589, 0.591), "FLAME": (2.172, 2.086, 0.458)}
ALIGNMENTS = ("rigid", "with scale", "camera frame")
_FACE_PX = 300.0  # height of a face of 0.2 m
_CHUNK = 125  # pictures of one task; each task prepares the model anew
_EVERY = 4  # of the landmarks, one in so many is measured
CROSSED = 300  # pictures at most of people that are not the model's own


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """One row of the table: people and the model that is fitted to their pictures."""

    people: People
    model: HeadModel
    in_model: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class _Prepared:
    """What the pictures of a case share."""

    case: Case
    faces: np.ndarray  # of the landmarks, in the people's triangles of the face
    barycentric: np.ndarray
    scheme: LandmarkScheme  # of the same landmarks on the model
    options: FitOptions

    def truth(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "P 3"]:
        corners = self.case.people.face[self.faces]
        return np.einsum("pk,pkc->pc", self.barycentric, vertices[corners])


def prepare(case: Case, options: FitOptions | None = None) -> tuple[_Prepared, float]:
    """Choose the landmarks, and place them on the model; how far they are from its deformed template, mm."""
    people, model = case.people, case.model
    faces, barycentric = sample_surface(people.template, people.face, POINTS, np.random.default_rng(0))
    corners = people.face[faces]
    distance = np.zeros(POINTS)
    if people.template.shape == model.template.shape:
        scheme = LandmarkScheme(name="own", indices=corners, weights=barycentric)
    else:
        points = np.einsum("pk,pkc->pc", barycentric, people.template[corners])
        landmarks = {name: p for name, p in people.landmarks.items() if name in model.schemes}
        scheme, distance = matched_scheme(model, people.template, people.skin, landmarks, points)
    options = options or FitOptions(
        expression_sigma=model.expression_sigma, correlated=CORRELATED, covariance=False, anatomy=0
    )
    prepared = _Prepared(case=case, faces=faces, barycentric=barycentric, scheme=scheme, options=options)
    return prepared, 1e3 * float(distance.mean())


def _pictures(prepared: _Prepared, seed: int, count: int) -> Iterator[tuple[np.ndarray, np.ndarray, Pinhole]]:
    """True landmarks (metres), the same in pixels, and the camera."""
    people = prepared.case.people
    pivot = people.template[people.face].mean((0, 1))
    rng = np.random.default_rng([13, seed])
    for vertices in itertools.islice(people.heads(seed), count):
        points = prepared.truth(turned(vertices, pivot, rng))
        focal = 1.2 * SIZE_PX * float(np.exp(0.15 * rng.normal()))
        distance = focal * 0.2 / (_FACE_PX * rng.uniform(0.7, 1.2))
        target = pivot + rng.normal(size=3) * 0.02
        camera = Pinhole(focal_px=focal, T_cam_world=look_at(target, rng.normal() * 0.1, rng.normal() * 0.1, distance))
        yield points, camera.project(points), camera


def _fits(prepared: _Prepared, batch: list[Observations]) -> Iterator[tuple[LandmarkFit | None, float]]:
    """Fits, None where the landmarks were refused, and the processor time they took, seconds."""
    while batch:
        done, began = 0, time.process_time()
        try:
            for fit in fit_many(batch, prepared.case.model.data, prepared.options):
                done += 1
                yield fit, time.process_time() - began
                began = time.process_time()
        except InputError:
            done += 1
            yield None, time.process_time() - began
        batch = batch[done:]


def _measured(prepared: _Prepared, seed: int, count: int) -> np.ndarray:
    """Mean distances (mm) by alignment, focal error (relative), seconds of the fit, of these on the processor, 1 if it
    converged; per picture. NaN where the landmarks were refused."""
    pictures = list(_pictures(prepared, seed, count))
    batch = [
        Observations.of_image(prepared.scheme, pixels, (SIZE_PX, SIZE_PX), sigma_px=SIGMA_PX)
        for _, pixels, _ in pictures
    ]
    model = prepared.case.model
    result = []
    for (points, _, camera), (fit, cpu) in zip(pictures, _fits(prepared, batch), strict=True):
        if fit is None:
            result.append([np.nan] * (len(ALIGNMENTS) + 4))
            continue
        mesh = model.posed(fit.parameters(0))
        fitted = prepared.scheme.points(mesh)
        T = camera.T_cam_world
        moves = {
            "camera frame": (1.0, T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]),  # the fit's world is the camera
            "rigid": similarity_transform(fitted, points, free_scale=False),
            "with scale": similarity_transform(fitted, points, free_scale=True),
        }
        query = ClosestPointQuery(mesh, model.outer_triangles)
        row = []
        for name in ALIGNMENTS:
            s, R, t = moves[name]
            distance = s * query.closest((points[::_EVERY] - t) @ R / s)[0]  # in the fit's frame: one tree for all
            row.append(1e3 * distance.mean())
        focal = abs(fit.cameras[0].intrinsics[0, 0] / camera.focal_px - 1)
        result.append([*row, focal, fit.seconds, cpu, float(fit.status == "converged")])
    return np.array(result)


_shared: _Prepared | None = None  # of the case in progress, inherited by the processes


def _task(task: tuple[int, int]) -> np.ndarray:
    assert _shared is not None
    return _measured(_shared, *task)


def measure(prepared: _Prepared, count: int, processes: int) -> tuple[np.ndarray, float]:
    """Fit the pictures; their figures, and the seconds it took."""
    global _shared
    _shared = prepared
    tasks = [(k, min(_CHUNK, count - k * _CHUNK)) for k in range((count + _CHUNK - 1) // _CHUNK)]
    began, parts = time.perf_counter(), []
    with ProcessPoolExecutor(processes, mp_context=get_context("fork")) as pool:  # the models are not copied
        for part in pool.map(_task, tasks):
            parts.append(part)
            so_far = np.concatenate(parts)
            means = ", ".join(f"{value:.3f}" for value in np.nanmean(so_far[:, : len(ALIGNMENTS)], 0))
            seconds, cpu = time.perf_counter() - began, np.nanmean(so_far[:, 5])
            print(f"  {len(so_far)} of {count}: {means} mm; {seconds:.0f} s; {cpu:.2f} s a fit", file=sys.stderr)
    return np.concatenate(parts), time.perf_counter() - began


def single(cases: list[Case], count: int, processes: int) -> tuple[list[Row], list[str]]:
    """The table: mean, median and standard deviation over the pictures of each picture's mean distance."""
    rows, notes = [], []
    for case in cases:
        prepared, off = prepare(case)
        pictures = count if case.in_model else min(count, CROSSED)
        found, seconds = measure(prepared, pictures, processes)
        refused = int(np.isnan(found[:, 0]).sum())
        found = found[np.isfinite(found[:, 0])]
        for k, name in enumerate(ALIGNMENTS):
            values = found[:, k]
            limited = case.in_model and name == "rigid"
            rows.append(
                Row(
                    what=f"{case.people.name}, {case.model.name} fitted, {name}",
                    measured=f"{values.mean():.3f} / {np.median(values):.3f} / {values.std():.3f} mm",
                    limit=f"mean <= {IN_MODEL_LIMIT_MM} mm" if limited else "",
                    ok=bool(values.mean() <= IN_MODEL_LIMIT_MM) if limited else None,
                )
            )
        note = (
            f"{case.people.name}, {case.model.name}: {pictures} pictures in {seconds / 60:.1f} min on {processes} cores"
        )
        note += f", {found[:, 4].mean():.2f} s a fit, {found[:, 5].mean():.2f} s of processor time"
        note += f", {100 * found[:, 6].mean():.0f} % converged, {refused} refused"
        note += f", focal length off by {100 * np.median(found[:, 3]):.1f} % in the median"
        notes.append(note + (f", landmarks {off:.2f} mm from the deformed template" if off else ""))
        figures = "; ".join(row.measured for row in rows[-len(ALIGNMENTS) :])
        print(f"{notes[-1]}: {figures}", flush=True)  # the table follows after an hour
    for name, figures in PAPER.items():
        notes.append(f"the paper's {name}: {' / '.join(map(str, figures))} mm (alignment not stated)")
    return rows, notes
