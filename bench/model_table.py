"""Compare head models by the paper's protocol: its table, figures and every number.

    python -m bench.model_table [MODEL ...] --out DIR [--captures DIR] [--flame] [--people 200] [--jobs 2]

The first model is compared with the others on synthetic people that no model has seen, each with the true mesh as
registration and scan, half of them neutral; and on captures of one other topology (`--captures`: the folder of their
subjects), whose scans are in correspondence: a map carries them to the first model's topology. DIR keeps maps, samples
and results; the same command resumes. Seconds are wall-clock time.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.support.flame_shaped import flame_shaped, write_flame_pickle
from coregister.evaluate.face_adam import AdamSettings
from coregister.evaluate.face_data import FaceSample
from coregister.evaluate.face_protocol import NEUTRAL, ProtocolSettings
from coregister.first_model import build, makehuman, population
from coregister.first_model.assembly import build_assembly
from coregister.first_model.build import TargetDisplacements
from coregister.synthetic import expressions
from registration.capture.native import read_capture
from registration.capture.scan import Scan, read_scan
from registration.capture.triangulation import triangulate
from registration.geometry.closest_point import closest_points
from registration.linear_models import registry
from registration.model import gnm_npz
from registration.model.landmarks import LandmarkScheme, schemes_beside
from registration.progress import console_progress
from registration.topology_map import file as map_file
from registration.topology_map import landmarked
from registration.topology_map.landmarked import LandmarkedMesh
from registration.topology_map.make import map_topologies
from registration.topology_map.topology_map import TopologyMap
from registration.types import Capture
from workflows.records.face_samples import write_samples
from workflows.steps.compare import ComparisonInput, compare_models, lines

_SEED = 29  # of the people; no model was built from them
_SCHEME = "68"


def synthetic_samples(count: int) -> Iterator[FaceSample]:
    """Yield people of any adult age and build, asymmetric: every second one neutral, the others with an expression."""
    head = build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    displacements, rng = TargetDisplacements(head.source), np.random.default_rng([_SEED, 0])
    performed = [item for item in expressions.EXPRESSIONS.values() if item.category != NEUTRAL]
    triangles = gnm_npz.read(build.bootstrap()).triangles.astype(np.int64)
    for number in range(count):
        person = population.sample_unspanned_person(head.source, rng)
        vertices, joints = head.assemble(person, displacements)
        category = NEUTRAL
        if number % 2:
            expression = performed[rng.integers(len(performed))]
            category = expression.category
            vertices = expressions.apply_expression(head, expression, vertices, joints)
        vertices = vertices.astype(np.float64)
        yield FaceSample(
            name=f"person_{number:03d}",
            subject=f"person_{number:03d}",
            category=category,
            vertices=vertices,
            scan=vertices,
            scan_triangles=triangles,
            tags={**person.tags, "data": "synthetic"},
        )


def captured_samples(folder: Path, first: Path, out: Path) -> Iterator[FaceSample]:
    """Yield the captures of a folder of subjects, whose scans are one mesh in correspondence."""
    captures = [read_capture(path.parent) for path in sorted(folder.glob("*/*/capture.toml"))]
    pairs = [(capture, read_scan(capture.scan)) for capture in captures if capture.scan is not None]
    topologies = [gnm_npz.topology_hash(scan.triangles) for _, scan in pairs]
    alike = [
        pair
        for pair, digest in zip(pairs, topologies, strict=True)
        if topologies.count(digest) == max(map(topologies.count, topologies))
    ]
    neutrals = [pair for pair in alike if pair[0].expression == NEUTRAL]
    most, template = max(neutrals, key=lambda pair: len(pair[0].views))
    target = marked_scan(most, template)
    back = kept_map(landmarked.read(first), target, out / "map_captures.npz").inverse()
    for capture, scan in alike:
        yield FaceSample(
            name=f"{capture.root.parent.name}_{capture.root.name}",
            subject=capture.subject,
            category=NEUTRAL if capture.expression == NEUTRAL else "captured expression",
            vertices=back.place(scan.vertices.astype(np.float64)),
            scan=scan.vertices.astype(np.float64),
            scan_triangles=scan.triangles,
            tags={"data": "captures"},
        )


def marked_scan(capture: Capture, scan: Scan) -> LandmarkedMesh:
    """Return a scan with the landmarks that the capture's views show."""
    points, _, _ = triangulate(capture, _SCHEME)
    known = np.isfinite(points).all(1)
    points[~known] = scan.vertices.mean(0) + 10  # on no surface that a map is made on
    distance, face, share = closest_points(points, scan.vertices, scan.triangles)
    spread = np.where(known, np.maximum(distance, 2e-3), 1.0)
    scheme = LandmarkScheme(name=_SCHEME, indices=scan.triangles[face], weights=share, spread_m=spread)
    return landmarked.of_mesh(scan.vertices, scan.triangles, {_SCHEME: scheme}, str(capture.root))


