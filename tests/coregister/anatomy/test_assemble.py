"""Models with regenerated parts: layout, names, what is kept, and what is written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coregister.anatomy.assemble import AnatomySettings, expression_order, identity_order, manifest, regenerate
from coregister.anatomy.eyes import EyeSettings
from coregister.anatomy.teeth import TeethSettings
from coregister.anatomy.tongue import TongueSettings
from registration.errors import InputError
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

EYES = AnatomySettings(parts=("eyes", "pupils"), eyes=EyeSettings(samples=300))


def test_eyes_and_pupils_are_replaced_and_the_rest_is_kept(any_model: GNMData) -> None:
    made = regenerate(any_model, EYES)
    data = made.data
    head = identity_order(any_model)["head"]
    assert data.identity_names.tolist() == [
        *any_model.identity_names[head].tolist(), "eye_000", "eye_001", "eye_002"
    ]  # fmt: skip
    assert np.array_equal(data.vertex_identity_basis[: len(head)], any_model.vertex_identity_basis[head])
    assert np.array_equal(data.joint_identity_basis[: len(head)], any_model.joint_identity_basis[head])
    assert not data.joint_identity_basis[len(head) :].any()
    assert data.expression_names.tolist() == any_model.expression_names.tolist()
    assert np.array_equal(data.expression_basis[:-1], any_model.expression_basis[:-1])
    moved = (data.template_vertex_positions != any_model.template_vertex_positions).any(1)
    assert not moved[~np.any(regions.eyeballs(data), axis=0)].any()
    assert made.anatomy["replaced"]["pupils"] == ["pupils_000"]
    assert made.anatomy["layout"]["eyes"] == 3


def test_regenerating_twice_changes_nothing_more(first_model: GNMData) -> None:
    once = regenerate(first_model, EYES).data
    twice = regenerate(once, EYES).data
    assert twice.identity_names.tolist() == once.identity_names.tolist()
    assert np.abs(twice.template_vertex_positions - once.template_vertex_positions).max() < 1e-6
    assert np.abs(twice.vertex_identity_basis - once.vertex_identity_basis).max() < 1e-6


def test_components_in_another_order_are_sorted(first_model: GNMData) -> None:
    rng = np.random.default_rng(0)
    identity = rng.permutation(len(first_model.identity_names))
    expression = rng.permutation(len(first_model.expression_names))
    shuffled = replace(
        first_model,
        identity_names=first_model.identity_names[identity],
        vertex_identity_basis=first_model.vertex_identity_basis[identity],
        joint_identity_basis=first_model.joint_identity_basis[identity],
        expression_names=first_model.expression_names[expression],
        expression_basis=first_model.expression_basis[expression],
    )
    data = regenerate(shuffled, replace(EYES, parts=("pupils",))).data
    assert data.identity_names.tolist()[-3:] == [n for n in shuffled.identity_names.tolist() if n.startswith("eye")]
    order = [name.rstrip("0123456789_") for name in data.expression_names.tolist()]
    regions_in_order = ["left_eye_region", "right_eye_region", "lower_face_region", "tongue_mean", "tongue", "pupils"]
    assert [name for name in dict.fromkeys(order) if name not in ("tongue", "tongue_mean")] == [
        name for name in regions_in_order if name not in ("tongue", "tongue_mean")
    ]
    assert list(expression_order(data)) == ["left_eye", "right_eye", "lower_face", "tongue", "pupils"]


@pytest.mark.slow
def test_all_parts_have_the_papers_layout(any_model: GNMData, tmp_path: Path) -> None:
    settings = AnatomySettings(
        eyes=EyeSettings(samples=300), teeth=TeethSettings(samples=40), tongue=TongueSettings(samples=40)
    )
    made = regenerate(any_model, settings)
    names = made.data.identity_names.tolist()
    eyes = names.index("eye_000")
    assert names[eyes : eyes + 3] == ["eye_000", "eye_001", "eye_002"] and names[eyes + 3] == "teeth_000"
    assert all(name.startswith("teeth_") for name in names[eyes + 3 :])
    expressions = made.data.expression_names.tolist()
    tongue = expressions.index("tongue_mean")
    assert expressions[-1] == "pupils_000" and expressions[tongue + 1] == "tongue_000"
    gnm_npz.write(made.data, tmp_path / "next.npz")
    content = manifest(made, any_model, settings)
    assert content["content_id"] == gnm_npz.content_hash(gnm_npz.read(tmp_path / "next.npz"))
    assert set(content["anatomy"]["parts"]) == {"eyes", "teeth", "tongue", "pupils"}
    for part in content["anatomy"]["parts"].values():
        assert {"samples", "rejected", "variance_kept", "components"} <= set(part)


@pytest.mark.parametrize(
    "settings",
    [
        AnatomySettings(parts=()),
        AnatomySettings(parts=("eyes", "eyes")),
        AnatomySettings(parts=("pupils",), seed=-1),
    ],
)
def test_no_or_repeated_parts_are_refused(first_model: GNMData, settings: AnatomySettings) -> None:
    with pytest.raises(InputError):
        regenerate(first_model, settings)
