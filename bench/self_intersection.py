"""The self-intersection penalty: cost, accuracy, separation of crossed parts, and a model's own self-intersections.

    python -m bench.self_intersection --model MODEL.npz [--samples FILE.npz]

`--samples` has further faces to measure besides random ones: arrays `identity_deltas` and `expression_deltas` (N, V,
3), metres, with `identity_names` and `expression_names`. Depths in crossed parts are measured independently of the
penalty, by winding numbers and closest points (`bench/support/crossed_parts.py`), as the excess over the template's.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from bench.support import crossed_parts
from registration.losses.self_intersection import SelfIntersectionPenalty
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

REPEATS = 15
PUSHES_MM = (1.0, 2.0, 3.0, 4.0, 5.0)
DIRECTIONS = {"sideways": (1.0, 0.0, 0.0), "forwards": (0.0, 0.0, 1.0), "askew": (-0.7, 0.3, 0.7)}
HEADS = 20  # random heads of each kind
SIGMA = 0.5  # of random expression coefficients: with 1, independent components would add up to grimaces
MARGIN_MM = 0.05


def cost(data: GNMData) -> Table:
    """Return median wall-clock milliseconds on the template and on a head with crossed lips."""
    table = Table("head", "construct", "refresh", "call", "call and backward", "a step, refreshed every 10")
    start = time.perf_counter()
    penalty = SelfIntersectionPenalty(data, torch.device("cpu"))
    built = 1e3 * (time.perf_counter() - start)
    template = torch.as_tensor(data.template_vertex_positions)
    for name, vertices in {"template": template, "crossed lips": crossed_parts.raised_lower_lip(data, 2.0)}.items():
        vertices = vertices.clone().requires_grad_(True)

        def backward(vertices: Tensor = vertices) -> None:
            torch.stack(list(penalty(vertices).values())).sum().backward()

        refresh = median_ms(lambda vertices=vertices: penalty.update_candidates(vertices))
        call, both = median_ms(lambda vertices=vertices: penalty(vertices)), median_ms(backward)
        table.add_row(name, *(f"{ms:.1f}" for ms in (built, refresh, call, both, both + refresh / 10)))
    return table


def median_ms(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds)


def pushed_tongue(data: GNMData, penalty: SelfIntersectionPenalty) -> Table:
    """Return depths and their errors for the tongue pushed into the teeth."""
    table = Table("tongue pushed", "by, mm", "vertices inside", "deepest, mm", "largest error, mm")
    tongue, teeth = regions.tongue(data), crossed_parts.teeth_of(data)
    for name, direction in DIRECTIONS.items():
        for push in PUSHES_MM:
            vertices = crossed_parts.translated_part(data, tongue, tuple(push * axis for axis in direction))
            penalty.update_candidates(vertices)
            depth_mm = penalty.excess_mm(vertices)["tongue-teeth"].numpy()[tongue]
            points = vertices.numpy().astype(np.float64)
            truth = crossed_parts.part_depths_mm(points[tongue], points, teeth)
            error = np.abs(depth_mm - np.maximum(truth - MARGIN_MM, 0)).max()
            table.add_row(name, f"{push:g}", f"{(truth > 0).sum()}", f"{truth.max():.2f}", f"{error:.3f}")
    return table


def recovered(data: GNMData) -> Table:
    """Return depths of crossed lips and lids before and after the penalty was minimized over the skin's offsets."""
    table = Table("crossed", "by, mm", "too deep, mm", "after", "cheeks moved, mm", "skin moved, mm", "seconds")
    template = torch.as_tensor(data.template_vertex_positions)
    for name, cross, measure, rate in (  # the rate is per mm of displacement to undo
        ("lips", crossed_parts.raised_lower_lip, crossed_parts.lip_depths_mm, 1e-4),
        ("upper lid", crossed_parts.pressed_lid, crossed_parts.eyeball_depths_mm, 4e-5),
    ):
        rest = measure(data, template)
        for by_mm in (1.0, 2.0, 3.0):
            start = time.perf_counter()
            result = crossed_parts.recover(data, cross(data, by_mm), steps=100, rate=rate * by_mm)
            seconds = time.perf_counter() - start
            before, after = ((measure(data, head) - rest).max() for head in (result.before, result.after))
            motion = (result.max_motion_mm(crossed_parts.cheeks(data)), result.max_motion_mm(regions.exterior(data)))
            numbers = (before, after, *motion, seconds)
            table.add_row(name, f"{by_mm:g}", *(f"{number:.2f}" for number in numbers))
    return table


def faces(data: GNMData, samples: Path | None) -> Iterator[tuple[str, Tensor]]:
    """Return heads of the model: the given ones, then random ones of each kind."""
    template = data.template_vertex_positions.astype(np.float64)
    if samples is not None:
        with np.load(samples) as arrays:
            for kind in ("identity", "expression"):
                for name, delta in zip(arrays[f"{kind}_names"].tolist(), arrays[f"{kind}_deltas"], strict=True):
                    yield f"{kind} {name}", torch.as_tensor(template + delta, dtype=torch.float32)
    random = np.random.default_rng(0)
    kinds = np.array([name.rsplit("_", 1)[0] for name in data.expression_names.tolist()])
    bases = {f"random {kind}": SIGMA * data.expression_basis[kinds == kind] for kind in dict.fromkeys(kinds)}
    for name, basis in {"random identity": data.vertex_identity_basis, **bases}.items():
        for _ in range(HEADS):
            move = np.tensordot(random.normal(size=len(basis)), basis.astype(np.float64), 1)
            yield name, torch.as_tensor(template + move, dtype=torch.float32)


def model_intersections(data: GNMData, penalty: SelfIntersectionPenalty, samples: Path | None) -> Table:
    """Return penetrating vertices and greatest depth of the faces beyond the template; medians of random ones."""
    table = Table("face", *penalty.pairs, title="vertices / deepest, mm; for random faces the median / the worst")
    metrics_by_name: dict[str, list[dict[str, tuple[int, float]]]] = {}
    for name, vertices in faces(data, samples):
        penalty.update_candidates(vertices)
        excess = penalty.excess_mm(vertices)
        metrics = {pair: (int((mm > 0).sum()), float(mm.max())) for pair, mm in excess.items()}
        metrics_by_name.setdefault(name, []).append(metrics)
    for name, heads in metrics_by_name.items():
        cells = []
        for pair in penalty.pairs:
            count, deepest = statistics.median(h[pair][0] for h in heads), max(h[pair][1] for h in heads)
            median = f"{statistics.median(h[pair][1] for h in heads):.2f} / " if len(heads) > 1 else ""
            cells.append(f"{count:g} / {median}{deepest:.2f}" if deepest > 0 else "")
        table.add_row(name, *cells)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--samples", type=Path)
    arguments = parser.parse_args()
    data, console = gnm_npz.read(arguments.model), Console()
    console.print(cost(data))
    penalty = SelfIntersectionPenalty(data, torch.device("cpu"))
    for table in (pushed_tongue(data, penalty), recovered(data), model_intersections(data, penalty, arguments.samples)):
        console.print(table)


if __name__ == "__main__":
    main()
