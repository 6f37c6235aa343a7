"""What `gnmreg model info` draws and says of a model's anatomy."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from registration.anatomy.eye_structure import find_eyes
from registration.anatomy.panels import anatomy_panels
from registration.model import info
from registration.model.gnm_npz import GNMData


def test_every_part_has_a_panel_and_a_line(any_model: GNMData, tmp_path: Path) -> None:
    panels, notes = anatomy_panels(any_model)
    assert [panel.title for panel in panels] == [
        "optical axes",
        "upper teeth, FDI numbers",
        "lower teeth, FDI numbers",
        "tongue: centre line and tip",
    ]
    assert notes[0].startswith("eyes: sclera 14.60 mm") and notes[2].startswith("tongue: 5")
    eyes = find_eyes(any_model)
    start, end = panels[0].lines[0]
    assert np.linalg.norm(np.cross(end - start, eyes.left.axis)) < 1e-12
    assert {"11", "27"} <= set(panels[1].names) and {"31", "47"} <= set(panels[2].names)
    info.draw(any_model, tmp_path / "model.png", {}, panels)
    assert (tmp_path / "model.png").stat().st_size > 50_000


def test_a_part_that_is_not_found_is_said(first_model: GNMData) -> None:
    groups = first_model.vertex_groups.copy()
    groups[first_model.vertex_group_names.tolist().index("pupils")] = 0
    panels, notes = anatomy_panels(replace(first_model, vertex_groups=groups))
    assert len(panels) == 3 and notes[0].startswith("eyes: not found: The vertex groups of the eyes")
