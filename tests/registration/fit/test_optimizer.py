"""Update rules against their formulas, and the loop on problems with known solutions."""

import pytest
import torch

from registration.fit.optimizer import AdamBlock, AdamUniformBlock, minimize
from registration.fit.recipes import Rate


def test_a_rate_is_constant_and_then_decays_exponentially():
    rate = Rate(start=0.1, end=0.001, hold=0.5)
    assert [rate.value(p) for p in (0.0, 0.3, 0.5, 0.75, 1.0)] == pytest.approx([0.1, 0.1, 0.1, 0.01, 0.001])
    assert Rate(start=2.0, end=0.5).value(0.5) == pytest.approx(1.0)
    assert Rate(start=0.3, end=0.1, hold=1.0).value(1.0) == pytest.approx(0.3)


def test_the_first_adam_step_equals_the_rate():
    """Adam's first step is the rate, whatever the gradient's size."""
    for progress, size in ((0.0, 0.1), (1.0, 0.01)):
        tensor = torch.zeros(3, requires_grad=True)
        block = AdamBlock([tensor], Rate(start=0.1, end=0.01))
        tensor.grad = torch.tensor([5.0, -1e-3, 0.0])
        block.step(progress)
        torch.testing.assert_close(tensor.detach(), torch.tensor([-size, size, 0.0]), atol=1e-4 * size, rtol=1e-4)


