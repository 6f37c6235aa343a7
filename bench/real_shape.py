"""Measure on real captures, leave-one-out, whether a model rebuilt from few subjects generalizes better.

    python -m bench.real_shape CAPTURE... --model MODEL.npz --out OUT [--shrinkage 0.5] [--no-by-area] [--no-mirrored]

Every neutral CAPTURE, with a scan, is registered with the `draft` recipe from MODEL into OUT/registrations; existing
registrations are reused. Each subject in turn is held out: the next model is built from the other subjects' usable
registrations and MODEL, with the settings of `gnmreg coregister` unless options say otherwise, and both models are
fitted to the held-out subject with the same numbers of components, by two measures:

scan      distance of the scan's points of the face (as `gnmreg evaluate` selects them) from the model's surface, with
          all coefficients and the rigid motion free (`coregister.evaluate.scan_fit`): independent of the subject's
          registration
vertices  distance of the registration's observed vertices on the head's skin. That registration was made with MODEL:
          where it had few observations it resembles MODEL, and its vertices slide as MODEL's do, so that this measure
          is biased towards MODEL

Tables of mm and of the ratio next / MODEL by subject; the last rows are the scan's, with `--headline` components.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from coregister.evaluate.linear_fit import LinearFit, fit_correspondence, identity_part
from coregister.evaluate.scan_fit import fit_scan, points_on_skin
from coregister.next_model.build import build_model
from coregister.next_model.identity import IdentitySettings
from coregister.next_model.recipes import few_registrations
from coregister.next_model.training_data import TrainingMesh, TrainingSubject, unpose
from registration.capture.native import read_capture
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.evaluate.evaluation import CLOUD_TOLERANCE
from registration.evaluate.face import face_sphere, visible_in_two_views
from registration.model import gnm_npz, regions
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.pipeline import register
from registration.progress import console_progress
from registration.types import Capture, Registration

_MIN_CONFIDENCE = 0.1  # of observed vertices
USABLE = ("converged", "stopped")
MEASURES = ("scan", "vertices")


def register_all(captures: Sequence[Path], model: Path, out: Path) -> list[tuple[Capture, Registration]]:
    """Register each capture into a folder with the subject's name."""
    pairs = []
    with console_progress() as progress:
        for number, path in enumerate(captures):
            capture = read_capture(path)
            progress.update(number, len(captures), capture.subject)
            registration = register(path, model, out / "registrations" / capture.subject, progress=progress)
            pairs.append((capture, registration))
    return pairs


def training_subject(capture: Capture, registration: Registration, model: GNM) -> TrainingSubject:
    """Return the unposed neutral for model building."""
    mesh = TrainingMesh(
        name=capture.subject,
        label="neutral",
        vertices=unpose(registration, model),
        confidence=registration.confidence,
        triangles=registration.triangles,
    )
    return TrainingSubject(name=capture.subject, neutral=mesh)


def face_points(capture: Capture, registration: Registration) -> Float[np.ndarray, "P 3"]:
    """Return the scan's points on the face that two cameras see; metres, capture world."""
    assert capture.scan is not None
    scan = read_scan(capture.scan)
    surface = scan if len(scan.triangles) else registration
    tolerance = () if len(scan.triangles) else (CLOUD_TOLERANCE,)
    cameras = [view.camera for view in capture.views]
    inside = face_sphere(capture, registration).contains(scan.vertices)
    occluder = surface.vertices.astype(np.float64), surface.triangles
    inside &= visible_in_two_views(scan.vertices, *occluder, cameras, *tolerance)
    return scan.vertices[inside].astype(np.float64)


def errors_mm(
    data: GNMData, registration: Registration, points: Float[np.ndarray, "P 3"], counts: Sequence[int]
) -> Float[np.ndarray, "2 k"]:
    """Return the model's mean distances from the scan's points and from the registration's vertices."""
    observed = regions.head_skin(data) & (registration.confidence >= _MIN_CONFIDENCE)
    part = identity_part(data, observed)
    vertex_fits = fit_correspondence(part, registration.vertices[part.rows], counts)
    points = points_on_skin(points, registration.vertices, data)
    scan_fits = fit_scan(identity_part(data, regions.exterior(data)), points, vertex_fits)
    return np.array([_means(scan_fits), _means(vertex_fits)])


