"""Measure the cranium of registrations: people with hair and a shirt, and captures of few views.

    python -m bench.cranium OUT [--heads 20] [--recipe draft] [--captures DIR ...]

Renders people who made no part of the auxiliary model in 22 views, registers them without the auxiliary model, and
fills the hidden cranium of each registration in every way. Captures with a scan of the whole head (--captures) are
registered as they are, then the cranium loses its confidence; distances are then to the scan's surface. OUT keeps what
was computed.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.support.cranium_measures import MODEL, CraniumMeasure, fills
from coregister.anatomy.cranium_model import under_hair
from coregister.first_model import build
from coregister.synthetic.capture import Studio
from coregister.synthetic.subject import synthesize_capture
from registration.capture.native import read_capture
from registration.capture.scan import read_scan, read_truth
from registration.cranium import auxiliary_model
from registration.cranium.auxiliary_model import CraniumModel
from registration.cranium.complete import CraniumCompletion
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.types import Registration
from workflows.steps.cranium_model import make_cranium_model

_FIRST_SEED = 7001
AS_REGISTERED = "as registered"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One head: mean distance of its cranium by fill, and what the completion did besides."""

    name: str
    cranium_mm: dict[str, float]
    face_moved_mm: float
    curvature: float | None = None  # in the band, of the truth's


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--heads", type=int, default=20)
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--captures", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    path = build.bootstrap(options.out / "model" / "gnm_head_first.npz")
    data = gnm_npz.read(path)
    if (model := auxiliary_model.find(path, data)) is None:
        model = make_cranium_model(path)[1]
    chosen = RegisterOptions(recipe=options.recipe, cranium="off")
    rows = []
    for seed in range(_FIRST_SEED, _FIRST_SEED + options.heads):
        root = options.out / "captures" / f"{seed}"
        if not root.exists():
            synthesize_capture(root, seed=seed, studio=Studio(cameras=22, hair=True, shirt=True, size_px=(480, 720)))
        registered = register(root, path, options.out / "registrations" / root.name, chosen)
        rows.append(_with_hair(data, model, registered, root))
        print(rows[-1], flush=True)
    if rows:
        _show("people with hair and shirt, 22 views", rows)
    others = []
    for root in options.captures:
        registered = register(root, path, options.out / "registrations" / root.parent.name, chosen)
        others.append(_hidden(data, model, registered, root))
        print(others[-1], flush=True)
    if others:
        _show("captures of another topology, cranium hidden", others)
    return 0


def _with_hair(data: GNMData, model: CraniumModel, registered: Registration, root: Path) -> Row:
    """By true vertices of the same index."""
    head, truth = registered.vertices.astype(np.float64), read_truth(root / "ground_truth.npz").astype(np.float64)
    confidence = registered.confidence
    completed = CraniumCompletion(data, model)(head, confidence)
    assert completed is not None
    measure = CraniumMeasure.of(data, completed)
    errors = {name: measure(fill(head, confidence), truth) for name, fill in fills(data, model).items()}
    errors[AS_REGISTERED] = measure(head, truth)
    return Row(
        name=root.name,
        cranium_mm={name: error.cranium_mm for name, error in errors.items()},
        face_moved_mm=_face_moved(data, completed.vertices, head),
        curvature=errors[MODEL].curvature / errors[MODEL].true_curvature,
    )


def _hidden(data: GNMData, model: CraniumModel, registered: Registration, root: Path) -> Row:
    """By distance to the scan's surface. What was registered there saw the cranium, and is no fill."""
    head = registered.vertices.astype(np.float64)
    file = read_capture(root).scan
    assert file is not None
    scan = read_scan(file)
    hair = under_hair(data)
    confidence = np.where(hair, 0.0, registered.confidence).astype(np.float32)
    filled = {name: fill(head, confidence) for name, fill in fills(data, model).items()}
    surface = scan.vertices.astype(np.float64)
    means = {
        name: float(MM_PER_M * closest_points(vertices[hair], surface, scan.triangles)[0].mean())
        for name, vertices in filled.items()
    }
    return Row(name=root.parent.name, cranium_mm=means, face_moved_mm=_face_moved(data, filled[MODEL], head))


def _face_moved(data: GNMData, filled: np.ndarray, head: np.ndarray) -> float:
    face = regions.head_skin(data) & ~regions.cranium(data)
    return float(MM_PER_M * np.linalg.norm(filled - head, axis=1)[face].max())


def _show(title: str, rows: list[Row]) -> None:
    names = list(rows[0].cranium_mm)
    means = {name: float(np.mean([row.cranium_mm[name] for row in rows])) for name in names}
    table = Table("fill", "cranium, mm: mean", "worst head", "auxiliary model better by", title=f"{title}: {len(rows)}")
    for name in names:
        worst = max(row.cranium_mm[name] for row in rows)
        better = "" if name == MODEL else f"{100 * (1 - means[MODEL] / means[name]):.0f} %"
        table.add_row(name, f"{means[name]:.2f}", f"{worst:.2f}", better)
    console = Console(width=120)
    console.print(table)
    console.print(f"face moved by at most {max(row.face_moved_mm for row in rows):.4f} mm")
    if (curvature := [row.curvature for row in rows if row.curvature is not None]) != []:
        console.print(f"curvature in the band, 95th percentile, of the truth's: {np.mean(curvature):.3f}")


if __name__ == "__main__":
    sys.exit(main())
