"""How deep a drawn head's parts lie inside one another, and how deep is too deep."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from coregister.sampler.samples import CoefficientSet
from registration.evaluate.audit import audit_penetration
from registration.model.gnm_npz import GNMData
from registration.progress import NullProgress, Progress

LIMIT_MM = 1.0  # of excess depth: vertices that are less deep than this are not seen
AUDITED = 60  # training samples of each expression category
PERCENTILE = 95  # of their depths; the deepest one alone is a matter of chance


class HeadMaker:
    """Vertices of a model's heads in the rest pose."""

    def __init__(self, data: GNMData):
        self.data = data
        self._identity = _rows(data.vertex_identity_basis)
        self._expression = _rows(data.expression_basis)

    def vertices(
        self, identity: Float[np.ndarray, "I"], expression: Float[np.ndarray, "E"]
    ) -> Float[np.ndarray, "V 3"]:
        """Return the vertices of coefficients, metres, the model's frame."""
        moved = identity.astype(np.float32) @ self._identity + expression.astype(np.float32) @ self._expression
        return np.asarray(self.data.template_vertex_positions + moved.reshape(-1, 3))

    def depth_mm(self, vertices: Float[np.ndarray, "V 3"]) -> float:
        """Return the largest depth of a vertex inside another part beyond the template's, by the penetration audit."""
        audit = audit_penetration(vertices, self.data)
        return max((float(pair.excess_mm.max(initial=0.0)) for pair in audit.pairs), default=0.0)


def training_depths_mm(
    maker: HeadMaker, expressions: CoefficientSet, seed: int, progress: Progress | None = None
) -> dict[str, float]:
    """Return how deep the training samples of each expression category penetrate, with their own identities.

    Expressions such as pressed lips penetrate in registrations and in face rigs too; a sampler that was trained on them
    does no better.

    Args:
        maker: of the model.
        expressions: training samples whose first factor is the expression, with identities.
        seed: of the choice of samples.
        progress: receives the categories.

    Returns:
        Category -> the depth in mm that another sample of its distribution exceeds with a chance of
        100 - `PERCENTILE` percent [Hyndman 1996, definition 6]; the deepest sample where there are too few.
    """
    progress = progress or NullProgress()
    names = expressions.factors[0].categories
    found = {}
    for number, name in enumerate(names):
        progress.update(number, len(names), "auditing the training samples' penetration")
        depths = depths_mm(maker, expressions, name, AUDITED, np.random.default_rng([29, seed, number]))
        found[name] = float(np.percentile(depths, PERCENTILE, method="weibull")) if len(depths) else 0.0
    return found


def depths_mm(
    maker: HeadMaker, expressions: CoefficientSet, category: str, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "N"]:
    """Return how deep random samples of a category penetrate with their own identities, mm; at most `count`."""
    identities = expressions.identities
    if identities is None:
        raise ValueError("expressions without identities")
    number = expressions.factors[0].categories.index(category)
    rows = rng.permutation(np.flatnonzero(expressions.categories[:, 0] == number))[:count]
    heads = (maker.vertices(identities[row], expressions.coefficients[row]) for row in rows)
    return np.array([maker.depth_mm(head) for head in heads])


def limit_mm(weights: Mapping[str, float], training_mm: Mapping[str, float]) -> float:
    """Return the depth beyond which a sample of these expression categories is drawn again.

    Args:
        weights: category -> its weight; empty: no expression.
        training_mm: depths of training samples by category; empty: unknown.
    """
    return max([LIMIT_MM, *(training_mm.get(name, 0.0) for name, weight in weights.items() if weight > 0)])


def _rows(basis: np.ndarray) -> Float[np.ndarray, "K D"]:
    return np.asarray(basis, np.float32).reshape(len(basis), -1)
