"""Heads that are carried to a model of another topology."""

from dataclasses import replace

import numpy as np
import pytest

from coregister.anatomy.carried_heads import carry_heads
from registration.errors import InputError
from registration.topology_map.landmarked import LandmarkedMesh
from tests.registration.cranium.smooth_heads import smooth_heads
from tests.registration.topology_map.small_map import QUICK, pair


def renumbered(mesh: LandmarkedMesh, order: np.ndarray) -> LandmarkedMesh:
    """The same mesh with its vertices in another order: new vertex k is old vertex order[k]."""
    new = np.argsort(order)
    schemes = {name: replace(scheme, indices=new[scheme.indices]) for name, scheme in mesh.schemes.items()}
    return replace(
        mesh,
        vertices=1.2 * mesh.vertices[order] + [0, 0.1, 0],
        triangles=new[mesh.triangles],
        schemes=schemes,
        members=mesh.members[order],
        whole=mesh.whole[order],
        parts={name: part[order] for name, part in mesh.parts.items()},
    )


def test_heads_are_carried_in_the_size_of_the_model():
    source = pair().source
    order = np.random.default_rng(0).permutation(len(source.vertices))
    heads = smooth_heads(3, 0)
    carried = carry_heads(heads, source, renumbered(source, order), QUICK)
    truth = 1.2 * heads[:, order] + [0, 0.1, 0]
    error = np.linalg.norm(carried - truth, axis=2)
    assert error[:, source.skin[order]].mean() < 1e-4
    assert error.max() < 5e-3  # of teeth and tongue, which move with the skin around them


def test_a_refused_map_carries_nothing():
    source = pair().source
    with pytest.raises(InputError, match="cannot be carried") as caught:
        carry_heads(smooth_heads(1, 0), source, pair().target, replace(QUICK, least_covered=2.0))
    assert "outer surface" in caught.value.got
