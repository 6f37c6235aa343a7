"""Texels that no camera saw get the colours of where they come from, and are marked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from registration.export.fill import FILLED, fill_unseen
from registration.export.head_mesh import Topology
from registration.export.registrations import head_of_registration, with_filled_texture
from registration.export.write import check_out, write
from registration.geometry.texels import texels
from registration.model import regions
from registration.types import Registration
from tests.registration.export.heads import DATA, a_registration

MIRROR = DATA.mirror_indices.astype(int)
TOPOLOGY = Topology.from_model(DATA)
SIZE = 256
KNOWN = texels(DATA.triangles, a_registration().corner_uvs, SIZE)
POINTS = DATA.template_vertex_positions.astype(np.float64)
SKIN = regions.skin(DATA)
# A face that is symmetric but for a slope to one side; all of it smooth.
TRUTH = 0.4 + POINTS @ np.array([[0.5, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])


def painted(colours: np.ndarray, seen: np.ndarray, blank: float = 0.9) -> Registration:
    """A registration with a colour at each vertex, `blank` where a face has an unseen corner."""
    at_texels = KNOWN.interpolate(colours, DATA.triangles)
    at_texels[~seen[DATA.triangles[KNOWN.face]].all(1)] = blank
    return a_registration(texture=KNOWN.image(at_texels, blank).astype(np.float32), confidence=seen.astype(np.float32))


def of_face(image: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """The texels of the faces between some vertices."""
    return image.reshape(SIZE * SIZE, -1)[KNOWN.index][vertices[DATA.triangles[KNOWN.face]].all(1)]


def truth_of(vertices: np.ndarray, colours: np.ndarray = TRUTH) -> np.ndarray:
    return KNOWN.interpolate(colours, DATA.triangles)[vertices[DATA.triangles[KNOWN.face]].all(1)]


def test_seen_texels_stay_and_all_others_are_marked() -> None:
    seen = SKIN & (POINTS[:, 1] > np.median(POINTS[SKIN, 1]))
    registration = painted(TRUTH, seen)
    filled = fill_unseen(registration, TOPOLOGY, MIRROR)
    np.testing.assert_array_equal(of_face(filled.texture, seen), of_face(registration.texture, seen))
    inside = seen[DATA.triangles[KNOWN.face]].all(1)
    marks = filled.unseen.reshape(-1)
    assert (marks[KNOWN.index[inside]] == 0).all() and (marks[KNOWN.index[~inside]] == FILLED).all()
    assert np.count_nonzero(marks == 0) == inside.sum()


def test_another_registration_comes_first_and_its_exposure_does_not_show() -> None:
    seen = SKIN & (POINTS[:, 2] > np.quantile(POINTS[SKIN, 2], 0.3))
    darker = painted(TRUTH - 0.08, np.ones_like(seen))
    filled = fill_unseen(painted(TRUTH, seen), TOPOLOGY, MIRROR, [darker])
    wrong = np.abs(of_face(filled.texture, SKIN & ~seen) - truth_of(SKIN & ~seen))
    assert wrong.max() < 0.01 and filled.shares["registration 1"] > 0.9
    eyes = regions.eyeballs(DATA)[0]  # nothing of them was seen: nothing says that they are darker there
    np.testing.assert_allclose(of_face(filled.texture, eyes), truth_of(eyes, TRUTH - 0.08), atol=1e-4)


def test_the_other_side_fills_one_side() -> None:
    seen = SKIN & (POINTS[:, 0] < 0.02)
    filled = fill_unseen(painted(TRUTH, seen), TOPOLOGY, MIRROR)
    symmetric = TRUTH[MIRROR]
    hidden = SKIN & ~seen & SKIN[MIRROR]
    got, plain = of_face(filled.texture, hidden), truth_of(hidden, symmetric)
    assert np.abs(got[:, 1:] - plain[:, 1:]).max() < 0.03  # colours that are equal on both sides
    assert filled.shares["the other side"] > 0.3 and not np.isclose(got, 0.9).all(1).any()


def test_surroundings_go_on_smoothly_and_unknown_materials_keep_their_colours() -> None:
    back = POINTS[:, 2] < np.quantile(POINTS[SKIN, 2], 0.3)
    registration = painted(np.full_like(TRUTH, 0.3), SKIN & ~back)
    filled = fill_unseen(registration, TOPOLOGY, MIRROR)
    np.testing.assert_allclose(of_face(filled.texture, SKIN), 0.3, atol=1e-5)
    np.testing.assert_allclose(of_face(filled.texture, regions.tongue(DATA)), 0.9, atol=1e-6)
    assert filled.shares["nothing"] > 0.05 and sum(filled.shares.values()) == pytest.approx(1)
    one_eye = SKIN | regions.eyeballs(DATA)[0]
    both = fill_unseen(painted(np.where(SKIN[:, None], TRUTH, 0.7), one_eye), TOPOLOGY, MIRROR)
    np.testing.assert_allclose(of_face(both.texture, regions.eyeballs(DATA)[1]), 0.7, atol=1e-5)


def test_the_mask_is_written_beside_every_format_that_has_a_texture(tmp_path: Path) -> None:
    registration = painted(TRUTH, SKIN)
    head = head_of_registration(registration, DATA, name="anna")
    filled, notes = with_filled_texture(head, registration, MIRROR, [("bob", painted(TRUTH, SKIN))])
    assert "nothing: their colours are kept" in notes[0]
    for suffix in (".obj", ".glb", ".usda"):
        files = write(filled, tmp_path / f"head{suffix}")
        assert tmp_path / "head_unseen.png" in files and all(file.is_file() for file in files)
    with pytest.raises(InputError, match="exists"):
        check_out(tmp_path / "head.usdz", replace=False, filled=True)  # head_unseen.png
    check_out(tmp_path / "head.usdz", replace=False)
    with pytest.raises(InputError, match="no texture"):
        check_out(tmp_path / "head.ply", replace=True, filled=True)


def test_registrations_of_another_topology_or_atlas_are_refused() -> None:
    registration = painted(TRUTH, SKIN)
    head = head_of_registration(registration, DATA, name="anna")
    for change, message in (
        ({"triangles": registration.triangles[::-1]}, "another topology"),
        ({"corner_uvs": registration.corner_uvs * np.float32(0.5)}, "another texture atlas"),
    ):
        with pytest.raises(InputError, match=message):
            with_filled_texture(head, registration, MIRROR, [("other", replace(registration, **change))])
