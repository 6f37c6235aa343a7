import numpy as np
import pytest
import torch

from coregister.sampler.loss import KLSchedule, divergences, mix_up
from coregister.sampler.metrics import measure, squared_mmd
from coregister.sampler.networks import EXPRESSION_LAYERS, IDENTITY_LAYERS, Architecture, ConditionalVAE
from coregister.sampler.samples import CoefficientSet, coefficient_set, split_by_subject
from coregister.sampler.training import TrainingSettings, train
from registration.errors import InputError
from tests.coregister.sampler.made import factor_set

QUICK = TrainingSettings(steps=600, l1_weight=1.0, schedule=KLSchedule(warm_up=200, cycle=600))


@pytest.fixture(scope="module")
def split() -> tuple[CoefficientSet, CoefficientSet]:
    return split_by_subject(factor_set(), seed=0)


def test_networks_have_the_layers_of_the_paper():
    for layers, conditions in ((IDENTITY_LAYERS, 6), (EXPRESSION_LAYERS, 20)):
        network = ConditionalVAE(Architecture(coefficients=50, conditions=conditions, layers=layers))
        shapes = [tuple(p.shape) for n, p in network.named_parameters() if n.endswith("weight")]
        encoder = list(zip(layers, (50 + conditions, *layers), strict=False))
        mirrored = (*reversed(layers), 50)
        decoder = list(zip(mirrored, (64 + conditions, *mirrored), strict=False))
        assert shapes == [*encoder, (64, 64), (64, 64), *decoder]
        assert isinstance(network.decoder[-1], torch.nn.Linear)


def test_the_kl_weight_warms_up_in_cycles():
    schedule = KLSchedule()
    assert [schedule.at(step) for step in (0, 2000, 4000, 7999, 8000)] == [0.0, 0.025, 0.05, 0.05, 0.0]


def test_the_divergence_is_that_of_normal_distributions():
    mean, log_variance = torch.tensor([[1.0, -0.5]]), torch.tensor([[0.3, -1.0]])
    own = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    expected = torch.distributions.kl_divergence(own, torch.distributions.Normal(0.0, 1.0))[0]
    torch.testing.assert_close(divergences(mean, log_variance), expected)


def test_mixing_leaves_samples_of_one_condition_alone_and_mixes_others_in_step():
    x = torch.arange(8.0)[:, None]
    conditions = torch.eye(2)[[0, 0, 0, 0, 1, 1, 1, 1]]
    alone, _ = mix_up(x, conditions[[0] * 8], 0.2, torch.Generator().manual_seed(0))
    assert torch.equal(alone, x)
    x = conditions @ torch.tensor([[0.0], [10.0]])
    mixed, c = mix_up(x, conditions, 0.2, torch.Generator().manual_seed(0))
    torch.testing.assert_close(mixed, c @ torch.tensor([[0.0], [10.0]]))
    assert ((c > 0) & (c < 1)).any()


def test_draws_have_the_variance_and_the_classes_of_the_samples(split):
    samples, held_out = split
    trained = train(samples, held_out, (32, 16), QUICK)
    metrics = measure(trained, samples, held_out, seed=0)
    assert metrics.status == "trained"
    assert metrics.active_units >= 3
    assert metrics.accuracy["expression"] >= 0.95
    ratios = [found.variance_ratio for found in metrics.classes.values()]
    assert 0.7 < min(ratios) and max(ratios) < 1.3
    assert {"L1", "KL", "L1, held out"} <= trained.history.keys()


def test_a_heavy_kl_weight_collapses_the_posterior_and_it_is_said(split):
    samples, held_out = split
    heavy = TrainingSettings(steps=300, schedule=KLSchedule(weight=20.0, warm_up=50, cycle=300))
    metrics = measure(train(samples, held_out, (32, 16), heavy), samples, held_out, seed=0)
    assert metrics.status == "collapsed"
    assert metrics.active_units == 0
    assert "--kl-weight" in metrics.reason


def test_equal_seeds_give_equal_networks(split):
    few = TrainingSettings(steps=20)
    first, second = (train(*split, (16,), few).network.state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = train(*split, (16,), TrainingSettings(steps=20, seed=1)).network.state_dict()
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_the_split_is_by_subject_and_keeps_every_category():
    rng = np.random.default_rng(0)
    names = [("rare",) if k in (3, 4) else ("common",) for k in range(60)]
    samples = coefficient_set(rng.normal(size=(60, 3)), names, ("act",), [f"s{k // 3}" for k in range(60)], "here")
    for seed in range(8):
        training, held_out = split_by_subject(samples, seed)
        assert len(held_out.subjects) == 6
        assert not set(training.subjects) & set(held_out.subjects)
        assert min(training.counts(0).values()) > 0


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["a"] * 6, "only a"),
        (["a", "b", "c", "d", "a", "b"], "6 for 4"),
        (["a", "a", "a", "a", "a", "b"], "1 of b"),
        ([], "no sample"),
    ],
)
def test_too_few_samples_are_refused(names, found):
    with pytest.raises(InputError) as caught:
        coefficient_set(np.zeros((len(names), 2)), [(name,) for name in names], ("act",), names, "here")
    assert found in str(caught.value)


def test_settings_and_samples_are_checked(split):
    for settings in (TrainingSettings(steps=0), TrainingSettings(mixup=float("nan")), TrainingSettings(seed=-1)):
        with pytest.raises(InputError):
            settings.check()
    samples = split[0]
    equal = CoefficientSet(
        coefficients=np.ones_like(samples.coefficients),
        categories=samples.categories,
        factors=samples.factors,
        subjects=samples.subjects,
    )
    with pytest.raises(InputError, match="do not vary"):
        train(equal, equal, (8,), TrainingSettings(steps=1))


def test_the_discrepancy_is_zero_for_equal_distributions():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 400, 5))
    assert abs(squared_mmd(a, b)) < 0.01 < 0.05 < squared_mmd(a, b + 1)
