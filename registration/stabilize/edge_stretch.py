"""How far dropping a component stretches the mesh: it is removed in its region, and the skin around keeps moving."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from registration.frames import MM_PER_M
from registration.geometry.topology import edges
from registration.stabilize.components import HeadGeometry, RegionalComponents
from registration.stabilize.decisions import dropped_displacement

TORN_RATIO, TORN_MM = 1.5, 0.5  # a torn edge is this many times as long as it should be, and this much longer


@dataclass(frozen=True, kw_only=True)
class EdgeStretch:
    """Edges of the exterior skin after a component is dropped, in the samples where it is strongest.

    An edge is compared with its length before, or in the template if that is longer.
    """

    ratio: float  # of the edge that is stretched most; at least 1
    longer_mm: float  # of that edge
    torn: Int[np.ndarray, "N 2"]  # vertices of the torn edges

    @property
    def tears(self) -> bool:
        """Whether any edge is torn."""
        return len(self.torn) > 0


def skin_edges(head: HeadGeometry) -> Int[np.ndarray, "E 2"]:
    """Return the edges of the exterior skin, as pairs of vertices."""
    outside = head.area > 0
    return edges(head.data.triangles[outside[head.data.triangles].all(1)]).vertices


def drop_stretch(
    part: RegionalComponents,
    component: int,
    mean_displacement: Mapping[str, Float[np.ndarray, "K V 3"]],
    head: HeadGeometry,
    pairs: Int[np.ndarray, "E 2"],
) -> EdgeStretch:
    """Measure the edges after dropping a component, in the two samples with its extreme coefficients.

    Args:
        part: components of a region.
        component: number of the component, from 0.
        mean_displacement: of the whole head along with each component, by region, metres per unit coefficient.
        head: the template.
        pairs: as `skin_edges` returns them.
    """
    along = mean_displacement[part.region][component].astype(np.float64)
    dropped = dropped_displacement(part, component, head)
    coefficients = part.coefficients[:, component]
    template = _lengths(head.points, pairs)
    ratio, longer, torn = np.ones(len(pairs)), np.zeros(len(pairs)), np.zeros(len(pairs), bool)
    for coefficient in (coefficients.min(initial=0.0), coefficients.max(initial=0.0)):
        before = head.points + coefficient * along
        due = np.maximum(template, _lengths(before, pairs))
        after = _lengths(before - coefficient * dropped, pairs)
        longer = np.maximum(longer, MM_PER_M * (after - due))
        ratio = np.maximum(ratio, after / np.maximum(due, 1e-9))
        torn |= (after > TORN_RATIO * due) & (MM_PER_M * (after - due) > TORN_MM)
    worst = int(np.where(torn, ratio, 0).argmax() if torn.any() else ratio.argmax())
    return EdgeStretch(ratio=float(ratio[worst]), longer_mm=float(longer[worst]), torn=pairs[torn])


def _lengths(points: Float[np.ndarray, "V 3"], pairs: Int[np.ndarray, "E 2"]) -> Float[np.ndarray, "E"]:
    return np.asarray(np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1))
