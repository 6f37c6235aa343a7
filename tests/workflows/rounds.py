"""Small datasets of tiny heads whose truth is known, and a stand-in for `register` that returns it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from registration.capture.native import read_capture
from registration.capture.scan import read_truth
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.options import RegisterOptions
from registration.storage.hashing import hash_capture, input_hash
from registration.storage.registration_folder import find_existing, save_registration
from registration.types import Registration
from tests.registration.capture import small
from tests.registration.register import synthetic
from tests.registration.report.test_page import a_registration

MODEL = synthetic.MODEL
ACTS = {"smile": 3, "jaw": 4}  # expression -> its component in the tiny model


def head(data: GNMData, seed: int) -> np.ndarray:
    """Return the vertices of a random head outside the model's span."""
    rng = np.random.default_rng(seed)
    basis = data.vertex_identity_basis.astype(np.float64)
    wave = 1e-3 * np.sin(data.template_vertex_positions / 0.03 + rng.uniform(0, 6, 3))
    return data.template_vertex_positions + np.tensordot(rng.normal(size=len(basis)), basis, 1) + wave


def head_pose(seed: int, what: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation and translation of a head in its capture."""
    rng = np.random.default_rng([seed, *what.encode()])
    return Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix(), rng.normal(0, 0.05, 3)


def write_person(capture: Path, folder: Path, seed: int, acts: tuple[str, ...] = ("smile",), **tags: object) -> None:
    """Write a subject's captures: images of a ball, and true vertices of a tiny head."""
    data = gnm_npz.read(MODEL)
    neutral = head(data, seed)
    for act in ("neutral", *acts):
        root = folder / act
        shutil.copytree(capture, root, ignore=shutil.ignore_patterns("scan.ply"))
        fields = {"subject": folder.name, "expression": act, "units": "m", **tags}
        lines = [f"{name} = {json.dumps(value)}" for name, value in fields.items()]
        classes = f"[segmentation]\nclasses = {json.dumps(small.CLASSES)}\n"
        (root / "capture.toml").write_text("\n".join([*lines, "", classes]))
        vertices = neutral + (data.expression_basis[ACTS[act]] if act in ACTS else 0)
        rotation, translation = head_pose(seed, act)
        np.savez(root / "ground_truth.npz", vertices=vertices @ rotation.T + translation)


def write_people(capture: Path, dataset: Path, count: int, held: int = 2, acts: tuple[str, ...] = ("smile",)) -> Path:
    """Write subjects p0, p1, ...; the last ones are tagged as held out."""
    for k in range(count):
        tags = {"age": 20 + 10 * k} | ({"held_out": True} if k >= count - held else {})
        write_person(capture, dataset / f"p{k}", k, acts, **tags)
    return dataset


class TrueRegister:
    """Stand-in for `register`: returns an existing result, else the true vertices or the given outcome."""

    def __init__(self) -> None:
        self.outcomes: dict[str, BaseException | Callable[[np.ndarray], np.ndarray]] = {}  # SUBJECT/CAPTURE
        self.figures: dict[str, dict[str, object]] = {}  # SUBJECT/CAPTURE -> figures besides the usual ones
        self.outputs: list[Path] = []

    def __call__(self, capture: Path, model: Path, out: Path, options: RegisterOptions, **_: object) -> Registration:
        data, parsed = gnm_npz.read(model), read_capture(capture)
        inputs = {"capture": hash_capture(parsed), "model": gnm_npz.content_hash(data)}
        config = {"recipe": options.recipe, "views": options.views, "seed": options.seed}
        if (same := find_existing(out, input_hash(inputs, config))) is not None:
            return same
        outcome = self.outcomes.get("/".join(capture.parts[-2:]))
        if isinstance(outcome, BaseException):
            raise outcome
        assert parsed.ground_truth is not None
        vertices = read_truth(parsed.ground_truth)
        vertices = vertices if outcome is None else outcome(vertices)
        rotation, translation = head_pose(int(parsed.subject[1:]), parsed.expression)
        result = a_registration(
            identity=np.zeros(len(data.vertex_identity_basis), np.float32),
            expression=np.zeros(len(data.expression_basis), np.float32),
            rotations=np.zeros((len(data.joint_names), 3), np.float32),
            vertices=vertices.astype(np.float32),
            offsets=((vertices - translation) @ rotation - data.template_vertex_positions).astype(np.float32),
            confidence=np.full(len(vertices), 0.5, np.float32),
            triangles=data.triangles.astype(np.int32),
            corner_uvs=np.zeros((len(data.triangles), 3, 2), np.float32),
            inputs=inputs,
            config=config,
        )
        more = self.figures.get("/".join(capture.parts[-2:]), {})
        result = replace(result, figures={**result.figures, **more})
        save_registration(result, out, "<html></html>")
        self.outputs.append(out)
        return result