def marked_model(path: Path) -> LandmarkedMesh:
    """Return a model's template with the landmarks beside its file."""
    data = registry.read(path)
    if data.format == "gnm":
        return landmarked.read(path)
    return landmarked.of_mesh(data.template, data.triangles, schemes_beside(path, data.template), path.name)


def write_flame_shaped(out: Path) -> Path:
    """Write a model of FLAME's shape, with a jaw joint, and return its path."""
    path = out / "flame_shaped.pkl"
    if not path.is_file():
        first = build.bootstrap()
        data = gnm_npz.read(first)
        scheme = schemes_beside(first, data.template_vertex_positions)[_SCHEME]
        arrays, marks = flame_shaped(data, scheme)
        write_flame_pickle(arrays, path, marks)
    return path


def kept_map(source: LandmarkedMesh, target: LandmarkedMesh, file: Path) -> TopologyMap:
    """Return the map between two heads, made once."""
    if not file.is_file():
        mapped = map_topologies(source, target)
        print(f"{file.stem}: {mapped.status} {' '.join(mapped.reasons)} {dict(mapped.figures)}", flush=True)
        map_file.write(mapped, file)
    return map_file.read(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--captures", type=Path)
    parser.add_argument("--flame", action="store_true", help="and a model of FLAME's shape, made from the first")
    parser.add_argument("--people", type=int, default=200)
    parser.add_argument("--points", type=int, default=3000)
    parser.add_argument("--adam-steps", type=int, default=5000)
    parser.add_argument("--adam-rate", type=float, default=1e-3)
    parser.add_argument("--adam-samples", type=int, default=15)
    parser.add_argument("--curve-samples", type=int, default=40)
    parser.add_argument("--random-heads", type=int, default=2000)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    first = build.bootstrap()
    maps = []
    models = [*options.models, *([write_flame_shaped(options.out)] if options.flame else [])]
    for path in models:
        maps.append(options.out / f"map_{path.stem}.npz")
        kept_map(landmarked.read(first), marked_model(path), maps[-1])
    captured = list(captured_samples(options.captures, first, options.out)) if options.captures else []
    samples = (*captured, *synthetic_samples(options.people))
    file = options.out / "samples.npz"
    write_samples(samples, gnm_npz.read(first).triangles.astype(np.int64), file)
    print(f"{len(samples)} samples, {time.perf_counter() - start:.0f} seconds", flush=True)
    settings = ProtocolSettings(
        points=options.points,
        adam=AdamSettings(steps=options.adam_steps, rate=options.adam_rate),
        adam_samples=options.adam_samples,
        curve_samples=options.curve_samples,
        random_heads=options.random_heads,
    )
    given = ComparisonInput(models=(first, *models), samples=file, maps=tuple(maps))
    with console_progress() as progress:
        comparison = compare_models(
            given, out=options.out / "comparison", settings=settings, jobs=options.jobs, progress=progress
        )
    print("\n".join(lines(comparison)))
    for row in comparison.rows:
        if row.kind in ("region", "data", "category"):
            figures = f"{row.mean.mean:.3f} median {row.median:.3f} std {row.std:.3f} mm, {row.samples} samples"
            print(f"{row.model}, {row.kind} {row.name}: {figures}")
    print(f"seconds {time.perf_counter() - start:.0f}")


if __name__ == "__main__":
    main()
