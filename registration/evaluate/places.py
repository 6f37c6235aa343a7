"""Places of the head by the names that a reader of a report looks for."""

import numpy as np
from jaxtyping import Bool

from registration.model import regions
from registration.model.gnm_npz import GNMData


def fine_places(data: GNMData) -> dict[str, Bool[np.ndarray, "V"]]:
    """Return eyes, mouth, nostrils and ears, whose skin is thin, turns sharply, and carries small faces."""
    own, left = regions.offset_regions(data), data.template_vertex_positions[:, 0] > 0
    sides = {"left": left, "right": ~left}
    return {
        **{f"{side} eye": own["lids"] & half for side, half in sides.items()},
        "mouth": own["lips"],
        "nostrils": own["nostrils"],
        **{f"{side} ear": own["ears"] & half for side, half in sides.items()},
    }


def named_places(data: GNMData) -> dict[str, Bool[np.ndarray, "V"]]:
    """Return places that cover the whole skin. They overlap: what is in several belongs to the first of them."""
    fine = fine_places(data)
    del fine["nostrils"]  # a part of the nose
    return {
        **fine,
        "nose": regions.common_face(data)["nose"],
        "neck": regions.neck_other(data),
        "skin of the head": np.ones(len(data.template_vertex_positions), bool),
    }
