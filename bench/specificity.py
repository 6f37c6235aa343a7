"""Specificity of the first model against heads of the synthetic population: seconds, and equality to brute force.

    python -m bench.specificity [--draws 2000] [--database 500] [--brute-force 50] [--points 1000] [--workers 2]

Random heads of the first model are compared with true meshes of persons outside its span. The first `--brute-force` of
them are also compared with every head of the database, by other code. Seconds are wall-clock time.
"""

import argparse
import os
import time

import lagrange
import numpy as np
from jaxtyping import Float, Int

from bench.support.population import true_neutrals
from coregister.evaluate.linear_fit import LinearPart, identity_part
from coregister.evaluate.specificity import SpecificitySettings, random_heads, specificity
from coregister.first_model import assembly, build, makehuman, population
from coregister.first_model.build import TargetDisplacements
from registration.frames import MM_PER_M, transform_points
from registration.geometry.closest_point import barycentric_points, surface_mesh
from registration.geometry.rigid import align
from registration.geometry.surface_samples import spread_over_surface
from registration.model import gnm_npz

_DRAWS_SEED, _DATABASE_SEED = 0, 777


def brute_force(
    part: LinearPart,
    draws: list[Float[np.ndarray, "P 3"]],
    database: Float[np.ndarray, "N P 3"],
    settings: SpecificitySettings,
) -> tuple[Float[np.ndarray, "S"], Int[np.ndarray, "S"]]:
    """Return distance, mm, and index of the nearest head of each, by comparison with every head."""
    rng = np.random.default_rng(settings.seed)
    points = spread_over_surface(part.rest, part.triangles, settings.points, rng)
    weights = np.ones((1, len(part.rows)))
    T_real_draw = [[align(draw[None], real, weights)[0] for draw in draws] for real in database]
    on_draws = [barycentric_points(draw, part.triangles, *points) for draw in draws]
    on_database = [barycentric_points(real, part.triangles, *points) for real in database]
    distances = np.zeros((len(draws), len(database)))
    for column, real in enumerate(database):
        moved = [transform_points(T, own) for T, own in zip(T_real_draw[column], on_draws, strict=True)]
        distances[:, column] += mean_distances_mm(moved, real, part.triangles) / 2
    for row, draw in enumerate(draws):
        inverse = [np.linalg.inv(transforms[row]) for transforms in T_real_draw]
        moved = [transform_points(T, there) for T, there in zip(inverse, on_database, strict=True)]
        distances[row] += mean_distances_mm(moved, draw, part.triangles) / 2
    return distances.min(1), distances.argmin(1)


def mean_distances_mm(
    points: list[Float[np.ndarray, "M 3"]], vertices: Float[np.ndarray, "P 3"], triangles: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "S"]:
    """Return the mean distance of each set of points from a surface, by Lagrange's own loop over points."""
    source = lagrange.SurfaceMesh()
    source.add_vertices(np.concatenate(points))
    lagrange.bvh.compute_mesh_distances(source, surface_mesh(vertices, triangles), "distance")
    return np.array(source.attribute("distance").data).reshape(len(points), -1).mean(1) * MM_PER_M


def _processor_seconds() -> float:
    """Seconds of processors that this process and its children have used."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--database", type=int, default=500)
    parser.add_argument("--brute-force", type=int, default=50)
    parser.add_argument("--points", type=int, default=SpecificitySettings().points)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    part = identity_part(gnm_npz.read(build.bootstrap()))
    head = assembly.build_assembly(makehuman.read(makehuman.fetch()), population.mean_person())
    rng = np.random.default_rng(_DATABASE_SEED)
    neutrals = true_neutrals(head, TargetDisplacements(head.source), options.database, rng)
    database = neutrals[:, part.rows]
    components, settings = [len(part.basis)], SpecificitySettings(points=options.points, workers=options.workers)
    start, before = time.perf_counter(), _processor_seconds()
    draws = random_heads(part, components, samples=options.draws, seed=_DRAWS_SEED)
    found = specificity(draws, database, rest=part.rest, triangles=part.triangles, settings=settings)
    seconds, processor = time.perf_counter() - start, _processor_seconds() - before
    evaluations = found.evaluations
    print(f"draws {options.draws} heads {len(database)} points {settings.points} components {components[0]}")
    print(f"specificity mm {found.distance_mm.mean():.3f} median {np.median(found.distance_mm):.3f}")
    print(f"heads evaluated mean {evaluations.mean():.1f} most {evaluations.max()}")
    print(f"workers {settings.workers} seconds {seconds:.0f}, of processors {processor:.0f}", flush=True)
    count = min(options.brute_force, options.draws)
    if count:
        chosen = list(random_heads(part, components, samples=options.draws, seed=_DRAWS_SEED))[:count]
        start = time.perf_counter()
        distance, nearest = brute_force(part, chosen, database, settings)
        error = np.abs(distance - found.distance_mm[:count]).max()
        same = int((nearest == found.nearest[:count]).sum())
        seconds = time.perf_counter() - start
        print(f"brute force: {same} of {count} neighbours equal, difference <= {error:.1e} mm, seconds {seconds:.0f}")


if __name__ == "__main__":
    main()