def _means(fits: Sequence[LinearFit]) -> list[float]:
    return [float(fit.distance_mm.mean()) for fit in fits]


def leave_one_out(
    pairs: Sequence[tuple[Capture, Registration]], previous: GNMData, settings: IdentitySettings, counts: Sequence[int]
) -> Float[np.ndarray, "N 2 2 k"]:
    """Return mean distances in mm: subject, model (previous, next), measure, number of components."""
    model = GNM(previous)
    subjects = [training_subject(capture, registration, model) for capture, registration in pairs]
    errors = []
    with console_progress() as progress:
        for number, (capture, registration) in enumerate(pairs):
            progress.update(number, len(pairs), f"without {capture.subject}")
            points = face_points(capture, registration)
            others = [
                subject
                for index, (subject, (_, other)) in enumerate(zip(subjects, pairs, strict=True))
                if index != number and other.status in USABLE
            ]
            rebuilt = build_model(others, previous, replace(few_registrations(), identity=settings)).data
            errors.append([errors_mm(data, registration, points, counts) for data in (previous, rebuilt)])
    return np.array(errors)


def print_tables(names: Sequence[str], errors: Float[np.ndarray, "N 2 2 k"], counts: Sequence[int]) -> None:
    """Print a table and the statistics of the ratio for each measure."""
    for index, measure in enumerate(MEASURES):
        table = Table("subject", *(f"{k}" for k in counts), title=f"{measure}: previous, next, mm, by components")
        for name, rows in zip(names, errors[:, :, index], strict=True):
            table.add_row(name, *(f"{previous_mm:.3f} {next_mm:.3f}" for previous_mm, next_mm in rows.T))
        Console(width=100).print(table)
        ratios = errors[:, 1, index] / errors[:, 0, index]
        for k, ratio in zip(counts, ratios.T, strict=True):
            low, median, high = np.quantile(ratio, (0, 0.5, 1))
            better = (ratio < 1).sum()
            print(f"{measure} components {k} better {better} median {median:.3f} from {low:.3f} to {high:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--components", type=int, nargs="*", default=[5, 10, 20, 40])
    parser.add_argument("--headline", type=int, default=20)
    parser.add_argument("--shrinkage", default="chosen", help="the share of MODEL (default: chosen)")
    for name in ("by-area", "mirrored"):
        default = getattr(few_registrations().identity, name.replace("-", "_"))
        parser.add_argument(f"--{name}", action=argparse.BooleanOptionalAction, default=default)
    options = parser.parse_args()
    pairs = register_all(options.captures, options.model, options.out)
    if missing := [capture.subject for capture, _ in pairs if capture.scan is None]:
        raise InputError(
            "Captures have no scan", where=", ".join(missing), expected="a scan", got="none", fix="exclude them"
        )
    for capture, registration in pairs:
        if registration.status not in USABLE:
            print(f"{capture.subject} is in no model: {registration.reason}")
    counts = sorted({*options.components, options.headline})
    settings = IdentitySettings(
        variance_ratio=1.0,
        max_components=counts[-1],  # as many as MODEL is evaluated with
        shrinkage=None if options.shrinkage == "chosen" else float(options.shrinkage),
        by_area=options.by_area,
        mirrored=options.mirrored,
    )
    errors = leave_one_out(pairs, gnm_npz.read(options.model), settings, counts)
    print_tables([capture.subject for capture, _ in pairs], errors, counts)
    ratio = (errors[:, 1, 0] / errors[:, 0, 0])[:, counts.index(options.headline)]
    print(f"{settings}")
    print(f"better {(ratio < 1).sum()} of {len(ratio)}")
    print(f"median_ratio {np.median(ratio):.3f}")


if __name__ == "__main__":
    main()
