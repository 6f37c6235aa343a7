"""A picture of where a fit stands, to be looked at when a registration went wrong: one after each stage."""

from pathlib import Path

import numpy as np
from PIL import Image

from registration.frames import linear_to_srgb
from registration.report.inputs import ReportView


def write_stage(file: Path, views: tuple[ReportView, ...]) -> Path:
    """One PNG: a row for each view of the target, the rendering, where their colours differ (x 4), and its normals."""
    rows = []
    for view in views:
        target, drawn = linear_to_srgb(view.target_rgb), linear_to_srgb(view.rendered_rgb)
        difference = np.abs(target - drawn) * view.compared[..., None] * 4
        rows.append(np.concatenate([target, drawn, difference, 0.5 + 0.5 * view.rendered_normals], axis=1))
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((np.clip(np.nan_to_num(sheet), 0, 1) * 255).astype(np.uint8)).save(file)
    return file
