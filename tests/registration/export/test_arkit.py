"""ARKit's shapes move what their names say, on the subject's side that they name, in the model's own basis."""

from pathlib import Path

import numpy as np
import pytest

from coregister.first_model.build import bootstrap
from registration.errors import InputError
from registration.export.arkit import LEAST_COVERAGE, NAMES, arkit_shapes
from registration.export.arkit_anatomy import Anatomy, lid_aperture
from registration.export.head_mesh import HeadMesh
from registration.export.options import ExportOptions
from registration.export.registrations import head_of_model, with_arkit
from registration.model import gnm_npz, regions
from tests.conftest import SHARED
from tests.registration.export.heads import DATA

GNM = SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz"


class Solved:
    """A model's template with its shapes."""

    def __init__(self, file: Path):
        self.data = gnm_npz.read(file)
        self.points = self.data.template_vertex_positions.astype(np.float64)
        self.mirror = self.data.mirror_indices
        self.head = Anatomy.of(self.data, self.points)
        self.found = arkit_shapes(self.data, self.points)

    def moves_mm(self, name: str, area: str | np.ndarray) -> np.ndarray:
        """The mean displacement of an area of the subject's left or middle."""
        rows = self.head.areas[area] if isinstance(area, str) else area
        return 1e3 * self.found.shapes[name].displacement[rows].mean(0)


@pytest.fixture(scope="module", params=["gnm", "first"])
def solved(request: pytest.FixtureRequest) -> Solved:
    if request.param == "gnm" and not GNM.is_file():
        pytest.skip("no folder 'shared' beside the repository")
    return Solved(GNM if request.param == "gnm" else bootstrap())


@pytest.mark.slow
def test_all_52_are_there_with_their_coverage(solved: Solved) -> None:
    assert len(NAMES) == len(set(NAMES)) == 52
    assert [*solved.found.shapes, *solved.found.missing] == list(NAMES)  # both models express all
    for shape in solved.found.shapes.values():
        assert LEAST_COVERAGE <= shape.coverage <= 1 and shape.residual_mm < 7 and shape.elsewhere_mm < 1.0


@pytest.mark.slow
def test_blinks_close_the_lids_of_their_side_only(solved: Solved) -> None:
    head, shapes = solved.head, solved.found.shapes
    left = lid_aperture(head, solved.points + shapes["eyeBlinkLeft"].displacement)
    assert left < 0.12 * head.aperture
    assert lid_aperture(head, solved.points + shapes["eyeBlinkRight"].displacement) > 0.97 * head.aperture
    assert lid_aperture(head, solved.points + shapes["eyeWideLeft"].displacement) > 1.15 * head.aperture
    assert lid_aperture(head, solved.points + shapes["eyeSquintLeft"].displacement) < 0.85 * head.aperture
    skin = np.flatnonzero(regions.skin(solved.data))
    closed = solved.points + shapes["eyeBlinkLeft"].displacement
    radius = np.linalg.norm(closed[head.upper_lid] - head.eye_centre, axis=1)
    ball = np.linalg.norm(solved.points[head.eyeball] - head.eye_centre, axis=1).max()
    assert radius.min() > ball - 2.5e-3 and len(skin)  # the cornea, which bulges, may come through a little


@pytest.mark.slow
def test_the_jaw_opens_with_its_teeth_and_closing_brings_the_lips_together(solved: Solved) -> None:
    assert solved.moves_mm("jawOpen", "lower_teeth")[1] < -8 and solved.moves_mm("jawOpen", "lower_lip")[1] < -10
    assert solved.moves_mm("jawOpen", "chin")[1] < -10 and abs(solved.moves_mm("jawOpen", "upper_lip")[1]) < 4
    opened = solved.moves_mm("jawOpen", "lower_edge") - solved.moves_mm("jawOpen", "upper_edge")
    closed = opened + solved.moves_mm("mouthClose", "lower_edge") - solved.moves_mm("mouthClose", "upper_edge")
    assert opened[1] < -7 and abs(closed[1]) < 0.15 * abs(opened[1])
    assert np.abs(solved.moves_mm("mouthClose", "lower_teeth")).max() < 2.0
    assert solved.moves_mm("jawForward", "lower_teeth")[2] > 3.5 and solved.moves_mm("jawLeft", "lower_teeth")[0] > 4
    assert solved.moves_mm("jawRight", "lower_teeth")[0] < -4


