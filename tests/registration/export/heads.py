"""Registrations of the tiny head by formula, without a fit, and a plain reader of GLB files."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.storage.registration_folder import save_registration
from registration.types import Registration
from tests.conftest import FIXTURES
from workflows.records.subject import CaptureRow, SubjectRecord

MODEL = FIXTURES / "tiny_gnm.npz"
DATA = gnm_npz.read(MODEL)
TURN, SHIFT = Rotation.from_rotvec([0.5, -0.8, 0.3]), np.array([0.7, -0.3, 1.1])  # T_world_head
_TYPES = {5126: "<f4", 5125: "<u4", 5123: "<u2"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def a_registration(expression: int | None = None, **changes: Any) -> Registration:
    """A head that differs from the template by a mode of its identity, and one of its expression, in a turned world."""
    bind = DATA.template_vertex_positions + 0.5 * DATA.vertex_identity_basis[0].astype(np.float32)
    if expression is not None:
        bind = bind + DATA.expression_basis[expression].astype(np.float32)
    count = len(bind)
    fields: dict[str, Any] = dict(
        status="converged",
        reason="the mesh is at rest",
        identity=np.zeros(len(DATA.vertex_identity_basis), np.float32),
        expression=np.zeros(len(DATA.expression_basis), np.float32),
        rotations=np.zeros((4, 3), np.float32),
        translation=SHIFT.astype(np.float32),
        scale=np.array(1, np.float32),
        offsets=np.zeros((count, 3), np.float32),
        vertices=(TURN.apply(bind) + SHIFT).astype(np.float32),
        triangles=DATA.triangles.astype(np.int32),
        confidence=np.ones(count, np.float32),
        texture=np.random.default_rng(0).random((64, 64, 3)).astype(np.float32),
        corner_uvs=texture_atlas(DATA),
        inputs={"model": gnm_npz.content_hash(DATA)},
        provenance={"model": str(MODEL)},
    )
    return Registration(**{**fields, **changes})


def a_subject(folder: Path, expressions: Mapping[str, int] = {"brow": 0, "jaw": 3}, **failed: str) -> Path:  # noqa: B006
    """Write a subject's folder: a neutral, and expressions (name -> mode) whose heads are turned against it.

    Args:
        folder: to write.
        expressions: by the folder's name; the label is the name with "_label".
        failed: name -> status of further rows, without a registration.
    """
    a_folder(folder / "neutral")
    rows = [CaptureRow(name="neutral", expression="neutral", status="converged", folder="neutral")]
    for number, (name, mode) in enumerate(expressions.items(), 1):
        registration = a_registration(mode)
        turn = Rotation.from_rotvec([0, 0.05 * number, 0.02])
        moved = turn.apply(registration.vertices - SHIFT) + SHIFT + 0.01 * number
        save_registration(replace(registration, vertices=moved.astype(np.float32)), folder / name)
        rows.append(CaptureRow(name=name, expression=f"{name}_label", status="converged", folder=name))
    rows += [CaptureRow(name=name, expression=name, status=status, reason="why") for name, status in failed.items()]
    model = gnm_npz.content_hash(DATA)
    record = SubjectRecord(subject="anna", model=model, recipe="draft", neutral="neutral", rows=tuple(rows))
    record.write(folder / "subject.json")
    return folder


def a_folder(path: Path, expression: int | None = None, **changes: Any) -> Path:
    """Write a registration."""
    return save_registration(a_registration(expression, **changes), path)


class Glb:
    """A GLB file, read from the format's description."""

    def __init__(self, content: bytes):
        assert content[:4] == b"glTF" and int.from_bytes(content[8:12], "little") == len(content)
        length = int.from_bytes(content[12:16], "little")
        self.json = json.loads(content[20 : 20 + length])
        assert content[24 + length : 28 + length] == b"BIN\0"
        self._body = content[28 + length :]

    def view(self, number: int) -> bytes:
        view = self.json["bufferViews"][number]
        assert view["byteOffset"] % 4 == 0
        return self._body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def array(self, number: int) -> np.ndarray:
        accessor = self.json["accessors"][number]
        shape = (accessor["count"], _WIDTHS[accessor["type"]])
        kind = _TYPES[accessor["componentType"]]
        if "bufferView" in accessor:
            array = np.frombuffer(self.view(accessor["bufferView"]), kind).reshape(shape).copy()
        else:
            array = np.zeros(shape, kind)
        if sparse := accessor.get("sparse"):
            rows = np.frombuffer(self.view(sparse["indices"]["bufferView"]), _TYPES[sparse["indices"]["componentType"]])
            array[rows] = np.frombuffer(self.view(sparse["values"]["bufferView"]), kind).reshape(-1, shape[1])
        if "min" in accessor:
            np.testing.assert_allclose(array.min(0), accessor["min"], atol=1e-7)
            np.testing.assert_allclose(array.max(0), accessor["max"], atol=1e-7)
        return array[:, 0] if shape[1] == 1 else array

    def whole(self, values: str, count: int, target: int | None = None) -> np.ndarray:
        """A vertex attribute in the model's order, by the file's own map; of a morph target if its number is given."""
        found = np.full((count, 3), np.nan)
        for primitive in self.json["meshes"][0]["primitives"]:
            vertex = self.array(primitive["attributes"]["_VERTEX"]).astype(int)
            source = primitive["attributes"] if target is None else primitive["targets"][target]
            found[vertex] = self.array(source[values])
        return found
