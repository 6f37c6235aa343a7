"""Compare masks and labels that are made without a parser with a capture's own; print a table.

    python -m bench.labels --model NPZ [--views N] [--accuracy MM] [--no-landmarks] [--sheet PNG]
        CAPTURE[=REGISTRATION] ...

A registration folder gives the fitted head, best one by `--recipe in_model`. Without one the true vertices of a capture
of the model's topology take its place, moved by smooth waves of `--accuracy`. The capture's masks and labels are used
for the comparison alone; landmarks are detected. Per capture, over its views:

mask            intersection over union of the subject, and the 95th percentile of the distance between the silhouettes,
                px, where both are known
a class         intersection over union, and the same of the fitted model's own labels
hair, clothes   share of the true pixels that are excluded, and of the excluded ones that are true
uncertain       share of the subject's pixels without mask or label
"""

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

from registration.capture.class_names import KNOWN, NECK, covers
from registration.capture.native import read_capture
from registration.capture.pixels import read_coverage, read_photograph, read_view
from registration.detect.face478 import Face478Provider
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.segment.fitted import FOREIGN, INDEX, UNLABELLED, FittedHead
from registration.segment.labels import Labelled, fitted_labels, head_sphere
from registration.segment.masks import UNCERTAIN, first_masks
from registration.segment.pictures import sheet
from registration.segment.views import SegmentView
from registration.storage.registration_folder import load_registration
from registration.types import Capture, View

COMPARED = ("left_eye", "right_eye", "upper_lip", "lower_lip", "mouth_interior", "ears", NECK, "skin")
LEAST_PX = 30  # of a class in a view
WAVES_PER_M = np.array([[40.0, 55.0, 35.0], [-50.0, 30.0, 45.0], [25.0, -60.0, 50.0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """What one view shows."""

    mask: Float[np.ndarray, "H W"]
    labels: Float[np.ndarray, "H W"]  # index into the capture's classes


def fitted_head(capture: Capture, registration: Path | None, data: GNMData, accuracy_m: float) -> FittedHead:
    if registration is not None:
        return FittedHead(load_registration(registration).vertices, data)
    vertices = np.load(capture.ground_truth)["vertices"] if capture.ground_truth else np.zeros((0, 3))
    if len(vertices) != len(data.template_vertex_positions):
        raise InputError(
            "The capture has no vertices of the model's topology",
            where=capture.root,
            expected=f"{len(data.template_vertex_positions)} in ground_truth.npz",
            got=len(vertices),
            fix="give CAPTURE=REGISTRATION",
        )
    waves = np.sin(vertices @ WAVES_PER_M.T)
    return FittedHead(vertices + accuracy_m * np.sqrt(2 / 3) * waves, data)


def read(view: View, capture: Capture, provider: Face478Provider | None) -> tuple[SegmentView, Truth]:
    image, camera = read_photograph(view)
    found = provider.detect(image) if provider else []
    landmarks = np.column_stack([found[0].points, found[0].confidence]) if found else None
    pixels = read_view(view, capture)
    assert pixels.label_coverage is not None
    truth = Truth(mask=read_coverage(view), labels=pixels.label_coverage.argmax(-1).astype(np.float64))
    return SegmentView(name=view.name, image=image, camera=camera, landmarks=landmarks), truth


def overlap(found: Bool[np.ndarray, "H W"], true: Bool[np.ndarray, "H W"]) -> float:
    return float((found & true).sum() / max((found | true).sum(), 1))


def silhouette_px(found: Float[np.ndarray, "H W"], true: Float[np.ndarray, "H W"]) -> float:
    """95th percentile of the distance from the found border to the true one, away from what is uncertain."""
    known = cv2.dilate((np.abs(found - UNCERTAIN) < 0.02).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    borders = [cv2.Canny((mask > 0.5).astype(np.uint8) * 255, 50, 100) > 0 for mask in (found, true)]
    distance = cv2.distanceTransform((~borders[1]).astype(np.uint8), cv2.DIST_L2, 5)
    chosen = borders[0] & known
    return float(np.percentile(distance[chosen], 95)) if chosen.any() else float("nan")


def measures(
    capture: Capture, views: list[SegmentView], truths: list[Truth], found: list[Labelled], head: FittedHead
) -> dict[str, str]:
    rows: dict[str, list[tuple[float, ...]]] = {}
    unknown = INDEX[UNLABELLED]
    foreign = [*(INDEX[name] for name in FOREIGN), unknown]
    covered = [index for index, name in enumerate(capture.classes) if covers(name) and name not in KNOWN]
    for view, true, one in zip(views, truths, found, strict=True):
        known = (np.abs(one.mask - UNCERTAIN) > 0.02) & (one.labels != unknown)
        rows.setdefault("mask", []).append(
            (overlap((one.mask > 0.5) & known, (true.mask > 0.5) & known), silhouette_px(one.mask, true.mask))
        )
        subject = true.mask > 0.5
        rows.setdefault("uncertain", []).append((float((subject & ~known).sum() / subject.sum()),))
        model = head.view(view.camera).labels
        for name in COMPARED:
            here = true.labels == capture.classes.index(name) if name in capture.classes else np.zeros_like(subject)
            if here.sum() >= LEAST_PX:
                ours = overlap((one.labels == INDEX[name]) & known, here & known)
                rows.setdefault(name, []).append((ours, overlap(model == INDEX[name], here)))
        excluded, hidden = np.isin(one.labels, foreign), np.isin(true.labels, covered)
        if hidden.any():
            shares = ((excluded & hidden).sum() / hidden.sum(), (excluded & hidden).sum() / max(excluded.sum(), 1))
            rows.setdefault("hair, clothes", []).append(shares)
        else:
            rows.setdefault("foreign on bare skin", []).append((float((excluded & subject).sum() / subject.sum()),))
    return {name: " / ".join(f"{value:.3f}" for value in np.nanmean(values, 0)) for name, values in rows.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", metavar="CAPTURE[=REGISTRATION]")
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--views", type=int, default=6, help="spread over the capture's")
    parser.add_argument("--accuracy", type=float, default=1.5, help="of the fitted head, mm")
    parser.add_argument("--no-landmarks", action="store_true")
    parser.add_argument("--sheet", type=Path, help="write a picture of the last capture")
    arguments = parser.parse_args()
    data = gnm_npz.read(arguments.model)
    provider = None if arguments.no_landmarks else Face478Provider()
    table = Table("capture", "measure", "value", title="Masks and labels without a parser")
    for text in arguments.captures:
        root, _, registration = text.partition("=")
        capture = read_capture(Path(root))
        head = fitted_head(capture, Path(registration) if registration else None, data, arguments.accuracy / 1e3)
        chosen = np.linspace(0, len(capture.views) - 1, min(arguments.views, len(capture.views))).astype(int)
        capture = replace(capture, views=tuple(capture.views[index] for index in chosen))
        views, truths = map(list, zip(*(read(view, capture, provider) for view in capture.views), strict=True))
        start, sphere = time.perf_counter(), head_sphere(head)
        masks = first_masks(views, sphere.centre, sphere.radius_m)
        found = fitted_labels(views, masks, head, accuracy_m=arguments.accuracy / 1e3)
        seconds = time.perf_counter() - start
        for name, value in measures(capture, views, truths, found, head).items():
            table.add_row(f"{capture.subject}/{capture.expression}", name, value)
        table.add_row(f"{capture.subject}/{capture.expression}", "seconds per view", f"{seconds / len(views):.2f}")
        if arguments.sheet:
            cv2.imwrite(str(arguments.sheet), sheet(views, found)[..., ::-1])
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
