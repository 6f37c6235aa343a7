"""Training of one network on coefficients and their categories."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from coregister.sampler.categories import Factor, condition_size, one_hot
from coregister.sampler.decoder import Decoder
from coregister.sampler.loss import KLSchedule, divergences, free_bits, mix_up, reconstruction
from coregister.sampler.networks import Architecture, ConditionalVAE
from coregister.sampler.samples import CoefficientSet
from registration.errors import InputError, check_seed
from registration.progress import NullProgress, Progress

MAX_STEPS = 1_000_000
_RECORD_EVERY = 100  # steps


@dataclass(frozen=True, kw_only=True)
class TrainingSettings:
    """How a network is trained.

    Attributes:
        steps: of gradient descent.
        l1_weight: of the reconstruction, beside which the KL weight has its meaning: coefficients have an rms of 1, and
            both terms are sums over dimensions.
        batch: samples of a step.
        learning_rate: of Adam at the start; it falls to a hundredth along half a cosine.
        schedule: of the KL weight.
        free_bits: nats of each latent dimension that cost nothing.
        mixup: alpha of the Beta distribution of mixed samples; 0: none are mixed.
        seed: of everything random.
    """

    steps: int = 8000
    l1_weight: float = 1.0
    batch: int = 128
    learning_rate: float = 1e-3
    schedule: KLSchedule = field(default_factory=KLSchedule)
    free_bits: float = 0.02
    mixup: float = 0.2
    seed: int = 0

    def check(self) -> None:
        """Refuse settings out of range. Raises InputError."""
        check_seed(self.seed, "--seed")
        whole = {"steps": (self.steps, MAX_STEPS), "batch": (self.batch, 65536)}
        whole |= {"warm_up": (self.schedule.warm_up, MAX_STEPS), "cycle": (self.schedule.cycle, MAX_STEPS)}
        for name, (value, most) in whole.items():
            if not 1 <= value <= most:
                raise _out_of_range(name, f"a whole number from 1 to {most}", value)
        rates = {"learning_rate": self.learning_rate, "kl_weight": self.schedule.weight, "l1_weight": self.l1_weight}
        rates |= {"free_bits": self.free_bits, "mixup": self.mixup}
        for name, rate in rates.items():
            if not 0 <= rate <= 100:  # also false for NaN
                raise _out_of_range(name, "a number from 0 to 100", rate)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedNetwork:
    """A network with the scale of its coefficients: it works on (coefficients - offset) / scale.

    A drawn latent vector is `latent_mean` of its condition plus `latent_spread` times standard normal numbers; both are
    the moments of the posteriors of the training samples (docs/algorithms.md, "Semantic sampler").
    """

    network: ConditionalVAE
    offset: Float[np.ndarray, "D"]
    scale: float
    latent_mean: Float[np.ndarray, "C Z"]  # linear in the condition vector
    latent_spread: Float[np.ndarray, "Z Z"]
    history: dict[str, list[float]] = field(default_factory=dict)  # term -> values, of each `_RECORD_EVERY` steps

    def normalized(self, coefficients: Float[np.ndarray, "N D"]) -> Float[Tensor, "N D"]:
        """Return coefficients as the network takes them."""
        return torch.from_numpy(((coefficients - self.offset) / self.scale).astype(np.float32))

    def posterior(self, samples: CoefficientSet) -> tuple[Float[Tensor, "N Z"], Float[Tensor, "N Z"]]:
        """Return mean and logarithm of the variance of each sample's latent vector."""
        conditions = torch.from_numpy(one_hot(samples.categories, samples.factors))
        with torch.no_grad():
            return self.network.encode(self.normalized(samples.coefficients), conditions)

    def decoder(self, factors: tuple[Factor, ...]) -> Decoder:
        """Return the half that draws: of standard normal numbers, since the first layer takes up the latent moments."""
        linear = [layer for layer in self.network.decoder if isinstance(layer, nn.Linear)]
        layers = [(layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy().copy()) for layer in linear]
        kernel, bias = layers[0]
        of_latent, of_conditions = kernel[: len(self.latent_spread)], kernel[len(self.latent_spread) :]
        first = np.concatenate([self.latent_spread.T @ of_latent, of_conditions + self.latent_mean @ of_latent])
        layers[0] = first.astype(np.float32), bias
        return Decoder(factors=factors, layers=tuple(layers), offset=self.offset, scale=self.scale)


