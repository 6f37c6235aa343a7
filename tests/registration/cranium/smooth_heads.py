"""Heads of the small model's topology whose shape is a few smooth fields: the face determines the rest."""

from functools import cache

import numpy as np
from jaxtyping import Float

from coregister.anatomy.cranium_model import build_cranium_model
from registration.cranium.auxiliary_model import CraniumModel
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from tests.conftest import FIXTURES

FIELDS_MM = (1.5, 1.2, 1.0, 0.8, 0.5, 0.3)


@cache
def tiny() -> GNMData:
    return gnm_npz.read(FIXTURES / "tiny_gnm.npz")


def smooth_heads(count: int, seed: int) -> Float[np.ndarray, "N V 3"]:
    """The template displaced by waves of half a head's length with random amplitudes."""
    template = tiny().template_vertex_positions.astype(np.float64)
    waves, rng = np.random.default_rng(5), np.random.default_rng(seed)
    phase = template @ waves.normal(0, 15, (3, len(FIELDS_MM))) + waves.uniform(0, 6, len(FIELDS_MM))
    fields = np.sin(phase).T[:, :, None] * waves.normal(size=(len(FIELDS_MM), 1, 3))
    weights = rng.normal(size=(count, len(FIELDS_MM))) * np.array(FIELDS_MM) / 1000
    return template + np.tensordot(weights, fields, 1)


@cache
def auxiliary_model() -> CraniumModel:
    return build_cranium_model(tiny(), smooth_heads(40, 0), seed=0, source="waves", ranks=(3, 12), noises_mm=(0.1, 3.0))
