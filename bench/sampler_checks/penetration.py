"""How deep drawn heads penetrate, beside held-out samples, which the sampler has not seen."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bench.sampler_checks import BenchOptions, Figure
from coregister.sampler import pictures
from coregister.sampler.categories import one_hot
from coregister.sampler.decoder import Sampler
from coregister.sampler.penetration import LIMIT_MM, PERCENTILE, HeadMaker, depths_mm, limit_mm
from coregister.sampler.samples import CoefficientSet
from coregister.sampler.sampling import DrawnHead, SampleSettings, draw_heads
from registration.report.head_pictures import write_sheet

MAX_PENETRATING = 0.02
Depths = dict[str, Float[np.ndarray, "N"]]  # by expression, mm


def figures(sampler: Sampler, maker: HeadMaker, held_out: CoefficientSet, options: BenchOptions) -> Iterator[Figure]:
    """Audit draws, held-out samples, and drawn expressions on the held-out samples' identities."""
    names = sampler.decoders["expression"].factors[0].categories
    each = max(1, options.audited // len(names))
    limits = {name: limit_mm({name: 1.0}, sampler.depth_mm) for name in names}
    first, heads = _draws(sampler, maker, names, each, options.seed)
    penetrating = sum(head.redrawn > 0 for head in heads) / len(heads)
    left = sum(head.penetrates for head in heads)
    yield Figure(
        name="draws beyond the limit, before redrawing",
        value=f"{penetrating:.2%} of {len(heads)}; {left} after {sum(head.redrawn for head in heads)} redraws",
        limit=f"<= {MAX_PENETRATING:.0%}",
        kept=penetrating <= MAX_PENETRATING,
    )
    real, swapped = Depths(), Depths()
    for number, name in enumerate(names):
        rng = np.random.default_rng([43, options.seed, number])
        other = _redrawn(sampler, held_out, name, rng)
        real[name], swapped[name] = (
            depths_mm(maker, samples, name, each, np.random.default_rng([44, options.seed, number]))
            for samples in (held_out, other)
        )
    kinds = {"draws": first, "held-out samples": real, "drawn expressions on held-out identities": swapped}
    for kind, depths in kinds.items():
        beyond = np.concatenate([depths[name] > limits[name] for name in names])
        every = np.concatenate([depths[name] for name in names])
        median, high = np.percentile(every, [50, 90])
        value = (
            f"beyond the limit {beyond.mean():.2%} of {len(every)}, beyond {LIMIT_MM} mm "
            f"{(every > LIMIT_MM).mean():.1%}; median {median:.2f}, 90 % {high:.2f}, largest {every.max():.1f} mm"
        )
        yield Figure(name=f"depth: {kind}", value=value)
    for kind in ("draws", "drawn expressions on held-out identities"):
        chances = {name: _chance_of_deeper(kinds[kind][name], real[name]) for name in names if len(real[name])}
        least, most = min(chances, key=chances.__getitem__), max(chances, key=chances.__getitem__)
        value = (
            f"mean {np.mean(list(chances.values())):.2f}, {least} {chances[least]:.2f} to {most} {chances[most]:.2f}"
        )
        yield Figure(name=f"chance that one of the {kind} is deeper than a held-out sample (alike: 0.5)", value=value)
    above = {name: depth for name, depth in sampler.depth_mm.items() if depth > LIMIT_MM}
    value = f"{len(above)} of {len(names)} expressions: " + ", ".join(f"{n} {d:.1f}" for n, d in above.items())
    yield Figure(
        name=f"{PERCENTILE} % of training samples are less deep, where that is above {LIMIT_MM} mm", value=value
    )
    if options.out:
        _write(kinds, options.out / "depths.npz")
        page = pictures.contact_sheet(maker, heads[::each], "a head of each expression")
        write_sheet(page, options.out / "sheet.png")


def _draws(
    sampler: Sampler, maker: HeadMaker, names: tuple[str, ...], each: int, seed: int
) -> tuple[Depths, list[DrawnHead]]:
    """Heads of each expression as `gnmreg sample` draws them, and the depths of their first draws."""
    depths, heads = Depths(), list[DrawnHead]()
    for number, name in enumerate(names):
        settings = SampleSettings(wanted={"expression": name}, count=each, seed=seed + 1000 * number)
        drawn = draw_heads(sampler, maker, settings).heads
        depths[name] = np.array([head.first_depth_mm for head in drawn], np.float64)
        heads += drawn
    return depths, heads


def _redrawn(sampler: Sampler, held_out: CoefficientSet, name: str, rng: np.random.Generator) -> CoefficientSet:
    """The held-out samples of an expression, with drawn coefficients of it and the identities that they had."""
    decoder = sampler.decoders["expression"]
    own = held_out.rows(held_out.categories[:, 0] == held_out.factors[0].categories.index(name))
    latent = rng.standard_normal((len(own.coefficients), decoder.latent))
    return CoefficientSet(
        coefficients=decoder.decode(latent, one_hot(own.categories, own.factors)),
        categories=own.categories,
        factors=own.factors,
        subjects=own.subjects,
        identities=own.identities,
    )


def _chance_of_deeper(a: Float[np.ndarray, "N"], b: Float[np.ndarray, "M"]) -> float:
    """Chance that one of `a` is larger than one of `b`, equal ones count half (Mann and Whitney's statistic)."""
    return float((a[:, None] > b).mean() + 0.5 * (a[:, None] == b).mean())


def _write(kinds: dict[str, Depths], file: Path) -> None:
    """Write the depths of each kind as a row: its name, the expression, mm."""
    rows = [(kind, name, depth) for kind, found in kinds.items() for name in found for depth in found[name]]
    kind, expression, depth = zip(*rows, strict=True)
    np.savez(file, kind=np.array(kind), expression=np.array(expression), depth_mm=np.array(depth))
