"""Fills of a hidden cranium, and how far they are from the truth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_matrix

from coregister.anatomy.cranium_model import under_hair
from coregister.next_model.completion import CompletionSettings, MissingDataCompletion
from registration.cranium.auxiliary_model import CraniumModel
from registration.cranium.complete import CompletedCranium, CraniumCompletion, CraniumSettings
from registration.frames import MM_PER_M
from registration.geometry import rigid
from registration.geometry.extrapolation import extrapolate
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData

Fill = Callable[[Float[np.ndarray, "V 3"], Float[np.ndarray, "V"]], Float[np.ndarray, "V 3"]]
_FAR_M = 100.0  # a decay so long that the extrapolation is harmonic
MODEL = "auxiliary model"


def fills(data: GNMData, model: CraniumModel) -> Mapping[str, Fill]:
    """Return, by name, functions of a head and its confidence that return the head with its hidden cranium filled."""
    complete = CraniumCompletion(data, model)
    previous = MissingDataCompletion(data, data.vertex_identity_basis, CompletionSettings())
    observable = regions.head_skin(data)
    area = vertex_areas(model.mean, data.triangles)
    template = data.template_vertex_positions.astype(np.float64)

    def placed(mean: np.ndarray, head: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        seen = area * (observable & (confidence >= CraniumSettings().min_confidence))
        T = rigid.align(mean[None], head, seen[None])[0]
        return mean @ T[:3, :3].T + T[:3, 3]

    def by_model(head: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        completed = complete(head, confidence)
        return head if completed is None else completed.vertices

    def of_mean(head: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        hidden = complete.hidden(confidence)[:, None]
        return np.where(hidden, placed(model.mean, head, confidence), head)

    def laplacian(head: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        mean, seen = placed(model.mean, head, confidence), ~complete.hidden(confidence)
        return mean + extrapolate(head - mean, seen, data.triangles, mean, reach_m=_FAR_M)

    def of_builds(head: np.ndarray, confidence: np.ndarray) -> np.ndarray:
        hidden = complete.hidden(confidence)
        seen = area * (observable & ~hidden)
        T = rigid.align(head[None], template, seen[None])[0]
        local = head @ T[:3, :3].T + T[:3, 3]
        found = template + previous(local - template, np.where(hidden, 0.0, 1.0))
        return np.where(hidden[:, None], (found - T[:3, 3]) @ T[:3, :3], head)

    return {"mean head": of_mean, "Laplacian": laplacian, "previous model": of_builds, MODEL: by_model}


@dataclass(frozen=True, kw_only=True)
class CraniumError:
    """How far a filled head is from the truth."""

    cranium_mm: float  # mean distance of corresponding vertices under the hair, by area
    across_mm: float  # the same, along the truth's normals
    curvature: float  # 95th percentile in the band, 1/m
    true_curvature: float


class CraniumMeasure:
    """Measures filled heads of one topology.

    Args:
        data: the head model.
        hidden: the vertices that were filled.
        band: of these, those in which the fill joins the registered skin, with the skin beside them.
    """

    def __init__(self, data: GNMData, hidden: Bool[np.ndarray, "V"], band: Bool[np.ndarray, "V"]):
        self._triangles, self._rows, self._band = data.triangles, hidden & under_hair(data), band

    @classmethod
    def of(cls, data: GNMData, completed: CompletedCranium) -> "CraniumMeasure":
        """Return the measure for the skin that was completed in a head, and other heads that hide the same."""
        near = np.zeros(len(completed.hidden), bool)
        near[data.triangles[completed.hidden[data.triangles].any(1)]] = True
        return cls(data, completed.hidden, near & (completed.weights < 1))

    def __call__(self, filled: Float[np.ndarray, "V 3"], truth: Float[np.ndarray, "V 3"]) -> CraniumError:
        area = vertex_areas(truth, self._triangles)[self._rows]
        difference = (filled - truth)[self._rows] * MM_PER_M
        _, normals = mean_curvature(truth, self._triangles)
        across = np.abs((difference * normals[self._rows]).sum(1))
        curvature, true = (np.abs(mean_curvature(v, self._triangles)[0])[self._band] for v in (filled, truth))
        return CraniumError(
            cranium_mm=float(np.average(np.linalg.norm(difference, axis=1), weights=area)),
            across_mm=float(np.average(across, weights=area)),
            curvature=float(np.percentile(curvature, 95)),
            true_curvature=float(np.percentile(true, 95)),
        )


def mean_curvature(
    vertices: Float[np.ndarray, "V 3"], triangles: np.ndarray
) -> tuple[Float[np.ndarray, "V"], Float[np.ndarray, "V 3"]]:
    """Return the mean curvature (1/m, positive where convex) by cotangent weights, and unit normals by area."""
    count = len(vertices)
    corners = [vertices[triangles[:, k]] for k in range(3)]
    rows, columns, weights = [], [], []
    for k in range(3):
        b, c = triangles[:, (k + 1) % 3], triangles[:, (k + 2) % 3]
        u, v = corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k]
        cotangent = (u * v).sum(1) / np.maximum(np.linalg.norm(np.cross(u, v), axis=1), 1e-15) / 2
        rows += [b, c]
        columns += [c, b]
        weights += [cotangent, cotangent]
    shape = (count, count)
    stiffness = coo_matrix((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape).tocsr()
    degree = np.asarray(stiffness.sum(1)).ravel()
    area = np.maximum(vertex_areas(vertices, triangles), 1e-15)
    vector = (degree[:, None] * vertices - stiffness @ vertices) / (2 * area[:, None])
    face = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normals = np.zeros((count, 3))
    for k in range(3):
        np.add.at(normals, triangles[:, k], face)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
    return (vector * normals).sum(1), normals
