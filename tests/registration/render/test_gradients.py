"""The renderer's gradient, cell by cell, against central differences; the table is printed also when all is well."""

import pytest

from registration.render import backend
from tests.conftest import needs_shared
from tests.registration.render import gradient_table

LIMIT = 0.03


@pytest.mark.parametrize(
    "file",
    [gradient_table.TINY, pytest.param(gradient_table.REAL, marks=[needs_shared, pytest.mark.slow])],
    ids=["tiny", "real"],
)
def test_every_cell_is_within_three_percent(file, capsys):
    backend.activate()
    cells = gradient_table.table(gradient_table.head(file, file.name))
    with capsys.disabled():
        print("", file.name, *cells, sep="\n")
    pairs = [
        (motion, channel)
        for motion in ("translation", "rotation", "scale", "bump")
        for channel in gradient_table.CHANNELS
    ]
    assert sorted((c.motion, c.channel) for c in cells) == sorted([*pairs, ("texels", "rgb")])
    assert not [str(c) for c in cells if c.standard_error > gradient_table.STANDARD_ERROR]
    assert not [str(c) for c in cells if not abs(c.error) < LIMIT]
