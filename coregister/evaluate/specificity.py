"""Specificity: mean distance of a model's random heads from the nearest real ones [GNM, Specificity of GNM],
[Styner 2003]; docs/algorithms.md, "Specificity".

Specificity complements generalization, which alone rewards a model that can represent anything; report both.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate.head_database import HeadDatabase, Nearest
from coregister.evaluate.linear_fit import LinearPart
from registration.geometry.surface_samples import spread_over_surface

_BATCH = 20  # random heads that a process is given at a time


@dataclass(frozen=True, kw_only=True)
class SpecificitySettings:
    """Settings of specificity.

    Attributes:
        points: number of points of each surface whose distances from the other are averaged.
        seed: of these points.
        workers: number of processes, which does not change the result. Each prepares the database for itself: 0.1 s and
            5 MB for a head of 13,000 vertices.
    """

    points: int = 1000
    seed: int = 0
    workers: int = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Specificity:
    """The nearest real head of each random head."""

    distance_mm: Float[np.ndarray, "S"]
    nearest: Int[np.ndarray, "S"]  # index in the database
    evaluations: Int[np.ndarray, "S"]  # number of real heads whose distance was begun to be computed


def specificity(
    draws: Iterable[Float[np.ndarray, "P 3"]],
    database: Float[np.ndarray, "N P 3"],
    *,
    rest: Float[np.ndarray, "P 3"],
    triangles: Int[np.ndarray, "F 3"],
    settings: SpecificitySettings | None = None,
) -> Specificity:
    """Find the nearest real head of each random head, and its distance.

    The distance of two heads is the mean of both surfaces' mean distances from the other, without scale, after the
    rigid alignment of least squares of their vertices. The nearest is that of a comparison with all real heads: those
    that are not compared are proven to be farther.

    Args:
        draws: random heads, metres, each in any frame. They are used one at a time.
        database: real heads in the same correspondence, likewise; at least one.
        rest: vertices, on which the points are uniform by area.
        triangles: vertex indices.
        settings: of the distance.
    """
    settings = settings or SpecificitySettings()
    points = spread_over_surface(rest, triangles, settings.points, np.random.default_rng(settings.seed))
    if settings.workers > 1:
        found = _in_processes(draws, (database, triangles, points), settings.workers)
    else:
        heads = HeadDatabase(database, triangles, points)
        found = [heads.nearest(draw) for draw in draws]
    return Specificity(
        distance_mm=np.array([each.distance_mm for each in found]),
        nearest=np.array([each.index for each in found], dtype=np.int64),
        evaluations=np.array([each.evaluations for each in found], dtype=np.int64),
    )


def random_heads(
    part: LinearPart, components: Sequence[int], *, samples: int, seed: int = 0
) -> Iterator[Float[np.ndarray, "P 3"]]:
    """Yield random heads: for each number of components k, the first k coefficients of the same samples of N(0, I).

    Args:
        part: the model.
        components: numbers of components.
        samples: number of heads for each.
        seed: of the coefficients.
    """
    coefficients = np.random.default_rng(seed).standard_normal((samples, max(components)))
    return (part.shape(row[:count]) for count in components for row in coefficients)


def specificity_mm(
    part: LinearPart,
    real: Float[np.ndarray, "N P 3"],
    components: Sequence[int],
    *,
    samples: int,
    seed: int = 0,
) -> Float[np.ndarray, "S k"]:
    """Return the distance of each random head from its nearest real one, mm, for each number of components.

    Args:
        part: the model.
        real: neutrals, the part's vertices, metres, each in any frame.
        components: numbers of components.
        samples: number of random heads, S.
        seed: of coefficients and points.
    """
    draws = random_heads(part, components, samples=samples, seed=seed)
    settings = SpecificitySettings(seed=seed)
    found = specificity(draws, real, rest=part.rest, triangles=part.triangles, settings=settings)
    return found.distance_mm.reshape(len(components), samples).T


_prepared: HeadDatabase | None = None  # of a worker process


def _in_processes(draws: Iterable[np.ndarray], database: tuple[Any, ...], workers: int) -> list[Nearest]:
    """Nearest heads in the order of the draws, of which only a few batches are in memory."""
    found: list[Nearest] = []
    pending: deque[Future[list[Nearest]]] = deque()
    remaining = iter(draws)
    # Not forked: a copy of a process with threads, such as those of torch, may hang.
    with ProcessPoolExecutor(workers, get_context("spawn"), initializer=_prepare, initargs=database) as pool:
        while batch := list(islice(remaining, _BATCH)):
            pending.append(pool.submit(_nearest, batch))
            if len(pending) > 2 * workers:
                found += pending.popleft().result()
        for future in pending:
            found += future.result()
    return found


def _prepare(*database: Any) -> None:
    global _prepared
    _prepared = HeadDatabase(*database)


def _nearest(draws: list[np.ndarray]) -> list[Nearest]:
    assert _prepared is not None
    return [_prepared.nearest(draw) for draw in draws]
