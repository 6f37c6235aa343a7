"""Which view shows a place of the head best, for remarks that send the reader to a picture."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.evaluate.audit import PenetrationAudit
from registration.types import Camera


def best_view(
    points: Float[np.ndarray, "P 3"], centre: Float[np.ndarray, "3"], cameras: Mapping[str, Camera]
) -> str | None:
    """Return the view that looks most directly at a place on the outside of the head.

    Args:
        points: of the place; world, metres.
        centre: of the head.
        cameras: of the views, by name.

    Returns:
        A view in whose image the place lies; None if there is none.
    """
    place = points.mean(0)
    outward = place - centre
    best, best_cosine = None, -np.inf
    for name, camera in cameras.items():
        (x, y), depth = (values[0] for values in camera.project(place[None]))
        if depth <= 0 or not (0 <= x < camera.width_px and 0 <= y < camera.height_px):
            continue
        ray = camera.centre - place
        cosine = float(outward @ ray / (np.linalg.norm(outward) * np.linalg.norm(ray) + 1e-12))
        if cosine > best_cosine:
            best, best_cosine = name, cosine
    return best


def intersection_figures(
    audit: PenetrationAudit, vertices: Float[np.ndarray, "V 3"], cameras: Mapping[str, Camera]
) -> dict[str, Any]:
    """Return an audit's entry of the manifest, with the view that shows each intersection best.

    Args:
        audit: of the vertices.
        vertices: world, metres.
        cameras: of the views that may be named.
    """
    figures, mesh = audit.metrics, vertices.astype(np.float64)
    for pair in audit.pairs:
        if len(pair.beyond):
            figures["pairs"][pair.name]["view"] = best_view(mesh[pair.beyond], mesh.mean(0), cameras)
    return figures
