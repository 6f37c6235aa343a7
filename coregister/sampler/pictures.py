"""Pictures of a training and of drawn heads."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from coregister.sampler.decoder import Part
from coregister.sampler.metrics import NetworkMetrics
from coregister.sampler.penetration import HeadMaker
from coregister.sampler.sampling import DrawnHead
from coregister.sampler.training import TrainedNetwork
from registration.report.head_pictures import HeadPainter, Tile, sheet
from registration.storage.files import atomic_file

_MAX_TILES = 60  # heads of a contact sheet
_MAX_COLUMNS = 4


def write_curves(networks: Mapping[Part, TrainedNetwork], metrics: Mapping[Part, NetworkMetrics], file: Path) -> None:
    """Draw, for each network, the loss terms by step, and the KL divergence of each latent dimension; a PNG file."""
    figure = Figure(figsize=(10, 3.4 * len(networks)), layout="constrained", dpi=110)
    panels = figure.subplots(len(networks), 2, squeeze=False)
    for (left, right), (name, trained) in zip(panels, networks.items(), strict=True):
        steps = trained.history["step"]
        for term, colour in (("L1", "#1f6f8b"), ("KL", "#d1495b")):
            left.plot(steps, trained.history[term], color=colour, lw=1.2, label=term)
            if f"{term}, held out" in trained.history:
                left.plot(
                    steps, trained.history[f"{term}, held out"], color=colour, lw=1.2, ls=":", label=f"{term}, held out"
                )
        left.set_yscale("log")
        left.set_xlabel("step")
        left.set_title(f"{name}: loss terms")
        weight = left.twinx()
        weight.plot(steps, trained.history["KL weight"], color="#999999", lw=0.9)
        weight.set_ylabel("KL weight (grey)", color="#777777")
        left.legend(loc="upper right", fontsize=8)
        found = metrics[name]
        right.bar(range(len(found.kl)), sorted(found.kl, reverse=True), color="#1f6f8b")
        right.set_xlabel("latent dimension, sorted")
        right.set_ylabel("KL, nats")
        right.set_title(f"{name}: {found.active_units} of {len(found.kl)} dimensions in use")
    with atomic_file(file) as temporary:
        figure.savefig(temporary, format="png")


def contact_sheet(maker: HeadMaker, heads: Sequence[DrawnHead], heading: str) -> Image.Image:
    """Return a page of the first heads, each with its categories below."""
    shown = heads[:_MAX_TILES]
    painter = HeadPainter(maker.data)
    tiles = [
        Tile(picture=painter.draw(maker.vertices(head.identity, head.expression)), caption=caption(head.categories))
        for head in shown
    ]
    columns = min(_MAX_COLUMNS, math.ceil(len(shown) ** 0.5))
    more = f"; the first {len(shown)} of {len(heads)}" if len(heads) > len(shown) else ""
    return sheet(tiles, heading + more, columns)


def caption(categories: Mapping[str, Mapping[str, float]]) -> str:
    """Return a line of a head's identity and one of its expression: `female, 40 % asian + 60 % white`."""

    def text(weights: Mapping[str, float]) -> str:
        names = [(name.replace("_", " "), weight) for name, weight in weights.items() if weight > 0]
        return names[0][0] if len(names) == 1 else " + ".join(f"{100 * weight:.0f} % {name}" for name, weight in names)

    identity = ", ".join(text(weights) for factor, weights in categories.items() if factor != "expression")
    expression = text(categories["expression"]) if "expression" in categories else ""
    return "\n".join(line for line in (expression, identity) if line) or "neutral"
