"""Draws the pictures of docs/sampler.md: `python -m docs.pictures.sampler decoders DECODERS GNM.npz docs`.

DECODERS is the folder of the decoders that Google released, GNM.npz a model with the official expression basis. For a
sampler that was trained here: `python -m docs.pictures.sampler trained SAMPLER MODEL.npz docs`.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from coregister.sampler import pictures
from coregister.sampler.decoder import Sampler
from coregister.sampler.penetration import HeadMaker
from coregister.sampler.sampling import SampleSettings, draw_heads
from registration.model import gnm_npz
from registration.report.head_pictures import HeadPainter, Tile, sheet
from workflows.steps.sampler import open_sampler

QUALITY = 84
COLUMNS = 4


def trained(sampler: Sampler, maker: HeadMaker) -> Image.Image:
    """One drawn head of each expression, with a drawn identity."""
    names = sampler.decoders["expression"].factors[0].categories
    heads = []
    for number, name in enumerate(names):
        heads += draw_heads(sampler, maker, SampleSettings(wanted={"expression": name}, count=1, seed=number)).heads
    return pictures.contact_sheet(maker, heads, "a head of each expression")


def decoders(sampler: Sampler, maker: HeadMaker) -> Image.Image:
    """Each expression of the released decoder, one draw; the identity decoder fits the official model alone."""
    names = sampler.decoders["expression"].factors[0].categories
    painter, tiles = HeadPainter(maker.data, turn_deg=12.0), []
    for number, name in enumerate(names):
        settings = SampleSettings(wanted={"expression": name}, count=1, seed=number)
        (head,) = draw_heads(sampler, maker, settings).heads
        tiles.append(_tile(painter, maker, head.identity, head.expression, name))
    return sheet(tiles, "the released expression decoder: one draw of each category", COLUMNS)


def _tile(painter: HeadPainter, maker: HeadMaker, identity: np.ndarray, expression: np.ndarray, name: str) -> Tile:
    return Tile(picture=painter.draw(maker.vertices(identity, expression)), caption=name.replace("_", " "))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("decoders", "trained"))
    parser.add_argument("sampler", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    sampler, _ = open_sampler(arguments.sampler)
    maker = HeadMaker(gnm_npz.read(arguments.model))
    draw, name = (decoders, "sampler_decoders") if arguments.kind == "decoders" else (trained, "sampler")
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(sampler, maker).save(arguments.out / f"{name}.jpg", quality=QUALITY)


if __name__ == "__main__":
    main()
