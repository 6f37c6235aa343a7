import numpy as np
import pytest

from coregister.sampler.categories import Factor
from coregister.sampler.decoder import Decoder, Sampler
from coregister.sampler.penetration import AUDITED, LIMIT_MM, PERCENTILE, HeadMaker, limit_mm, training_depths_mm
from coregister.sampler.samples import CoefficientSet
from coregister.sampler.sampling import MAX_REDRAWS, SampleSettings, draw_heads
from registration.errors import InputError
from registration.model import gnm_npz
from tests.conftest import FIXTURES

GENDER = Factor(name="gender", categories=("female", "male"))
ACTS = Factor(name="expression", categories=("closed", "open"))


@pytest.fixture(scope="module")
def maker() -> HeadMaker:
    return HeadMaker(gnm_npz.read(FIXTURES / "tiny_gnm.npz"))


def decoder(factors: tuple[Factor, ...], size: int, seed: int = 0) -> Decoder:
    """A linear decoder: a random map of the latent vector and of the conditions."""
    rng = np.random.default_rng(seed)
    inputs = 3 + sum(len(factor.categories) for factor in factors)
    kernel = 0.2 * rng.normal(size=(inputs, size)).astype(np.float32)
    return Decoder(factors=factors, layers=((kernel, np.zeros(size, np.float32)),), offset=np.zeros(size, np.float32))


@pytest.fixture(scope="module")
def sampler(maker: HeadMaker) -> Sampler:
    sizes = len(maker.data.vertex_identity_basis), len(maker.data.expression_basis)
    decoders = {"identity": decoder((GENDER,), sizes[0]), "expression": decoder((ACTS,), sizes[1], 1)}
    return Sampler(decoders=decoders)


def test_equal_seeds_give_equal_heads_and_more_heads_begin_with_the_same(maker, sampler):
    wanted = {"gender": "female", "expression": "open=0.5,closed=0.5"}
    settings = SampleSettings(wanted=wanted, count=2, seed=3, audit=False)
    first, second = draw_heads(sampler, maker, settings), draw_heads(sampler, maker, settings)
    more = draw_heads(sampler, maker, SampleSettings(wanted=wanted, count=4, seed=3, audit=False))
    for a, b, c in zip(first.heads, second.heads, more.heads, strict=False):
        assert np.array_equal(a.identity, b.identity) and np.array_equal(a.expression, b.expression)
        assert np.array_equal(a.identity, c.identity)
    assert first.heads[0].categories["expression"] == {"open": 0.5, "closed": 0.5}
    assert not np.array_equal(more.heads[0].identity, more.heads[1].identity)


def test_what_is_not_asked_for_is_random_or_neutral(maker, sampler):
    drawn = draw_heads(sampler, maker, SampleSettings(wanted={}, count=12, audit=False))
    genders = {next(iter(head.categories["gender"])) for head in drawn.heads}
    assert genders == {"female", "male"}
    assert all(not head.expression.any() and "expression" not in head.categories for head in drawn.heads)


def test_heads_that_penetrate_are_drawn_again_and_counted(maker, sampler, monkeypatch):
    depths = iter([LIMIT_MM + 1, LIMIT_MM + 2, 0.5, 0.0])
    monkeypatch.setattr(maker, "depth_mm", lambda vertices: next(depths))
    drawn = draw_heads(sampler, maker, SampleSettings(wanted={"expression": "open"}, count=2))
    assert [head.redrawn for head in drawn.heads] == [2, 0]
    assert (drawn.first_penetrating, drawn.redrawn) == (1, 2)
    assert (drawn.heads[0].depth_mm, drawn.heads[0].first_depth_mm) == (0.5, LIMIT_MM + 1)


def test_a_head_that_always_penetrates_is_the_least_deep_one_and_says_so(maker, sampler, monkeypatch):
    depths = iter([5.0, 3.0, *([9.0] * MAX_REDRAWS)])
    monkeypatch.setattr(maker, "depth_mm", lambda vertices: next(depths))
    (head,) = draw_heads(sampler, maker, SampleSettings(wanted={"expression": "open"}, count=1)).heads
    assert head.penetrates
    assert (head.depth_mm, head.redrawn) == (3.0, MAX_REDRAWS)


def test_the_audit_of_a_head_is_that_of_the_template_at_rest(maker):
    rest = maker.vertices(np.zeros(len(maker.data.vertex_identity_basis)), np.zeros(len(maker.data.expression_basis)))
    np.testing.assert_allclose(rest, maker.data.template_vertex_positions, atol=1e-7)
    assert maker.depth_mm(rest) == 0


def test_categories_whose_training_samples_penetrate_may_do_so():
    assert limit_mm({}, {"closed": 3.0}) == LIMIT_MM
    assert limit_mm({"closed": 0.2, "open": 0.8}, {"closed": 3.0, "open": 0.1}) == 3.0
    assert limit_mm({"closed": 0.0, "open": 1.0}, {"closed": 3.0, "open": 0.1}) == LIMIT_MM


def test_training_samples_are_audited_with_their_own_identities(maker, monkeypatch):
    """Depths that their identities determine, evenly distributed: a sample in twenty is deeper than the depth found."""
    count = 2 * AUDITED
    depth = np.arange(count) // 2 + np.arange(count) % 2 * 1000.0  # closed 0, 1, ...; open 1000, 1001, ...
    identities = np.zeros((count, len(maker.data.vertex_identity_basis)), np.float32)
    identities[:, 0] = depth
    samples = CoefficientSet(
        coefficients=np.zeros((count, len(maker.data.expression_basis)), np.float32),
        categories=(np.arange(count) % 2)[:, None],
        factors=(ACTS,),
        subjects=tuple(str(k) for k in range(count)),
        identities=identities,
    )
    monkeypatch.setattr(maker, "vertices", lambda identity, expression: identity)
    monkeypatch.setattr(maker, "depth_mm", lambda vertices: float(vertices[0]))
    found = training_depths_mm(maker, samples, 0)
    expected = PERCENTILE / 100 * (AUDITED + 1) - 1
    assert found == pytest.approx({"closed": expected, "open": 1000 + expected})
    few = training_depths_mm(maker, samples.rows(np.arange(count) < 4), 0)
    assert few == {"closed": 1.0, "open": 1001.0}


def test_an_identity_that_does_not_fit_is_left_out_unless_it_is_asked_for(maker, sampler):
    other = Sampler(decoders={**sampler.decoders, "identity": decoder((GENDER,), 253)})
    drawn = draw_heads(other, maker, SampleSettings(wanted={"expression": "open"}, count=1, audit=False))
    assert "253 coefficients of the identity do not fit" in drawn.remarks[0]
    assert not drawn.heads[0].identity.any()
    with pytest.raises(InputError, match="do not fit the model"):
        draw_heads(other, maker, SampleSettings(wanted={"gender": "female"}, count=1))


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        (SampleSettings(wanted={}, count=0), "--count"),
        (SampleSettings(wanted={}, seed=-1), "--seed"),
        (SampleSettings(wanted={"age": "20-29"}), "gender, expression"),
        (SampleSettings(wanted={"expression": "smile"}), "closed, open"),
    ],
)
def test_what_the_sampler_lacks_is_refused_with_what_it_has(maker, sampler, settings, found):
    with pytest.raises(InputError) as caught:
        draw_heads(sampler, maker, settings)
    assert found in str(caught.value)
