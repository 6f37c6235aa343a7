"""Measure maps between topologies: of two head models both ways, and of a re-meshed head whose map is known.

    python -m bench.topology_map MODEL.npz [--other OTHER.npz] [--out OUT]

MODEL is mapped to and from the first model (or OTHER). The two maps are made independently; "apart" is how far a vertex
comes to lie from itself when the one carries it over and the other back, which no bending minimises. Then MODEL's skin
is given other triangles, bent by 5 mm, and mapped: the error is the distance from the known point. "Bent along" also
moves points along the surface, of which a smooth skull shows nothing. "Wrong landmarks" err by 1.5 mm along each axis:
what follows each of them is worse than what smooths.
"""

import argparse
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.support.remeshed import remeshed
from coregister.first_model.build import bootstrap
from registration.frames import MM_PER_M
from registration.model import gnm_npz, regions
from registration.topology_map import file, landmarked, picture
from registration.topology_map.landmarked import LandmarkedMesh
from registration.topology_map.make import map_topologies
from registration.topology_map.topology_map import TopologyMap

_LANDMARK_ERROR_M = 1.5e-3
_COLUMNS = ("map", "verdict", "mean, mm", "largest", "cycle, mean", "largest", "flipped", "covered", "seconds")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--other", type=Path, help="by default the first model")
    parser.add_argument("--out", type=Path, help="folder for maps and pictures")
    options = parser.parse_args()
    model, other = landmarked.read(options.model), landmarked.read(options.other or bootstrap())
    table, console = Table(*_COLUMNS), Console(width=150)
    maps = [_measure(table, *pair, options.out) for pair in ((other, model), (model, other))]
    data = gnm_npz.read(options.model)
    known = {
        "bent": remeshed(data, model),
        "bent along": remeshed(data, model, along=True),
        "wrong landmarks": remeshed(data, model, landmark_error_m=_LANDMARK_ERROR_M),
    }
    found = {name: _measure(table, case.source, case.target, options.out) for name, case in known.items()}
    console.print(table)
    for mesh, there, back in ((other, *maps), (model, *maps[::-1])):
        console.print(f"apart on {mesh.name}: {_words(_apart(mesh, there, back))}")
    for name, case in known.items():
        points = found[name].points
        corners = case.source.vertices[case.source.triangles[points.triangle]]
        error = np.linalg.norm(np.einsum("vk,vkc->vc", points.barycentric, corners) - case.truth, axis=1)
        moved = np.linalg.norm(case.target.vertices - case.truth, axis=1)
        on_face = (regions.group(data, "hockey_mask") > 0.5)[case.source.triangles[points.triangle]].all(1)
        console.print(f"{name} by {_words(moved)}")
        console.print(f"  error: {_words(error[points.mask])}")
        console.print(f"  error on the face: {_words(error[points.mask & on_face])}")
    return 0


def _measure(table: Table, source: LandmarkedMesh, target: LandmarkedMesh, out: Path | None) -> TopologyMap:
    start = perf_counter()
    mapped = map_topologies(source, target)
    seconds = perf_counter() - start
    f, name = mapped.figures, f"{source.name} to {target.name}"
    table.add_row(
        name,
        mapped.status,
        *(f"{f[key]:.4f}" for key in ("mean_mm", "max_mm", "cycle_mean_mm", "cycle_max_mm")),
        f"{f['flipped_faces']:.0f}",
        f"{f['covered']:.1%}",
        f"{seconds:.0f}",
    )
    if out is not None:
        file.write(mapped, out / f"{name}.npz")
        picture.draw(mapped, source, target, out / f"{name}.png")
    return mapped


def _apart(mesh: LandmarkedMesh, there: TopologyMap, back: TopologyMap) -> np.ndarray:
    """Distances of a mesh's vertices from themselves, by the map from `mesh` and the independent one to it."""
    corners = back.source_triangles[back.points.triangle]
    rows = np.flatnonzero(back.mask & there.mask[corners].all(1))
    returned = there.carry(mesh.vertices)[corners[rows]]
    return np.linalg.norm(
        np.einsum("vk,vkc->vc", back.points.barycentric[rows], returned) - mesh.vertices[rows], axis=1
    )


def _words(metres: np.ndarray) -> str:
    mm = MM_PER_M * metres
    return (
        f"{mm.mean():.3f} mm mean, {np.median(mm):.3f} median, {np.percentile(mm, 95):.3f} p95, {mm.max():.2f} largest"
    )


if __name__ == "__main__":
    sys.exit(main())
