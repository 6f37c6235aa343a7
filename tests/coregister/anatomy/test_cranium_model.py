"""The auxiliary model built from heads, and the heads read from files."""

import numpy as np
import pytest

from coregister.anatomy.cranium_model import build_cranium_model, under_hair
from coregister.anatomy.head_meshes import read_heads
from registration.cranium.conditional import patch_areas, predict
from registration.errors import InputError
from registration.model import regions
from registration.storage.mesh import write_ply
from tests.registration.cranium.smooth_heads import auxiliary_model, smooth_heads, tiny

HAIR = under_hair(tiny())


def test_leave_one_out_chooses_the_true_rank_and_the_smaller_noise():
    """Six fields, and their mirror images."""
    model = auxiliary_model()
    assert model.rank == 12 and model.noise == pytest.approx(1e-4) and len(model.tried_errors) == 4


def test_the_leave_one_out_error_is_that_of_models_built_without_the_head():
    data, heads = tiny(), smooth_heads(31, 3)
    model = build_cranium_model(data, heads, seed=0, source="waves", ranks=(4,), noises_mm=(1.0,))
    errors = []
    area = patch_areas(model.mean, data.triangles)
    seen = area * ~HAIR * regions.head_skin(data)
    for index in range(0, 31, 6):
        others = build_cranium_model(
            data,
            np.delete(np.concatenate([heads, heads[-1:]]), [index, 31], 0),
            seed=0,
            source="",
            ranks=(4,),
            noises_mm=(1.0,),
        )
        left = np.square(predict(others, heads[index], seen).vertices - heads[index]).sum(1)
        errors.append(area[HAIR] @ left[HAIR] / area[HAIR].sum())
    assert np.sqrt(np.mean(errors)) == pytest.approx(model.tried_errors[0], rel=0.5)


def test_too_few_heads_are_refused():
    with pytest.raises(InputError) as error:
        build_cranium_model(tiny(), smooth_heads(29, 0), seed=0, source="here")
    assert error.value.got == "29" and "at least 30" in error.value.expected


def test_heads_in_files(tmp_path):
    data, heads = tiny(), smooth_heads(2, 0)
    for index, head in enumerate(heads):
        write_ply(tmp_path / f"{index}.ply", head, data.quads if index else data.triangles)
    np.testing.assert_allclose(read_heads(tmp_path, data), heads, atol=1e-7)


@pytest.mark.parametrize(
    ("spoil", "what", "got"),
    [
        ("scalp", "open scalp", "% of the cranium's area has no triangles"),
        ("fewer", "another topology", "vertices"),
        ("other", "another topology", "lack edges"),
        ("millimetres", "size", "m"),
        ("damaged", "cannot be read", ""),
        ("empty", "no head", "empty folder"),
    ],
)
def test_heads_that_are_refused(spoil, what, got, tmp_path):
    data, head = tiny(), smooth_heads(1, 0)[0]
    triangles = data.triangles
    if spoil == "scalp":
        triangles = triangles[~(HAIR & (head[:, 1] > np.quantile(head[HAIR, 1], 0.5)))[triangles].any(1)]
    elif spoil == "fewer":
        head, triangles = head[:-1], triangles[(triangles < len(head) - 1).all(1)]
    elif spoil == "other":
        triangles = triangles[: len(triangles) * 3 // 4] if HAIR[triangles[-1]].any() else triangles[:-40]
    elif spoil == "millimetres":
        head = head * 1000
    if spoil != "empty":
        write_ply(tmp_path / "head.ply", head, triangles)
    if spoil == "damaged":
        (tmp_path / "head.ply").write_bytes((tmp_path / "head.ply").read_bytes()[:-9])
    with pytest.raises(InputError) as error:
        read_heads(tmp_path, data)
    assert what in error.value.what and got in error.value.got


def test_heads_of_a_small_span_give_a_model_of_no_higher_rank():
    """Such as registrations of a model with few components."""
    data = tiny()
    weights = np.random.default_rng(0).normal(size=(40, len(data.vertex_identity_basis)))
    heads = data.template_vertex_positions + np.tensordot(weights, data.vertex_identity_basis, 1)
    model = build_cranium_model(data, heads, seed=0, source="the model")
    assert 4 <= model.rank < 20 and model.tried_errors.min() < 1e-3
