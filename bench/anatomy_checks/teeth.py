"""Teeth: how the dentitions were made, and whether teeth and gums of random ones from the components keep apart.

Overlaps are measured on the drawn meshes themselves, by winding numbers and closest points: nothing is shared with the
grids by which samples are rejected.
"""

import multiprocessing
import resource
import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bench.anatomy_checks import Figure
from coregister.anatomy.part_basis import PartBasis
from coregister.anatomy.teeth import teeth_basis
from registration.anatomy.tooth_structure import DentalArch, Tooth, find_teeth
from registration.frames import MM_PER_M
from registration.geometry.closest_point import closest_points
from registration.geometry.surface_samples import sample_surface
from registration.geometry.winding import Winding, closed
from registration.model.gnm_npz import GNMData

DRAWN = 100  # random dentitions
OVERLAP_MM = BELOW_MM = 0.3
_POINTS = 600  # on each tooth, beside its vertices
_INSIDE = 0.5  # winding number


def figures(data: GNMData) -> Iterator[Figure]:
    """Make 5,000 dentitions in a process of their own, and measure 100 random ones of the components."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        basis, seconds, peak_gb = pool.apply(_timed, (data,))
    assert basis.template is not None
    record, template = basis.record, data.template_vertex_positions.astype(np.float64)
    yield Figure(name="teeth found, upper and lower", value=sum(record["teeth"]), unit="")
    yield Figure(name="samples rejected", value=record["rejected"], unit=f"beside {record['samples']}")
    yield Figure(name="time", value=seconds, unit="s", most=180)
    yield Figure(name="memory of the process", value=peak_gb, unit="GB", most=2)
    yield Figure(name="components", value=record["components"], unit="", least=60, most=100)
    yield Figure(name="variance kept", value=record["variance_kept"], unit="", least=0.99)
    moved = np.linalg.norm(basis.template - template[basis.vertices], axis=1)
    yield Figure(name="template moved, mean", value=MM_PER_M * moved.mean(), unit="mm")
    yield Figure(name="template moved at most", value=MM_PER_M * moved.max(), unit="mm")
    deviation = np.sqrt((basis.components.astype(np.float64) ** 2).sum((0, 2)))
    yield Figure(name="standard deviation of a vertex, mean", value=MM_PER_M * deviation.mean(), unit="mm")
    yield from _drawn(basis, find_teeth(data), template)


def _timed(data: GNMData) -> tuple[PartBasis, float, float]:
    start = time.perf_counter()
    basis = teeth_basis(data)
    return basis, time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _drawn(
    basis: PartBasis, arches: tuple[DentalArch, DentalArch], template: Float[np.ndarray, "V 3"]
) -> Iterator[Figure]:
    assert basis.template is not None
    rng = np.random.default_rng(1)
    teeth = [tooth for arch in arches for tooth in arch.teeth]
    deepest, out, margin = [], [], []
    vertices = template.copy()
    for coefficients in rng.standard_normal((DRAWN, len(basis.names))):
        vertices[basis.vertices] = basis.template + np.tensordot(coefficients, basis.components, 1)
        deepest.append(_deepest(teeth, vertices, rng))
        for arch in arches:
            out.append(_out_of_gum(arch, vertices))
            line = np.concatenate([tooth.neck_line(vertices) for tooth in arch.teeth])
            margin.append(closest_points(line, vertices, arch.gum_triangles)[0])
    share = float((np.array(deepest) > OVERLAP_MM / MM_PER_M).mean())
    yield Figure(name=f"dentitions with two teeth {OVERLAP_MM} mm in one another", value=share, unit="", most=0.02)
    yield Figure(name="deepest overlap", value=MM_PER_M * max(deepest), unit="mm")
    yield Figure(name="neck out of the gum at most", value=MM_PER_M * max(out), unit="mm", most=BELOW_MM)
    distance = MM_PER_M * np.concatenate(margin)
    yield Figure(name="gum margin from its line in the template, mean", value=float(distance.mean()), unit="mm")
    yield Figure(name="gum margin from it, 99th percentile", value=float(np.quantile(distance, 0.99)), unit="mm")


def _deepest(teeth: list[Tooth], vertices: Float[np.ndarray, "V 3"], rng: np.random.Generator) -> float:
    """The depth of the deepest point of a tooth in another one, metres."""
    points = []
    for tooth in teeth:
        crown = tooth.triangles[np.isin(tooth.triangles, tooth.vertices[tooth.crown]).all(1)]
        face, weight = sample_surface(vertices, crown, _POINTS, rng)
        on_surface = np.einsum("pk,pkc->pc", weight, vertices[crown[face]])
        points.append(np.concatenate([vertices[tooth.vertices[tooth.crown]], on_surface]))
    trees, deepest = [cKDTree(p) for p in points], 0.0
    for fixed, tooth in enumerate(teeth):
        near = [
            points[k][trees[fixed].query(points[k], distance_upper_bound=2e-3)[0] < np.inf]
            for k in range(len(teeth))
            if k != fixed
        ]
        candidates = np.concatenate(near)
        solid = closed(vertices, tooth.triangles)
        inside = candidates[Winding(*solid).numbers(candidates) > _INSIDE]
        if len(inside):
            deepest = max(deepest, float(closest_points(inside, *solid)[0].max()))
    return deepest


def _out_of_gum(arch: DentalArch, vertices: Float[np.ndarray, "V 3"]) -> float:
    """How far a vertex of a neck has come out of the gum, metres; 0 for teeth that share their necks with it."""
    roots = [np.unique(tooth.neck[:, 1]) for tooth in arch.teeth if not tooth.crown.all()]
    if not roots:
        return 0.0
    necks = vertices[np.concatenate(roots)]
    outside = necks[Winding(*closed(vertices, arch.gum_triangles)).numbers(necks) < _INSIDE]
    return float(closest_points(outside, vertices, arch.gum_triangles)[0].max()) if len(outside) else 0.0
