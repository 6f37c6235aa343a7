"""Heads drawn from a sampler by categories; those that penetrate are drawn again."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from coregister.sampler.categories import Blend, Factor, blended, parse_blend
from coregister.sampler.decoder import PARTS, Decoder, Part, Sampler
from coregister.sampler.penetration import HeadMaker, limit_mm
from registration.errors import InputError, check_seed
from registration.progress import NullProgress, Progress

MAX_COUNT = 10_000
MAX_REDRAWS = 20  # of one head


@dataclass(frozen=True, kw_only=True)
class SampleSettings:
    """What is drawn.

    Attributes:
        wanted: factor -> weights of its categories, as text: `asian=0.4,white=0.6`. A factor of the identity that is
            not given is a random category of each head; an expression that is not given is neutral.
        count: number of heads.
        seed: of everything random.
        audit: draw heads again that penetrate.
    """

    wanted: Mapping[str, str]
    count: int = 12
    seed: int = 0
    audit: bool = True

    def check(self) -> None:
        """Refuse numbers out of range. Raises InputError."""
        check_seed(self.seed, "--seed")
        if not 1 <= self.count <= MAX_COUNT:
            expected = f"a whole number from 1 to {MAX_COUNT}"
            raise InputError("The number of heads is out of range", where="--count", expected=expected, got=self.count)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnHead:
    """One head."""

    identity: Float[np.ndarray, "I"]
    expression: Float[np.ndarray, "E"]
    categories: Mapping[str, Mapping[str, float]]  # factor -> category -> weight
    depth_mm: float | None  # of the penetration; None: not audited
    first_depth_mm: float | None  # before it was drawn again
    redrawn: int  # how often
    penetrates: bool  # still, after `MAX_REDRAWS`


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnHeads:
    """All heads, and what a user should know of them."""

    heads: tuple[DrawnHead, ...]
    remarks: tuple[str, ...]

    @property
    def first_penetrating(self) -> int:
        """Return how many heads penetrated when they were drawn first."""
        return sum(head.redrawn > 0 for head in self.heads)

    @property
    def redrawn(self) -> int:
        """Return how often a head was drawn again."""
        return sum(head.redrawn for head in self.heads)


def draw_heads(
    sampler: Sampler, maker: HeadMaker, settings: SampleSettings, progress: Progress | None = None
) -> DrawnHeads:
    """Draw heads.

    Args:
        sampler: decoders of one or both parts.
        maker: of the head model that the coefficients belong to.
        settings: what to draw.
        progress: receives the heads.

    Raises:
        InputError: a number is out of range; a factor or category that the sampler lacks; coefficients that do not fit
            the model.
    """
    settings.check()
    progress = progress or NullProgress()
    decoders, remarks = _fitting(sampler, maker, settings)
    fixed = _blends(sampler, decoders, settings.wanted)
    remarks += [blend.remark for blend in fixed.values() if blend.remark]
    heads = []
    for number in range(settings.count):
        progress.update(number, settings.count, "drawing heads")
        heads.append(_draw(sampler, decoders, maker, fixed, np.random.default_rng([settings.seed, number]), settings))
    drawn = DrawnHeads(heads=tuple(heads), remarks=tuple(remarks))
    return drawn


def _draw(
    sampler: Sampler,
    decoders: Mapping[Part, Decoder],
    maker: HeadMaker,
    fixed: Mapping[str, Blend],
    rng: np.random.Generator,
    settings: SampleSettings,
) -> DrawnHead:
    """Draw one head until it does not penetrate; the least deep one if none is good."""
    sizes = _sizes(maker)
    blends = dict(fixed)
    for decoder in decoders.values():
        for factor in decoder.factors:
            if factor.name not in blends:
                blends[factor.name] = Blend(weights={str(rng.choice(factor.categories)): 1.0})
    weights = blends["expression"].weights if "expression" in blends else {}
    limit = limit_mm(weights, sampler.depth_mm)
    best: tuple[float, dict[Part, np.ndarray]] | None = None
    first = None
    redrawn = -1
    while redrawn < MAX_REDRAWS:
        redrawn += 1
        drawn: dict[Part, np.ndarray] = {part: np.zeros(size, np.float32) for part, size in sizes.items()}
        for part, decoder in decoders.items():
            latent = rng.standard_normal((1, decoder.latent))
            drawn[part] = decoder.decode(latent, blended(blends, decoder.factors)[None])[0]
        depth = maker.depth_mm(maker.vertices(drawn["identity"], drawn["expression"])) if settings.audit else None
        if redrawn == 0:
            first = depth
        if best is None or (depth is not None and depth < best[0]):
            best = (depth or 0.0, drawn)
        if depth is None or depth <= limit:
            break
    assert best is not None
    depth_mm, chosen = best
    return DrawnHead(
        identity=chosen["identity"],
        expression=chosen["expression"],
        categories={name: dict(blend.weights) for name, blend in blends.items()},
        depth_mm=depth_mm if settings.audit else None,
        first_depth_mm=first,
        redrawn=redrawn,
        penetrates=settings.audit and depth_mm > limit,
    )


def _fitting(sampler: Sampler, maker: HeadMaker, settings: SampleSettings) -> tuple[dict[Part, Decoder], list[str]]:
    """The decoders that are used. One whose coefficients do not fit the model is refused only if it was asked for."""
    sizes = _sizes(maker)
    used, remarks = dict[Part, Decoder](), list[str]()
    for part in PARTS:
        decoder = sampler.decoders.get(part)
        if decoder is None:
            continue
        asked = any(factor.name in settings.wanted for factor in decoder.factors)
        if decoder.coefficients != sizes[part]:
            got = f"{decoder.coefficients} coefficients of the {part}"
            if asked:
                raise InputError(
                    "The sampler's coefficients do not fit the model",
                    where="--model",
                    expected=f"a model with {got}",
                    got=sizes[part],
                    fix="give the model that the sampler was trained for",
                )
            if part == "identity":
                remarks.append(f"{got} do not fit the model's {sizes[part]}: all heads have the template's identity")
        elif part == "identity" or asked:
            used[part] = decoder
    return used, remarks


def _sizes(maker: HeadMaker) -> dict[Part, int]:
    return {"identity": len(maker.data.vertex_identity_basis), "expression": len(maker.data.expression_basis)}


def _blends(sampler: Sampler, decoders: Mapping[Part, Decoder], wanted: Mapping[str, str]) -> dict[str, Blend]:
    """The weights that were asked for, by factor."""
    factors: dict[str, Factor] = {f.name: f for decoder in decoders.values() for f in decoder.factors}
    known = [f.name for decoder in sampler.decoders.values() for f in decoder.factors]
    for name in wanted:
        if name not in factors:
            raise InputError(
                "The sampler lacks this factor",
                where=f"--{name}",
                expected=", ".join(known),
                got=name,
                fix="omit it, or give a sampler that was trained with it",
            )
    return {name: parse_blend(text, factors[name]) for name, text in wanted.items()}
