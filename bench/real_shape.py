"""Does a model that is rebuilt from a few real shapes come nearer to the next one? Leave-one-out over captures.

    python -m bench.real_shape CAPTURE... --model MODEL.npz --out OUT [--previous chosen] [--by-area] [--no-mirrored]

Every neutral CAPTURE, with a scan, is registered with the `draft` recipe from MODEL into OUT/registrations; what is
there already is not registered again. Then each subject in turn is left out: the next model is built from the others,
as far as their registrations did not fail, and MODEL, and both models are fitted to the one left out with the same
numbers of components, in two ways:

scan      the scan's points of the face (as `gnmreg evaluate` takes them) from the model's surface, all coefficients and
          the rigid motion free (`coregister.evaluate.scan_fit`): owes nothing to the registration of the one left out
vertices  the vertices of its registration that cameras saw, on the head's skin. That registration was made with MODEL,
          so where it saw little it looks like MODEL, in whose favour this figure is biased; and it slides as MODEL does

Tables of mm and of the ratio next / MODEL by subject; the last lines are the scan's, at `--headline` components.
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
from coregister.evaluate.scan_fit import fit_scan
from coregister.next_model.build import build_model
from coregister.next_model.identity import IdentitySettings
from coregister.next_model.recipes import true_meshes
from coregister.next_model.training_data import TrainingMesh, TrainingSubject, unpose
from registration.capture.native import read_capture
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.evaluate.evaluation import CLOUD_TOLERANCE
from registration.evaluate.face import face_ball, seen
from registration.model import gnm_npz, regions
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.pipeline import register
from registration.progress import shown
from registration.types import Capture, Registration

_SURE = 0.1  # confidence from which on a vertex was seen
USABLE = ("converged", "stopped")


def registered(captures: Sequence[Path], model: Path, out: Path) -> list[tuple[Capture, Registration]]:
    """Each capture and its registration in a folder of the subject's name."""
    found = []
    with shown() as progress:
        for number, path in enumerate(captures):
            capture = read_capture(path)
            progress.at(number, len(captures), capture.subject)
            one = register(path, model, out / "registrations" / capture.subject, progress=progress)
            found.append((capture, one))
    return found


def subject_of(capture: Capture, registration: Registration, model: GNM) -> TrainingSubject:
    mesh = TrainingMesh(
        name=capture.subject,
        label="neutral",
        vertices=unpose(registration, model),
        confidence=registration.confidence,
        triangles=registration.triangles,
    )
    return TrainingSubject(name=capture.subject, neutral=mesh)


def face_points(capture: Capture, registration: Registration) -> Float[np.ndarray, "P 3"]:
    """The scan's points on the face that two cameras see; metres, capture world."""
    assert capture.scan is not None
    scan = read_scan(capture.scan)
    surface = scan if len(scan.triangles) else registration
    slack = () if len(scan.triangles) else (CLOUD_TOLERANCE,)
    cameras = [view.camera for view in capture.views]
    inside = face_ball(capture, registration).holds(scan.vertices)
    inside &= seen(scan.vertices, surface.vertices.astype(np.float64), surface.triangles, cameras, *slack)
    return scan.vertices[inside].astype(np.float64)


def errors_mm(
    data: GNMData, registration: Registration, points: Float[np.ndarray, "P 3"], counts: Sequence[int]
) -> Float[np.ndarray, "2 k"]:
    """Mean distances of the model from the scan's points and from the registration's vertices."""
    was_seen = identity_part(data, regions.head_skin(data) & (registration.confidence >= _SURE))
    starts = fit_correspondence(was_seen, registration.vertices[was_seen.rows], counts)
    scans = fit_scan(identity_part(data, regions.exterior(data)), points, starts)
    return np.array([_means(scans), _means(starts)])


def _means(fits: Sequence[LinearFit]) -> list[float]:
    return [float(one.distance_mm.mean()) for one in fits]


def left_out(
    pairs: Sequence[tuple[Capture, Registration]], previous: GNMData, settings: IdentitySettings, counts: Sequence[int]
) -> Float[np.ndarray, "N 2 2 k"]:
    """Subject by model (previous, next) by way (scan, vertices) by number of components: mm."""
    function = GNM(previous)
    subjects = [subject_of(capture, one, function) for capture, one in pairs]
    found = []
    with shown() as progress:
        for number, (capture, one) in enumerate(pairs):
            progress.at(number, len(pairs), f"without {capture.subject}")
            points = face_points(capture, one)
            others = [
                subjects[other]
                for other, (_, registration) in enumerate(pairs)
                if other != number and registration.status in USABLE
            ]
            rebuilt = build_model(others, previous, replace(true_meshes(), identity=settings)).data
            found.append([errors_mm(data, one, points, counts) for data in (previous, rebuilt)])
    return np.array(found)


def show(names: Sequence[str], figures: Float[np.ndarray, "N 2 2 k"], counts: Sequence[int]) -> None:
    for way, kind in enumerate(("scan", "vertices")):
        table = Table("subject", *(f"{k}" for k in counts), title=f"{kind}: previous, next, mm, at components")
        for name, rows in zip(names, figures[:, :, way], strict=True):
            table.add_row(name, *(f"{one:.3f} {two:.3f}" for one, two in rows.T))
        Console(width=100).print(table)
        ratio = figures[:, 1, way] / figures[:, 0, way]
        for k, of in zip(counts, ratio.T, strict=True):
            low, middle, high = np.quantile(of, (0, 0.5, 1))
            print(f"{kind} components {k} better {(of < 1).sum()} median {middle:.3f} from {low:.3f} to {high:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="CAPTURE")
    parser.add_argument("--model", required=True, type=Path, metavar="NPZ")
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--components", type=int, nargs="*", default=[5, 10, 20, 40])
    parser.add_argument("--headline", type=int, default=20)
    parser.add_argument("--shrinkage", default=str(true_meshes().identity.shrinkage))
    for name in ("by-area", "mirrored"):
        default = getattr(true_meshes().identity, name.replace("-", "_"))
        parser.add_argument(f"--{name}", action=argparse.BooleanOptionalAction, default=default)
    options = parser.parse_args()
    pairs = registered(options.captures, options.model, options.out)
    if bad := [capture.subject for capture, one in pairs if capture.scan is None]:
        raise InputError(
            "Captures are no use", where=", ".join(bad), expected="a scan", got="none", fix="leave them out"
        )
    for capture, one in pairs:
        if one.status not in USABLE:
            print(f"{capture.subject} is in no model: {one.reason}")
    share = None if options.shrinkage == "chosen" else float(options.shrinkage)
    counts = sorted({*options.components, options.headline})
    settings = IdentitySettings(
        variance_ratio=1.0,
        max_components=counts[-1],
        shrinkage=share,
        by_area=options.by_area,
        mirrored=options.mirrored,
    )  # as many as MODEL is measured with
    figures = left_out(pairs, gnm_npz.read(options.model), settings, counts)
    show([capture.subject for capture, _ in pairs], figures, counts)
    ratio = (figures[:, 1, 0] / figures[:, 0, 0])[:, counts.index(options.headline)]
    print(f"{settings}")
    print(f"better {(ratio < 1).sum()} of {len(ratio)}")
    print(f"median_ratio {np.median(ratio):.3f}")


if __name__ == "__main__":
    main()
