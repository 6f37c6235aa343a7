"""Rendering of this package's templates."""

from collections.abc import Sequence
from typing import Any

from registration.report.heat_map import SIDES, SIZE, render_heat_map
from registration.report.inputs import HeatMap
from registration.report.pictures import data_uri
from registration.report.templates import environment


def render(template: str, **context: Any) -> str:
    """Return a page: a template of `workflows/pages/templates` with these values, all of them escaped."""
    return environment("workflows.pages").get_template(template).render(context)


def heat_images(
    heat: HeatMap, limit_mm: float, *, sides: Sequence[str] = tuple(SIDES), size: tuple[int, int] = SIZE
) -> list[tuple[str, str]]:
    """Return (side, data URI) of a heat map's images of `size` (width, height) px; the scale ends at `limit_mm`."""
    return [(side, data_uri(image)) for side, image in render_heat_map(heat, limit_mm, sides=sides, size=size)]
