"""Describe a linear model in the terminal."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from registration import terminal
from registration.frames import MM_PER_M
from registration.linear_models.data import LinearModelData
from registration.linear_models.options import ReadOptions
from registration.linear_models.registry import FORMATS, read


def describe(path: Path, options: ReadOptions | None = None, console: Console | None = None) -> LinearModelData:
    """Read a model of any format and print what it is: licence, counts, unit, size, joints, remarks.

    Args:
        path: its file or folder.
        options: of reading.
        console: to print to; None: the terminal.

    Raises:
        InputError: it cannot be read.
    """
    console = console or terminal.console()
    data = read(path, options)
    console.print(Text.assemble((str(path), "bold"), f"  {data.name}: {FORMATS[data.format].title}"))
    size = np.ptp(data.template, axis=0) * MM_PER_M
    table = Table(box=None, pad_edge=False, show_header=False)
    for name, value in (
        ("vertices", f"{len(data.template):,}"),
        ("triangles", f"{len(data.triangles):,}"),
        ("identity", f"{len(data.identity_basis):,}"),
        ("expression", f"{len(data.expression_basis):,}"),
        ("joints", ", ".join(data.joints.names)),
        ("pose correctives", "yes" if data.joints.correctives is not None else "none"),
        ("unit of the file", f"{data.unit_m:g} m"),
        ("template", f"{size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm"),
        ("licence", data.licence),
    ):
        table.add_row(name, Text(value, overflow="fold"))
    console.print(table)
    for remark in data.remarks:
        console.print(Text(f"note: {remark}"))
    console.print("For the comparison of models, not for registration.")
    return data
