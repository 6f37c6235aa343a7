import numpy as np
import pytest

from coregister.anatomy.tongue_rig import CONTROLS, KINDS, TongueRig
from registration.anatomy.tongue_structure import find_tongue
from registration.model import gnm_npz
from tests.fixtures.make_fixtures import HERE

FULL = {"curl": 40, "bend": 40, "twist": 40, "roll": 50, "groove": 2, "protrusion": 8, "shift": 6, "raise": 6}
FULL["width"] = 0.25


@pytest.fixture(scope="module")
def rig():
    return TongueRig(structure=find_tongue(gnm_npz.read(HERE / "tiny_gnm.npz")))


def controls(**values):
    return np.array([values.get(name, 0.0) for name in CONTROLS])


def test_zero_is_the_template(rig):
    assert np.array_equal(rig.pose(np.zeros(len(CONTROLS))), rig.structure.rest)


@pytest.mark.parametrize("name", CONTROLS)
@pytest.mark.parametrize("sign", (-1, 1))
def test_the_attachment_stays_and_the_volume_changes_little(rig, name, sign):
    posed = rig.pose(controls(**{name: sign * FULL[name.split("_")[0]]}))
    moved = np.linalg.norm(posed - rig.structure.rest, axis=1)
    assert moved[rig.structure.attached].max() < 1e-12 and moved.max() > 0.5e-3
    assert rig.volume_ratio(posed) == pytest.approx(1, abs=0.12)
    if name.endswith("tip"):
        assert moved[rig.structure.share < 0.5].max() == 0


def test_controls_move_the_tip_where_they_say(rig):
    tip, rest = rig.structure.tip, rig.structure.rest

    def moved(**values):
        return (rig.pose(controls(**values)) - rest)[tip]

    assert moved(curl_body=30)[1] > 5e-3 and moved(curl_tip=30)[1] > 1e-3
    assert moved(bend_body=30)[0] > 5e-3 and moved(bend_tip=-30)[0] < -1e-3
    assert moved(protrusion_body=6, protrusion_tip=2) == pytest.approx(8e-3 * rig.forward, abs=1e-5)
    assert moved(shift_body=3, shift_tip=-1) == pytest.approx([2e-3, 0, 0], abs=1e-9)
    assert moved(raise_tip=4) == pytest.approx(4e-3 * rig.up, abs=1e-9)


def test_sections_change_their_shape_as_they_say(rig):
    shape, rest = rig.structure, rig.structure.rest
    ring = np.abs(shape.share - 0.8) < 0.1
    left, middle = ring & (shape.lateral > 0.5 * shape.lateral[ring].max()), ring & (np.abs(shape.lateral) < 1e-4)

    def rise(part, **values):
        return float((rig.pose(controls(**values)) - rest)[part].mean(0) @ rig.up)

    assert rise(left, roll_body=50) > 0.5e-3 > abs(rise(middle, roll_body=50))
    assert rise(middle & shape.dorsum, groove_body=2) < -0.5e-3
    assert rise(left, twist_body=40) < -1e-3
    wide = rig.pose(controls(width_body=0.2))
    assert np.ptp(wide[ring, 0]) > 1.1 * np.ptp(rest[ring, 0])


def test_mirrored_controls_give_the_mirrored_pose(rig):
    values = {f"{kind}_{part}": 0.4 * FULL[kind] for kind in KINDS for part in ("body", "tip")}
    other = {name: -x if name.split("_")[0] in ("bend", "twist", "shift") else x for name, x in values.items()}
    mirrored = rig.pose(controls(**values))[rig.structure.mirror] * (-1, 1, 1)
    assert np.abs(mirrored - rig.pose(controls(**other))).max() < 1e-9
