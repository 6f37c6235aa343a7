"""A sampler of 12,000 synthetic people: classes of draws, blends, penetration, duration."""

import tempfile
import time
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np

from bench.sampler_checks import BenchOptions, Figure, penetration, population
from coregister.first_model import build
from coregister.sampler.categories import Blend, blended
from coregister.sampler.decoder import Decoder, Part
from coregister.sampler.penetration import HeadMaker
from coregister.sampler.samples import split_by_subject
from coregister.sampler.storage import SamplerRecord, read_sampler
from coregister.sampler.training import TrainingSettings
from registration.model import gnm_npz
from registration.progress import console_progress
from workflows.records.coefficients import read_coefficients
from workflows.steps.sampler import SamplerInput, coefficient_sets, train_sampler

MIN_ACCURACY, MAX_MINUTES = 0.9, 10.0
_BLENDED = 60  # draws of a blend, and of each of its ends


def figures(options: BenchOptions) -> Iterator[Figure]:
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        model = build.bootstrap()
        data = gnm_npz.read(model)
        begin = time.perf_counter()
        people = population.make(data, options.count, options.seed)
        file = folder / "population.npz"
        population.write(people, data, file)
        seconds = time.perf_counter() - begin
        value = f"{seconds:.0f} s for {options.count} people; predicted identities of others to {people.error:.3f} rms"
        yield Figure(name="making coefficients", value=value)
        settings = TrainingSettings(steps=options.steps, seed=options.seed)
        given = SamplerInput(source=file)
        with console_progress() as progress:
            record = train_sampler(given, model, folder / "sampler", settings, progress)
        yield from _trained(record)
        sampler, _ = read_sampler(folder / "sampler")
        for part, decoder in sampler.decoders.items():
            yield from _blends(part, decoder, np.random.default_rng([41, options.seed]))
        sets, _ = coefficient_sets(read_coefficients(file, None, given.factors), given)
        _, held_out = split_by_subject(sets["expression"], options.seed)
        yield from penetration.figures(sampler, HeadMaker(data), held_out, options)


def _trained(record: SamplerRecord) -> Iterator[Figure]:
    minutes = sum(record.seconds.values()) / 60  # with the audit
    value = ", ".join(
        f"{name} {record.seconds[name]:.0f} s, CPU {cpu:.0f} s" for name, cpu in record.cpu_seconds.items()
    )
    kept = minutes <= MAX_MINUTES
    yield Figure(
        name="training", value=f"{value}; {record.threads} threads", limit=f"<= {MAX_MINUTES:.0f} min", kept=kept
    )
    for name, part in record.parts.items():
        m = part.metrics
        for factor, accuracy in m.accuracy.items():
            held = m.accuracy_held_out.get(factor, float("nan"))
            yield Figure(
                name=f"{factor}: class accuracy of draws",
                value=f"{accuracy:.4f}; held-out samples {held:.4f}",
                limit=f">= {MIN_ACCURACY}",
                kept=accuracy >= MIN_ACCURACY,
            )
        ratios = [found.variance_ratio or 0.0 for found in m.classes.values()]
        yield Figure(name=f"{name}: active units", value=f"{m.active_units} of {part.latent}; KL {sum(m.kl):.1f} nats")
        value = f"{min(ratios):.3f} to {max(ratios):.3f}, all {m.within_draws / m.within:.3f}"
        yield Figure(name=f"{name}: trace of the class covariance, of the samples'", value=value)
        yield Figure(
            name=f"{name}: variance of class means, of the samples'", value=f"{m.between_draws / m.between:.3f}"
        )
        mmd = [found.mmd or 0.0 for found in m.classes.values()]
        halves = [found.mmd_halves or 0.0 for found in m.classes.values()]
        value = f"mean {np.mean(mmd):.4f}, largest {max(mmd):.4f}; halves of the samples {np.mean(halves):.4f}"
        yield Figure(name=f"{name}: squared MMD per class", value=value)


def _blends(part: Part, decoder: Decoder, rng: np.random.Generator) -> Iterator[Figure]:
    """Where 50/50 blends lie along the line between the means of two classes' draws, and how far beside it."""
    for factor in decoder.factors:
        along, single, beside = [], [], []
        for pair in combinations(factor.categories, 2):
            ends = [_draws(decoder, factor.name, {name: 1.0}, rng) for name in pair]
            middle = _draws(decoder, factor.name, dict.fromkeys(pair, 0.5), rng)
            start, axis = ends[0].mean(0), ends[1].mean(0) - ends[0].mean(0)
            positions = (middle - start) @ axis / (axis @ axis)
            along.append(float(positions.mean()))
            single += positions.tolist()
            off = middle.mean(0) - start - along[-1] * axis
            spread = np.sqrt(np.mean([end.var(0).sum() for end in ends]))
            beside.append(float(np.linalg.norm(off) / spread))
        share = float(np.mean((np.array(single) > 0) & (np.array(single) < 1)))
        yield Figure(
            name=f"{factor.name}: 50/50 blends along the line between class means",
            value=f"means {min(along):.2f} to {max(along):.2f} of {len(along)} pairs; {share:.1%} of draws in 0 to 1",
            limit="means in 0.25 to 0.75",
            kept=min(along) > 0.25 and max(along) < 0.75,
        )
        value = f"mean {np.mean(beside):.2f}, largest {max(beside):.2f} of the spread within a class"
        yield Figure(name=f"{factor.name}: blends beside that line", value=value)


def _draws(decoder: Decoder, factor: str, weights: dict[str, float], rng: np.random.Generator) -> np.ndarray:
    """Draws of one factor's weights; the other factors have equal weights."""
    blends = {
        other.name: Blend(
            weights=weights if other.name == factor else dict.fromkeys(other.categories, 1 / len(other.categories))
        )
        for other in decoder.factors
    }
    condition = np.tile(blended(blends, decoder.factors), (_BLENDED, 1))
    return decoder.decode(rng.standard_normal((_BLENDED, decoder.latent)), condition)