def test_adam_equals_torchs():
    random = torch.Generator().manual_seed(0)
    ours, theirs = (torch.ones(4, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    block = AdamBlock([ours], Rate(start=0.03, end=0.03))
    optimizer = torch.optim.Adam([theirs], lr=0.03, betas=(0.8, 0.95))
    for _ in range(15):
        ours.grad = theirs.grad = torch.randn(4, 3, generator=random, dtype=torch.float64)
        block.step(0.5)
        optimizer.step()
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def paper_updates(gradients: list[torch.Tensor], rate: float, b1: float, b2: float) -> torch.Tensor:
    """[Nicolet 2021]: Adam with the largest second moment of all coordinates, as released (`AdamUniform`)."""
    g1 = g2 = torch.zeros_like(gradients[0])
    total = torch.zeros_like(gradients[0])
    for step, gradient in enumerate(gradients, start=1):
        g1 = b1 * g1 + (1 - b1) * gradient
        g2 = b2 * g2 + (1 - b2) * gradient.square()
        total -= rate * (g1 / (1 - b1**step)) / (1e-8 + (g2 / (1 - b2**step)).max().sqrt())
    return total


def test_adam_uniform_equals_the_papers_for_one_dominant_coordinate(monkeypatch):
    """Ours measures a vertex' gradient by its length and averages the largest; the paper's the largest average
    coordinate. For one dominant vertex along one axis they are equal."""
    monkeypatch.setattr(AdamUniformBlock, "QUANTILE", 1.0)
    rng = torch.Generator().manual_seed(0)
    gradients = [torch.randn(50, 3, generator=rng, dtype=torch.float64) for _ in range(12)]
    for gradient in gradients:
        gradient[7] = torch.tensor([0.0, 20.0 + 10 * gradient[7, 0], 0.0])
    latent = torch.zeros(50, 3, dtype=torch.float64, requires_grad=True)
    block = AdamUniformBlock(latent, Rate(start=0.02, end=0.02), betas=(0.9, 0.99))
    for gradient in gradients:
        latent.grad = gradient
        block.step(0.5)
    torch.testing.assert_close(latent.detach(), paper_updates(gradients, 0.02, 0.9, 0.99), rtol=1e-5, atol=1e-9)


def test_adam_uniform_preserves_directions():
    """Unlike Adam's, a step is a multiple of the gradient field."""
    gradient = torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
    latent = torch.zeros(40, 3, requires_grad=True)
    block = AdamUniformBlock(latent, Rate(start=0.1, end=0.1))
    latent.grad = gradient
    block.step(0.0)
    ratio = latent.detach() / gradient
    torch.testing.assert_close(ratio, ratio[0, 0].expand(40, 3))
    assert latent.detach().norm(dim=1).max() == pytest.approx(0.1, rel=0.15)


def test_one_large_gradient_does_not_dominate_the_step():
    gradient = torch.randn(2000, 3, generator=torch.Generator().manual_seed(1))
    steps = []
    for wild in (1.0, 1e4):
        latent = torch.zeros(2000, 3, requires_grad=True)
        latent.grad = gradient.clone()
        latent.grad[0] *= wild
        AdamUniformBlock(latent, Rate(start=0.1, end=0.1)).step(0.0)
        steps.append(latent.detach()[1:].norm())
    assert steps[1] > 0.9 * steps[0]


def test_a_quadratic_problem_is_solved():
    """Two blocks, one of each rule, coupled through one residual."""
    rng = torch.Generator().manual_seed(0)
    target = torch.randn(30, 3, generator=rng)
    field, shift = torch.zeros(30, 3, requires_grad=True), torch.zeros(3, requires_grad=True)

    def objective(step: int) -> dict[str, torch.Tensor]:
        return {"fit": (field + shift - target).square().mean(), "small": 1e-3 * field.square().mean()}

    rate = Rate(start=0.1, end=1e-4, hold=0.5)
    blocks = [AdamUniformBlock(field, rate), AdamBlock([shift], rate)]
    seen: list[int] = []
    history, failure = minimize(blocks, objective, 300, seen.append)
    assert failure is None and seen == list(range(300))
    assert {name: len(values) for name, values in history.items()} == {"fit": 300, "small": 300}
    assert history["fit"][0] == pytest.approx(target.square().mean().item())
    assert history["fit"][-1] < 1e-4 * history["fit"][0]
    torch.testing.assert_close((field + shift).detach(), target, atol=0.01, rtol=0)


def test_the_rate_follows_its_schedule():
    progress: list[float] = []

    class Recorder:
        tensors = (torch.zeros(1, requires_grad=True),)

        def step(self, fraction: float) -> None:
            progress.append(fraction)

    block = Recorder()
    minimize([block], lambda step: {"a": block.tensors[0].sum()}, 5)
    assert progress == [0.0, 0.25, 0.5, 0.75, 1.0]
    minimize([block], lambda step: {"a": block.tensors[0].sum()}, 1)
    assert progress[5:] == [0.0]


def test_gradients_do_not_accumulate_over_steps():
    tensor = torch.zeros(1, requires_grad=True)
    seen: list[float] = []
    minimize(
        [AdamBlock([tensor], Rate(start=1e-3, end=1e-3))],
        lambda step: {"a": 2 * tensor.sum()},
        4,
        lambda step: seen.append(tensor.grad.item()),
    )
    assert seen == [2.0] * 4


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_term_that_is_not_finite_stops_the_loop(bad):
    """The term is named and in the history, and the parameters are those before that step."""
    tensor = torch.ones(2, requires_grad=True)
    states: list[torch.Tensor] = []

    def objective(step: int) -> dict[str, torch.Tensor]:
        return {"good": tensor.square().sum(), "bad": tensor.sum() * (bad if step == 3 else 1.0)}

    block = AdamBlock([tensor], Rate(start=0.1, end=0.1))
    history, failure = minimize([block], objective, 10, lambda step: states.append(tensor.detach().clone()))
    assert failure == "bad not finite at step 3"
    assert len(states) == 3 and len(history["bad"]) == len(history["good"]) == 4
    torch.testing.assert_close(tensor.detach(), states[-1])


def test_a_gradient_that_is_not_finite_stops_the_loop():
    """The square root of zero is finite, its derivative is not."""
    tensor = torch.zeros(2, requires_grad=True)
    block = AdamBlock([tensor], Rate(start=0.1, end=0.1))
    _, failure = minimize([block], lambda step: {"root": (0 * tensor).sqrt().sum()}, 3)
    assert failure == "gradient not finite at step 0"
    assert (tensor.detach() == 0).all()
