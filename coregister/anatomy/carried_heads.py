"""Heads of one topology, carried to another by a map between the two models."""

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.topology_map.landmarked import LandmarkedMesh
from registration.topology_map.make import MapSettings, map_topologies


def carry_heads(
    heads: Float[np.ndarray, "N A 3"],
    source: LandmarkedMesh,
    target: LandmarkedMesh,
    settings: MapSettings | None = None,
) -> Float[np.ndarray, "N V 3"]:
    """Return heads of the source's topology in the target's, as large and turned as the target.

    Args:
        heads: metres, turned as the source.
        source: the model of their topology.
        target: the model that they are carried to.
        settings: of the map.

    Raises:
        InputError: the meshes have too few landmarks in common, or their map is refused.
    """
    mapped = map_topologies(source, target, settings)
    if not mapped.accepted:
        raise InputError(
            "Heads cannot be carried to the model's topology",
            where=target.name,
            expected=f"an accepted map from {source.name}",
            got="; ".join(mapped.reasons),
            fix="give heads of the model's topology, or look at the picture of `gnmreg model map`",
        )
    return (mapped.place(heads) - mapped.translation) @ mapped.rotation / mapped.scale
