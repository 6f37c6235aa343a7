"""Registrations of one subject get the teeth that they show together. The tiny head, posed; nothing is fitted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from registration.anatomy.own_parts import FIGURE, OwnParts
from registration.model import gnm_numpy
from registration.storage.registration_folder import load_registration, read_manifest, save_registration
from registration.types import Camera, Capture, View
from tests.registration.anatomy.test_own_parts import data, parts  # noqa: F401  fixtures
from tests.registration.storage.test_registration_folder import a_registration
from workflows.steps.own_parts import share_own_parts


def _capture(name: str) -> Capture:
    views = []
    for number, x in enumerate((-0.2, 0.0, 0.2)):
        pose = np.diag([1.0, -1, -1, 1])
        pose[:3, 3] = -pose[:3, :3] @ np.array([x, 0.25, 1.0])
        intrinsics = np.array([[300.0, 0, 100], [0, 300, 100], [0, 0, 1]])
        camera = Camera(width_px=200, height_px=200, intrinsics=intrinsics, T_cam_world=pose)
        views.append(View(name=f"cam{number}", camera=camera, image=Path("none.png")))
    return Capture(root=Path(name), subject="anna", expression=name, views=tuple(views))


def _registration(data, teeth, placed=0.0):  # noqa: F811
    count = len(data.vertex_identity_basis) - 3
    values = {
        "identity": np.array([0.1] * count + teeth),
        "expression": np.zeros(len(data.expression_basis)),
        "rotations": np.zeros((len(data.joint_names), 3)),
        "translation": np.zeros(3),
        "offsets": np.zeros(data.template_vertex_positions.shape),
    }
    parts = OwnParts.of(data)  # noqa: F811
    values["offsets"][parts.vertices] = 0.5 * placed * parts.placements[4]  # both arches upwards
    vertices = gnm_numpy.evaluate(data, scale=1.0, **values)
    return a_registration(
        **{name: value.astype(np.float32) for name, value in values.items()},
        scale=np.array(1.0, np.float32),
        vertices=vertices.astype(np.float32),
        triangles=data.triangles.astype(np.int32),
        confidence=np.ones(len(vertices), np.float32),
        corner_uvs=np.zeros((len(data.triangles), 3, 2), np.float32),
        landmarks={},
        figures={},
    )


@pytest.fixture
def shared(tmp_path, data, parts, monkeypatch):  # noqa: F811
    seen = {"neutral": np.zeros(len(parts.vertices), np.int64), "smile": np.full(len(parts.vertices), 500)}
    by_teeth = {0.0: "neutral", 1.5: "smile"}

    def views(vertices, triangles, cameras, points):
        found = next(name for name, teeth in by_teeth_vertices.items() if np.allclose(vertices, teeth, atol=1e-6))
        return seen[found]

    folders = {}
    by_teeth_vertices = {}
    for value, name in by_teeth.items():
        registration = _registration(data, [value] * 3, value)
        by_teeth_vertices[name] = registration.vertices.astype(np.float64)
        folders[save_registration(registration, tmp_path / name, "<html></html>")] = _capture(name)
    monkeypatch.setattr("workflows.steps.own_parts.views_that_see", views)
    return folders


def test_all_captures_get_what_those_that_saw_the_teeth_found(shared, data, parts):  # noqa: F811
    before = {folder: load_registration(folder) for folder in shared}
    digests = {folder: read_manifest(folder).input_hash for folder in shared}
    written = share_own_parts(shared, data, {})
    assert set(written) == set(shared)
    for folder in shared:
        after = load_registration(folder)
        assert np.allclose(after.identity[parts.components], 1.5, rtol=1e-2)
        shift = after.offsets[parts.vertices] - 0.75 * parts.placements[4]
        assert np.abs(shift).max() < 2e-5
        others = np.setdiff1d(np.arange(len(after.vertices)), parts.vertices)
        assert np.array_equal(after.vertices[others], before[folder].vertices[others])
        assert np.array_equal(after.texture, before[folder].texture)
        assert read_manifest(folder).input_hash == digests[folder]
        assert set(after.figures[FIGURE]["from"]) == {"neutral", "smile"}
    found = {folder.name: load_registration(folder).figures[FIGURE] for folder in shared}
    assert found["smile"]["placed"] == pytest.approx([0.0] * 4 + [1.5e-3] + [0.0] * 7, abs=1e-6)
    neutral = next(folder for folder in shared if folder.name == "neutral")
    assert load_registration(neutral).figures[FIGURE]["alone"] == [0.0, 0.0, 0.0]


def test_shared_teeth_are_not_shared_again(shared, data):  # noqa: F811
    share_own_parts(shared, data, {})
    contents = {folder: read_manifest(folder).content_id for folder in shared}
    assert share_own_parts(shared, data, {}) == {}
    assert {folder: read_manifest(folder).content_id for folder in shared} == contents


def test_a_capture_that_is_registered_later_takes_part(shared, data, parts):  # noqa: F811
    first, second = shared
    assert share_own_parts({first: shared[first]}, data, {}) == {}
    share_own_parts(shared, data, {})
    again = replace(_registration(data, [1.5] * 3, 1.5), reason="registered again")
    save_registration(again, second, "<html></html>")
    written = share_own_parts(shared, data, {})
    assert np.allclose(written[first].identity, written[second].identity)
    assert written[first].figures[FIGURE]["alone"] == [0.0, 0.0, 0.0]


def test_models_without_such_components_change_nothing(shared, data, parts):  # noqa: F811
    skin_alone = replace(
        data,
        vertex_identity_basis=np.delete(data.vertex_identity_basis, parts.components, 0),
        joint_identity_basis=np.delete(data.joint_identity_basis, parts.components, 0),
        identity_names=np.delete(data.identity_names, parts.components),
    )
    assert not len(OwnParts.of(skin_alone).components)
    assert share_own_parts(shared, skin_alone, {}) == {}
