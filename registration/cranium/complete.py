"""Cranium completion: hidden skin of the cranium from the auxiliary model, everything else as registered."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from registration.cranium.auxiliary_model import CraniumModel
from registration.cranium.conditional import patch_areas, predict
from registration.cranium.deformation import band_weights, deform
from registration.geometry.topology import edges
from registration.model import regions
from registration.model.gnm_npz import GNMData


@dataclass(frozen=True, kw_only=True)
class CraniumSettings:
    """What counts as hidden, and how the completed cranium joins the registered skin.

    Attributes:
        min_confidence: skin with at least this confidence is observed and stays as it is.
        min_area_cm2: hidden patches of the cranium that are smaller stay as they are registered.
        band_mm: width of the band inside the hidden skin in which the registered skin passes into the predicted head.
        length_mm: over which a step between both is spread.
        expression_mm: displacement by the expression at which skin says half as much of the person.
    """

    min_confidence: float = 0.1
    min_area_cm2: float = 20.0
    band_mm: float = 35.0
    length_mm: float = 15.0
    expression_mm: float = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class CompletedCranium:
    """A head with its hidden cranium completed. Metres, the frame of the registered head."""

    vertices: Float[np.ndarray, "V 3"]
    hidden: Bool[np.ndarray, "V"]  # the skin that was completed; the rest is as it was
    weights: Float[np.ndarray, "V"]  # 0 at the border of the hidden skin, 1 where the predicted head alone counts
    deviation: Float[np.ndarray, "V"]  # posterior standard deviation of the predicted head


class CraniumCompletion:
    """Completes heads of one topology.

    Args:
        data: the head model.
        model: the auxiliary model of its topology.
        settings: of the completion.
    """

    def __init__(self, data: GNMData, model: CraniumModel, settings: CraniumSettings = CraniumSettings()):  # noqa: B008
        self._model, self._settings = model, settings
        self._triangles = data.triangles
        self._cranium, self._neck = regions.cranium(data), regions.neck_other(data)
        self._exterior = regions.exterior(data)
        self._patches = patch_areas(model.mean, data.triangles)

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        a, b = edges(self._triangles).vertices.T
        return a, b

    def hidden(self, confidence: Float[np.ndarray, "V"]) -> Bool[np.ndarray, "V"]:
        """Return the hidden skin: connected patches of low confidence with enough of the cranium in them.

        Neck in such a patch belongs to it: its place is that of the registration, and it joins smoothly.
        """
        low = (confidence < self._settings.min_confidence) & (self._cranium | (self._neck & self._exterior))
        a, b = self._edges
        inside = low[a] & low[b]
        graph = coo_matrix((np.ones(inside.sum()), (a[inside], b[inside])), shape=2 * (len(low),))
        patch = connected_components(graph, directed=False)[1]
        area = np.bincount(patch, self._patches * (low & self._cranium))
        return low & (area >= self._settings.min_area_cm2)[patch]

    def __call__(
        self,
        head: Float[np.ndarray, "V 3"],
        confidence: Float[np.ndarray, "V"],
        expression_m: Float[np.ndarray, "V"] | None = None,
    ) -> CompletedCranium | None:
        """Complete a head, or return None if enough of its cranium is observed.

        Args:
            head: registered, in any pose, of metric size; metres.
            confidence: of its vertices.
            expression_m: how far an expression displaces each vertex, metres: such skin says less of the person.
                None: the face is neutral.
        """
        hidden = self.hidden(confidence)
        if not hidden.any():
            return None
        settings = self._settings
        seen = self._exterior & ~self._neck & (confidence >= settings.min_confidence)
        patches = np.where(seen, self._patches, 0.0)
        if expression_m is not None:
            patches = patches / (1 + np.square(1000 * expression_m / settings.expression_mm))
        predicted = predict(self._model, head, patches)
        weights = band_weights(predicted.vertices, self._triangles, hidden, settings.band_mm / 1000)
        displacement = head - predicted.vertices
        displacement[hidden & self._cranium] = 0.0
        length_m = settings.length_mm / 1000
        found = deform(predicted.vertices, self._triangles, displacement, weights, hidden, length_m=length_m)
        vertices = np.where(hidden[:, None], predicted.vertices + found, head)
        return CompletedCranium(vertices=vertices, hidden=hidden, weights=weights, deviation=predicted.deviation)
