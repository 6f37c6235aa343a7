"""The one optimisation loop. It is handed blocks of unknowns and an objective, and knows none by name."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from registration.fit.recipes import Rate

History = dict[str, list[float]]


@runtime_checkable
class Block(Protocol):
    """Unknowns that are updated by one rule. Their gradients are cleared and filled by the loop."""

    tensors: Sequence[Tensor]

    def step(self, progress: float) -> None: ...


class AdamBlock:
    """Adam, for unknowns of comparable scale."""

    def __init__(self, tensors: Sequence[Tensor], rate: Rate, betas: tuple[float, float] = (0.8, 0.95)):
        self.tensors = tensors
        self._rate = rate
        self._optimizer = torch.optim.Adam(tensors, lr=rate.start, betas=betas)

    def step(self, progress: float) -> None:
        for group in self._optimizer.param_groups:
            group["lr"] = self._rate.at(progress)
        self._optimizer.step()


class AdamUniformBlock:
    """Adam with one step size for all vertices (Nicolet 2021), so that a field's direction is kept.

    [Nicolet 2021] divides by the largest second moment; here by a high quantile, since one wild vertex would rule it.
    Vertices may be told apart in `groups`, each with a step size of its own times its `pace`: where images pull
    weakly everywhere, vertices would else hardly move.
    """

    QUANTILE = 0.998

    def __init__(
        self,
        latent: Tensor,
        rate: Rate,
        betas: tuple[float, float] = (0.9, 0.99),
        groups: Int[Tensor, "V"] | None = None,
        pace: Sequence[float] = (1.0,),
    ):
        self.tensors: Sequence[Tensor] = (latent,)
        self._rate = rate
        self._betas = betas
        self._first = torch.zeros_like(latent)
        self._group = torch.zeros(len(latent), dtype=torch.long, device=latent.device) if groups is None else groups
        self._members = [(self._group == number).nonzero()[:, 0] for number in range(len(pace))]
        self._pace = latent.new_tensor(pace)
        self._second = torch.zeros_like(self._pace)
        self._steps = 0

    @torch.no_grad()
    def step(self, progress: float) -> None:
        (latent,) = self.tensors
        assert latent.grad is not None
        self._steps += 1
        b1, b2 = self._betas
        self._first.lerp_(latent.grad, 1 - b1)
        squared = latent.grad.square().sum(-1)
        largest = [squared[own].quantile(self.QUANTILE) if len(own) else squared.new_zeros(()) for own in self._members]
        self._second.lerp_(torch.stack(largest), 1 - b2)
        scale = (self._second / (1 - b2**self._steps)).sqrt() + 1e-12
        pace = (self._pace / scale).index_select(0, self._group)
        latent -= self._rate.at(progress) / (1 - b1**self._steps) * pace[:, None] * self._first


def minimise(
    blocks: Sequence[Block],
    objective: Callable[[int], Mapping[str, Tensor]],
    steps: int,
    after_step: Callable[[int], None] = lambda step: None,
) -> tuple[History, str | None]:
    """Take `steps` steps on the sum of the objective's weighted terms.

    Returns the value of every term at every step, and None or why it had to stop: a term or a gradient that is not
    finite. The unknowns are then those before that step.
    """
    history: History = {}
    for step in range(steps):
        terms = objective(step)
        for name, value in terms.items():
            history.setdefault(name, []).append(value.item())
        broken = [name for name, values in history.items() if not torch.isfinite(torch.tensor(values[-1]))]
        if broken:
            return history, f"{', '.join(broken)} not finite at step {step}"
        for block in blocks:
            for tensor in block.tensors:
                tensor.grad = None
        torch.stack(list(terms.values())).sum().backward()
        gradients = [tensor.grad for block in blocks for tensor in block.tensors if tensor.grad is not None]
        if not all(gradient.isfinite().all() for gradient in gradients):
            return history, f"gradient not finite at step {step}"
        for block in blocks:
            block.step(step / max(1, steps - 1))
        after_step(step)
    return history, None
