"""The optimization loop. It gets blocks of parameters and an objective, and knows none of them by name."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from registration.fit.recipes import Rate

_EPSILON = 1e-8  # of the root of the second moment

History = dict[str, list[float]]


@runtime_checkable
class ParameterBlock(Protocol):
    """Tensors that are updated by one rule. Their gradients are cleared and filled by the loop."""

    tensors: Sequence[Tensor]

    def step(self, progress: float) -> None:
        """Update the tensors from their gradients when a fraction `progress` of the steps is done."""
        ...


class AdamBlock:
    """Adam [Kingma 2015], for parameters of comparable scale."""

    def __init__(self, tensors: Sequence[Tensor], rate: Rate, betas: tuple[float, float] = (0.8, 0.95)):
        self.tensors = tensors
        self._rate, self._betas, self._steps = rate, betas, 0
        self._first, self._second = ([torch.zeros_like(tensor) for tensor in tensors] for _ in range(2))

    @torch.no_grad()
    def step(self, progress: float) -> None:
        # Not torch.optim.Adam, whose first use imports torch's compiler: seconds of every process.
        self._steps += 1
        b1, b2 = self._betas
        rate = self._rate.value(progress) / (1 - b1**self._steps)
        for tensor, first, second in zip(self.tensors, self._first, self._second, strict=True):
            if tensor.grad is None:
                continue
            first.lerp_(tensor.grad, 1 - b1)
            second.mul_(b2).addcmul_(tensor.grad, tensor.grad, value=1 - b2)
            tensor.addcdiv_(first, (second / (1 - b2**self._steps)).sqrt_().add_(_EPSILON), value=-rate)


class AdamUniformBlock:
    """Adam with one step size for all vertices [Nicolet 2021], so that the direction of a field is kept.

    The paper divides by the largest second moment; here it is a high quantile, which single outliers do not change.

    Args:
        latent: the field.
        rate: the learning rate.
        betas: decay of the first and second moments.
        groups: a group per vertex, each with its own second moment; without them, vertices of a region where all
            gradients are weak would hardly move. None: one group.
        rate_scale: factor of the rate, per group.
    """

    QUANTILE = 0.998

    def __init__(
        self,
        latent: Tensor,
        rate: Rate,
        betas: tuple[float, float] = (0.9, 0.99),
        groups: Int[Tensor, "V"] | None = None,
        rate_scale: Sequence[float] = (1.0,),
    ):
        self.tensors: Sequence[Tensor] = (latent,)
        self._rate = rate
        self._betas = betas
        self._first = torch.zeros_like(latent)
        self._group = torch.zeros(len(latent), dtype=torch.long, device=latent.device) if groups is None else groups
        self._members = [(self._group == number).nonzero()[:, 0] for number in range(len(rate_scale))]
        self._rate_scale = latent.new_tensor(rate_scale)
        self._second = torch.zeros_like(self._rate_scale)
        self._steps = 0

    @torch.no_grad()
    def step(self, progress: float) -> None:
        (latent,) = self.tensors
        assert latent.grad is not None
        self._steps += 1
        b1, b2 = self._betas
        self._first.lerp_(latent.grad, 1 - b1)
        squared = latent.grad.square().sum(-1)
        largest = [
            squared[rows].quantile(self.QUANTILE) if len(rows) else squared.new_zeros(()) for rows in self._members
        ]
        self._second.lerp_(torch.stack(largest), 1 - b2)
        root = (self._second / (1 - b2**self._steps)).sqrt() + 1e-12
        scale = (self._rate_scale / root).index_select(0, self._group)
        latent -= self._rate.value(progress) / (1 - b1**self._steps) * scale[:, None] * self._first


def minimize(
    blocks: Sequence[ParameterBlock],
    objective: Callable[[int], Mapping[str, Tensor]],
    steps: int,
    after_step: Callable[[int], None] = lambda step: None,
) -> tuple[History, str | None]:
    """Take `steps` steps on the sum of the objective's weighted losses.

    Args:
        blocks: what is optimized.
        objective: step -> weighted losses by name.
        steps: how many.
        after_step: called with the number of every step that was taken.

    Returns:
        The value of every loss at every step; and None, or why it stopped: a loss or a gradient that is not finite. The
        parameters are then those before that step.
    """
    history: History = {}
    for step in range(steps):
        losses = objective(step)
        for name, value in losses.items():
            history.setdefault(name, []).append(value.item())
        invalid = [name for name, values in history.items() if not math.isfinite(values[-1])]
        if invalid:
            return history, f"{', '.join(invalid)} not finite at step {step}"
        for block in blocks:
            for tensor in block.tensors:
                tensor.grad = None
        torch.stack(list(losses.values())).sum().backward()
        gradients = [tensor.grad for block in blocks for tensor in block.tensors if tensor.grad is not None]
        if not all(gradient.isfinite().all() for gradient in gradients):
            return history, f"gradient not finite at step {step}"
        for block in blocks:
            block.step(step / max(1, steps - 1))
        after_step(step)
    return history, None