@pytest.mark.slow
def test_places_go_where_the_names_say(solved: Solved) -> None:
    for name, area, axis, least in (
        ("mouthSmileLeft", "corner", 1, 5.0),
        ("mouthSmileLeft", "corner", 0, 4.0),
        ("mouthFrownLeft", "corner", 1, -5.0),
        ("mouthStretchLeft", "corner", 0, 4.0),
        ("mouthDimpleLeft", "corner", 2, -2.5),
        ("mouthPucker", "corner", 0, -4.0),
        ("mouthPucker", "upper_lip", 2, 2.0),
        ("mouthFunnel", "lower_lip", 2, 2.0),
        ("mouthLeft", "lower_lip", 0, 5.0),
        ("mouthRight", "lower_lip", 0, -5.0),
        ("mouthRollLower", "lower_edge", 2, -1.2),
        ("mouthRollUpper", "upper_lip", 2, -1.0),
        ("mouthShrugLower", "chin", 1, 2.0),
        ("mouthShrugUpper", "upper_lip", 1, 1.0),
        ("mouthLowerDownLeft", "lower_lip", 1, -1.5),
        ("mouthUpperUpLeft", "upper_lip", 1, 1.0),
        ("browDownLeft", "left_brow", 1, -2.0),
        ("browOuterUpLeft", "left_brow", 1, 2.0),
        ("browInnerUp", "middle_brow", 1, 1.5),
        ("cheekPuff", "left_cheek", 0, 1.5),
        ("cheekSquintLeft", "left_infraorbital", 1, 1.0),
        ("noseSneerLeft", "nose", 1, 0.2),
    ):
        assert np.sign(least) * solved.moves_mm(name, area)[axis] > abs(least), (name, solved.moves_mm(name, area))
    tongue = solved.head.areas["tongue"]
    tip = tongue[solved.points[tongue, 2] > np.quantile(solved.points[tongue, 2], 0.95)]
    assert solved.moves_mm("tongueOut", tip)[2] > 10


@pytest.mark.slow
def test_eyes_turn_to_the_side_that_is_named(solved: Solved) -> None:
    iris = solved.head.eyeball[solved.points[solved.head.eyeball, 2].argmax()]
    directions = {"Up": (1, 1), "Down": (1, -1), "In": (0, -1), "Out": (0, 1)}
    for direction, (axis, sign) in directions.items():
        left = solved.found.shapes[f"eyeLook{direction}Left"].displacement
        right = solved.found.shapes[f"eyeLook{direction}Right"].displacement
        assert 3e-3 < sign * left[iris, axis] < 9e-3 and np.abs(right[iris]).max() < 1e-4
        other = right[solved.mirror[iris], axis]
        assert sign * (other if axis == 1 else -other) > 3e-3


@pytest.mark.slow
def test_pairs_are_mirror_images_and_the_rest_is_symmetric(solved: Solved) -> None:
    for name, shape in solved.found.shapes.items():
        image = shape.displacement[solved.mirror] * (-1, 1, 1)
        if name.endswith("Left"):
            other = solved.found.shapes[name.removesuffix("Left") + "Right"].displacement
            assert np.abs(image - other).max() < 5e-4, name
        elif not name.endswith("Right"):
            assert np.abs(image - shape.displacement).max() < 2e-4, name


@pytest.mark.slow
def test_shapes_of_the_skin_lie_in_the_models_basis_or_its_mirror_image(solved: Solved) -> None:
    modes = regions.expression_modes(solved.data)
    own, image = (solved.data.expression_basis[modes[f"{side}_eye"]].astype(np.float64) for side in ("left", "right"))
    basis = np.concatenate([own, image[:, solved.mirror] * (-1, 1, 1)]).reshape(len(own) + len(image), -1)
    for name in ("eyeBlinkLeft", "browDownLeft"):
        moves = solved.found.shapes[name].displacement.reshape(-1)
        inside = basis.T @ np.linalg.lstsq(basis.T, moves, rcond=None)[0]
        assert np.abs(inside - moves).max() < 1e-6


@pytest.mark.slow
def test_shapes_of_a_turned_head_turn_with_it(solved: Solved) -> None:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec([0.2, 0.9, -0.1])
    plain = head_of_model(solved.data, name="head", shapes={})
    turned = HeadMesh(name="head", vertices=2 * turn.apply(plain.vertices), topology=plain.topology)
    found, notes = with_arkit(turned, solved.data, ExportOptions(arkit=True, frame="world"), scale=2.0)
    assert "52 of ARKit's 52 shapes" in notes[0] and found.shape_figures["jawOpen"]["coverage"] > 0.9
    expected = 2 * turn.apply(solved.found.shapes["jawOpen"].displacement)
    np.testing.assert_allclose(found.shapes["jawOpen"], expected, atol=1e-4)


def test_a_model_without_edges_of_lids_and_lips_is_refused() -> None:
    with pytest.raises(InputError, match="ARKit"):
        arkit_shapes(DATA, DATA.template_vertex_positions)
