"""The picture of a map: the bent target, coloured by distance, and in grey what is left out."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from registration.frames import MM_PER_M
from registration.report.heat_map import SIZE, Fragments, distance_paint, render_painted
from registration.report.inputs import HeatMap
from registration.report.pictures import scale_colours
from registration.storage.files import atomic_file
from registration.topology_map.landmarked import LandmarkedMesh
from registration.topology_map.make import flipped_faces
from registration.topology_map.topology_map import TopologyMap

LIMIT_MM = 0.1  # end of the colour scale
_FLIPPED = (40, 60, 200)  # sRGB
_GOOD, _BAD, _INK, _PAPER = (38, 128, 122), (178, 36, 56), (30, 32, 38), (246, 246, 243)
_HEADING, _ROW, _SCALE = 60, 32, 46


def draw(mapped: TopologyMap, source: LandmarkedMesh, target: LandmarkedMesh, path: Path) -> None:
    """Draw the bent target from three sides, with the verdict and what was measured, as a PNG file.

    Args:
        mapped: the map from `source` to `target`.
        source: the mesh that was bent onto.
        target: the mesh that was bent.
        path: the file; its folder is created.
    """
    bent = mapped.place(source.vertices)
    flipped = np.zeros(len(target.triangles), bool)
    flipped[flipped_faces(source, target, bent, mapped.mask)] = True
    heat = HeatMap(
        vertices=bent,
        triangles=target.triangles,
        distance_mm=np.where(mapped.mask, MM_PER_M * mapped.points.distance_m, np.nan),
        T_head_world=np.eye(4),
    )
    distances = distance_paint(heat, LIMIT_MM)

    def paint(fragments: Fragments) -> Float[np.ndarray, "P 3"]:
        return np.where(flipped[fragments.face][:, None], _FLIPPED, distances(fragments))

    sides = render_painted(heat, {"": paint})[""]
    lines = _lines(mapped)
    width = SIZE[0] * len(sides)
    page = Image.new("RGB", (width, _HEADING + SIZE[1] + _SCALE + _ROW * len(lines) + 12), _PAPER)
    pen = ImageDraw.Draw(page)
    verdict = f"{target.name} on {source.name}: {mapped.status}"
    pen.text((16, 8), verdict, _GOOD if mapped.accepted else _BAD, ImageFont.load_default(36))
    for number, (_, image) in enumerate(sides):
        page.paste(Image.fromarray(image), (number * SIZE[0], _HEADING))
    _draw_scale(page, pen, _HEADING + SIZE[1] + 6)
    _write(pen, lines, _HEADING + SIZE[1] + _SCALE)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        page.save(temporary, "PNG")


def _lines(mapped: TopologyMap) -> list[str]:
    figures = mapped.figures
    first = f"distance {figures['mean_mm']:.4f} mm mean, there and back {figures['cycle_mean_mm']:.3f} mm"
    return [
        f"{first}, {figures['flipped_faces']:.0f} faces flipped, {figures['covered']:.0%} covered",
        *mapped.reasons,
    ]


def _draw_scale(page: Image.Image, pen: ImageDraw.ImageDraw, top: int) -> None:
    bar = np.tile(scale_colours(np.linspace(0, 1, 300)).astype(np.uint8), (24, 1, 1))
    page.paste(Image.fromarray(bar), (60, top))
    font = ImageFont.load_default(26)
    pen.text((16, top - 4), "0", _INK, font)
    pen.text((368, top - 4), f"{LIMIT_MM:g} mm; grey: left out; blue: flipped", _INK, font)


def _write(pen: ImageDraw.ImageDraw, lines: Sequence[str], top: int) -> None:
    for number, line in enumerate(lines):
        pen.text((16, top + _ROW * number), line, _INK if not number else _BAD, ImageFont.load_default(26))
