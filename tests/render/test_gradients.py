"""The renderer's gradient, cell by cell, against central differences; the table is printed also when all is well."""

import pytest

from registration.render import backend
from tests.conftest import needs_shared
from tests.render import gradient_table

LIMIT = 0.03


@pytest.mark.parametrize(
    "rows", [gradient_table.tiny_rows, pytest.param(gradient_table.real_rows, marks=needs_shared)], ids=["tiny", "real"]
)
def test_every_cell_is_within_three_percent(rows, capsys):
    backend.activate()
    table = dict(gradient_table.table(rows()))
    with capsys.disabled():
        for name, cells in table.items():
            print("", name, *cells, sep="\n")
    cells = [cell for scene in table.values() for cell in scene]
    pairs = [
        (motion, channel)
        for motion in ("translation", "rotation", "scale", "bump")
        for channel in gradient_table.CHANNELS
    ]
    assert sorted((c.motion, c.channel) for c in cells) == sorted([*pairs, ("texels", "rgb")])
    assert not [str(c) for c in cells if c.standard_error > gradient_table.STANDARD_ERROR]
    assert not [str(c) for c in cells if not abs(c.error) < LIMIT]
