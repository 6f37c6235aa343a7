"""Audit of sharp folds of the outer skin: how many there are, where, and which view shows them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.evaluate.names import SHARP_FOLD_DEG
from registration.evaluate.places import named_places
from registration.evaluate.viewpoint import best_view
from registration.geometry.folds import Creases
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.types import Camera


def fold_figures(vertices: Float[np.ndarray, "V 3"], data: GNMData, cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """Count the edges of the outer skin at which it turns back on itself, as the template does not (docs/formats.md).

    Args:
        vertices: world, metres, in the model's topology.
        data: the model.
        cameras: of the views that may be named.

    Returns:
        The entry of the manifest: the number of edges, and of each place that has any its own and the view to look at.

    Raises:
        InputError: the skin is not a manifold.
    """
    mesh, rest = vertices.astype(np.float64), data.template_vertex_positions
    sharp = Creases.of(data.triangles, rest, regions.exterior(data)).sharp(mesh, SHARP_FOLD_DEG)
    remaining, places = np.ones(len(sharp), bool), {}
    for name, members in named_places(data).items():
        here = members[sharp].any(1) & remaining
        remaining &= ~here
        if here.any():
            view = best_view(mesh[np.unique(sharp[here])], mesh.mean(0), cameras)
            places[name] = {"edges": int(here.sum()), "view": view}
    return {"edges": len(sharp), "places": places}