def train(
    samples: CoefficientSet,
    held_out: CoefficientSet,
    layers: Sequence[int],
    settings: TrainingSettings,
    progress: Progress | None = None,
) -> TrainedNetwork:
    """Train a network.

    Equal samples, settings and numbers of threads give equal networks.

    Args:
        samples: to train on.
        held_out: whose loss is recorded; may be empty.
        layers: of the encoder.
        settings: of the training.
        progress: receives the steps.

    Raises:
        InputError: a setting is out of range, or the coefficients do not vary.
    """
    settings.check()
    progress = progress or NullProgress()
    offset = samples.coefficients.mean(0)
    scale = float(np.sqrt(np.mean((samples.coefficients - offset) ** 2, dtype=np.float64)))
    if not scale > 1e-9:
        what = "The coefficients do not vary"
        fix = "give registrations of different people and expressions"
        raise InputError(what, where="training samples", expected="different coefficients", got="equal ones", fix=fix)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network = ConditionalVAE(
            Architecture(
                coefficients=samples.coefficients.shape[1],
                conditions=condition_size(samples.factors),
                layers=tuple(layers),
            )
        )
    latent, conditions = network.architecture.latent, network.architecture.conditions
    trained = TrainedNetwork(
        network=network,
        offset=offset,
        scale=scale,
        latent_mean=np.zeros((conditions, latent), np.float32),
        latent_spread=np.eye(latent, dtype=np.float32),
    )
    _descend(trained, _tensors(trained, samples), _tensors(trained, held_out), settings, progress)
    network.eval().requires_grad_(False)
    return _with_latent_moments(trained, samples)


def _with_latent_moments(trained: TrainedNetwork, samples: CoefficientSet) -> TrainedNetwork:
    """Set the latent distribution to the moments of the samples' posteriors, all together [Ghosh 2020].

    Their mean is regressed on the condition vector; the covariance around it is that of the posteriors' means plus the
    mean of their variances.
    """
    mean, log_variance = (part.numpy().astype(np.float64) for part in trained.posterior(samples))
    conditions = one_hot(samples.categories, samples.factors).astype(np.float64)
    # Factors' one-hot vectors sum to 1 each, so the least squares have many solutions: the smallest is taken.
    latent_mean = np.linalg.lstsq(conditions, mean, rcond=None)[0]
    around = mean - conditions @ latent_mean
    covariance = around.T @ around / len(around) + np.diag(np.exp(log_variance).mean(0))
    values, vectors = np.linalg.eigh(covariance)
    spread = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    return replace(trained, latent_mean=latent_mean.astype(np.float32), latent_spread=spread.astype(np.float32))


def _tensors(trained: TrainedNetwork, samples: CoefficientSet) -> tuple[Tensor, Tensor]:
    conditions = one_hot(samples.categories, samples.factors)
    return trained.normalized(samples.coefficients), torch.from_numpy(conditions)


def _descend(
    trained: TrainedNetwork,
    training: tuple[Tensor, Tensor],
    held_out: tuple[Tensor, Tensor],
    settings: TrainingSettings,
    progress: Progress,
) -> None:
    """Minimize the loss, and record its terms."""
    network, history = trained.network, trained.history
    generator = torch.Generator().manual_seed(settings.seed)
    optimizer = torch.optim.Adam(network.parameters(), settings.learning_rate, fused=True)
    decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.steps, settings.learning_rate / 100)
    batches = _Batches(len(training[0]), settings.batch, generator)
    for step in range(settings.steps):
        rows = next(batches)
        x, c = mix_up(training[0][rows], training[1][rows], settings.mixup, generator)
        mean, log_variance = network.encode(x, c)
        noise = torch.randn(mean.shape, generator=generator)
        recon = reconstruction(network.decode(mean + noise * (0.5 * log_variance).exp(), c), x)
        divergence = divergences(mean, log_variance)
        loss = settings.l1_weight * recon + settings.schedule.at(step) * free_bits(divergence, settings.free_bits)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()
        if step % _RECORD_EVERY == 0 or step == settings.steps - 1:
            progress.update(step, settings.steps, "training")
            terms = {"step": float(step), "L1": recon.item(), "KL": divergence.sum().item()}
            terms |= {"KL weight": settings.schedule.at(step)} | _held_out_terms(network, held_out)
            for name, value in terms.items():
                history.setdefault(name, []).append(value)


def _held_out_terms(network: ConditionalVAE, held_out: tuple[Tensor, Tensor]) -> dict[str, float]:
    """Return the loss of the held-out samples at the mean of their posteriors, without mixing."""
    if not len(held_out[0]):
        return {}
    with torch.no_grad():
        mean, log_variance = network.encode(*held_out)
        recon = reconstruction(network.decode(mean, held_out[1]), held_out[0])
        return {"L1, held out": recon.item(), "KL, held out": divergences(mean, log_variance).sum().item()}


class _Batches:
    """Random batches, each sample once per pass; the last batch of a pass that is not full is left out."""

    def __init__(self, count: int, batch: int, generator: torch.Generator) -> None:
        self._count, self._batch, self._generator = count, min(batch, count), generator
        self._order, self._next = torch.zeros(0, dtype=torch.long), 0

    def __next__(self) -> Tensor:
        if self._next + self._batch > len(self._order):
            self._order, self._next = torch.randperm(self._count, generator=self._generator), 0
        rows = self._order[self._next : self._next + self._batch]
        self._next += self._batch
        return rows


def _out_of_range(name: str, expected: str, got: object) -> InputError:
    return InputError("A setting of the training is out of range", where=name, expected=expected, got=got)
