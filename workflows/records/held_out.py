"""What `gnmreg model evaluate` is given: held-out subjects, as registrations of a run or as meshes in one NPZ file."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from coregister.evaluate.evaluation import NEUTRAL, HeldOutSubject
from registration.capture.native import natural_key, read_capture
from registration.capture.scan import read_scan
from registration.errors import InputError
from registration.evaluate.evaluation import CLOUD_TOLERANCE
from registration.evaluate.face import face_ball, seen
from registration.stabilize import stabilized_folder as stabilized
from registration.storage.hashing import hash_arrays, hash_capture
from registration.storage.registration_folder import load_registration
from registration.types import Registration
from workflows.records.run import STABILIZED
from workflows.records.subject import MANIFEST, USABLE

TAG = "tag_"  # prefix of an NPZ file's tags
_CATEGORY = "category"
_FIX = "see docs/formats.md, Held-out subjects"


@dataclass(frozen=True, kw_only=True)
class HeldOutSet:
    """Subjects, the topology of their meshes, and digests of what they were read from."""

    subjects: tuple[HeldOutSubject, ...]
    triangles: Int[np.ndarray, "F 3"]
    inputs: Mapping[str, str]


def read_held_out(source: Path, captures: Path | None = None) -> HeldOutSet:
    """The subjects of an NPZ file or of a run of `gnmreg subject`, with expressions where the run was stabilized.

    `captures`: the folder of the run's subjects, each with its captures: adds tags, categories and scans.

    Raises:
        InputError: nothing there; a file, registration or capture that cannot be read; a subject without one neutral.
    """
    source = Path(source)
    if not source.is_dir():
        found = _of_file(source)
        return replace(found, inputs={"held_out": hash_arrays(*_arrays(found.subjects))})
    files = sorted(source.glob(f"*/{MANIFEST}"), key=lambda file: natural_key(file.parent.name))
    if not files:
        raise _bad("There are no held-out subjects", source, f"folders with {MANIFEST}, or an NPZ file", "none")
    expressions = _stabilized(source / STABILIZED)
    subjects, topologies, inputs = [], [], {}
    for file in files:
        one, registration, name = _of_folder(file)
        if one.subject in expressions:
            one = replace(one, **expressions[one.subject])
        if captures is not None:
            folder = Path(captures) / file.parent.name
            one = _with_captures(one, folder, registration, name)
            inputs[f"capture {one.subject}"] = hash_capture(read_capture(folder / name))
        subjects.append(one)
        topologies.append(registration.triangles)
    if other := [s.subject for s, t in zip(subjects, topologies, strict=True) if not np.array_equal(t, topologies[0])]:
        got = f"another of {other[0]}"
        raise _bad("The held-out subjects have different topologies", source, "one topology", got)
    inputs["held_out"] = hash_arrays(*_arrays(subjects))
    return HeldOutSet(subjects=tuple(subjects), triangles=topologies[0], inputs=inputs)


def _arrays(subjects: tuple[HeldOutSubject, ...] | list[HeldOutSubject]) -> list[np.ndarray]:
    texts = [
        np.array([s.subject, *s.categories, json.dumps(dict(s.tags), sort_keys=True, default=str)]) for s in subjects
    ]
    return [array for s, text in zip(subjects, texts, strict=True) for array in (s.neutral, s.expressions, text)]


def _of_file(file: Path) -> HeldOutSet:
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # whatever a broken file makes zipfile, zlib and numpy raise
        got = f"{type(error).__name__}: {error}"
        raise _bad("The held-out meshes cannot be read", file, "an NPZ file of plain arrays", got) from error
    needed = ("vertices", "triangles", "subjects", "labels")
    if missing := [name for name in needed if name not in arrays]:
        raise _bad("The held-out meshes are incomplete", file, f"the arrays {', '.join(needed)}", f"no {missing[0]}")
    vertices, triangles = arrays["vertices"], arrays["triangles"]
    if vertices.ndim != 3 or vertices.shape[2] != 3 or vertices.dtype.kind != "f":
        got = f"{vertices.dtype} {vertices.shape}"
        raise _bad("The held-out meshes are no meshes", f"{file}, vertices", "floats (N, V, 3)", got)
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        got = f"{triangles.dtype} {triangles.shape}"
        raise _bad("The held-out meshes are no meshes", f"{file}, triangles", "integers (F, 3)", got)
    per_mesh = ["subjects", "labels", *(n for n in arrays if n.startswith(TAG) or n == "categories")]
    for name in per_mesh:
        if arrays[name].shape != (len(vertices),):
            got = f"shape {arrays[name].shape}"
            raise _bad("The held-out meshes are incomplete", f"{file}, {name}", f"{len(vertices)} entries", got)
    subjects = arrays["subjects"].astype(str)
    names = dict.fromkeys(subjects.tolist())
    found = tuple(_of_rows(name, np.flatnonzero(subjects == name), arrays, file) for name in names)
    return HeldOutSet(subjects=found, triangles=triangles.astype(np.int64), inputs={})


def _of_rows(subject: str, rows: Int[np.ndarray, "M"], arrays: Mapping[str, np.ndarray], file: Path) -> HeldOutSubject:
    labels = arrays["labels"].astype(str)
    neutral = [int(row) for row in rows if labels[row] == NEUTRAL]
    if len(neutral) != 1:
        got = f"{len(neutral)} of {subject}"
        raise _bad("A held-out subject has not one neutral", file, f'one mesh labelled "{NEUTRAL}" a subject', got)
    others = [int(row) for row in rows if row != neutral[0]]
    categories = arrays.get("categories", labels).astype(str)
    return HeldOutSubject(
        subject=subject,
        neutral=arrays["vertices"][neutral[0]],
        expressions=arrays["vertices"][others],
        categories=tuple(categories[others].tolist()),
        tags={n.removeprefix(TAG): v[neutral[0]].item() for n, v in arrays.items() if n.startswith(TAG)},
    )


def _of_folder(file: Path) -> tuple[HeldOutSubject, Registration, str]:
    """A subject's neutral, its registration and the name of its folder."""
    try:
        manifest: dict[str, Any] = json.loads(file.read_text("utf-8"))
        subject, neutral = str(manifest["subject"]), str(manifest["neutral"])
        status = {str(row["name"]): str(row["status"]) for row in manifest["captures"]}[neutral]
    except (OSError, ValueError, KeyError, TypeError) as error:
        got = f"{type(error).__name__}: {error}"
        raise _bad("The subject's record cannot be read", file, "entries as documented", got) from error
    if status not in USABLE:
        raise _bad("A held-out subject has no neutral", file, f"a usable registration {neutral!r}", status)
    registration = load_registration(file.parent / neutral)
    vertices = registration.vertices
    return HeldOutSubject(subject=subject, neutral=vertices, expressions=vertices[None][:0]), registration, neutral


def _stabilized(folder: Path) -> dict[str, dict[str, Any]]:
    """By subject: neutral, expressions and their labels, in one frame. Empty if the run was not stabilized."""
    if not stabilized.is_stabilized(folder):
        return {}
    count = len(stabilized.read_manifest(folder)["subjects"])
    subjects = (stabilized.read_subject(folder, number) for number in range(count))
    return {
        one.subject: {"neutral": one.neutral, "expressions": one.vertices, "categories": one.labels} for one in subjects
    }


def _with_captures(one: HeldOutSubject, folder: Path, registration: Registration, neutral: str) -> HeldOutSubject:
    """Tags and scan of the neutral's capture, and the categories of expressions whose captures tell one."""
    capture = read_capture(folder / neutral)
    told = {}
    for place in sorted(path.parent for path in folder.glob("*/capture.toml")):
        other = read_capture(place)
        told[other.expression] = str(other.tags.get(_CATEGORY, other.expression))
    scan: Float[np.ndarray, "P 3"] | None = None
    if capture.scan is not None:
        points = read_scan(capture.scan)
        cameras = [view.camera for view in capture.views]
        face = face_ball(capture, registration).holds(points.vertices)
        surface = points if len(points.triangles) else registration
        slack = () if len(points.triangles) else (CLOUD_TOLERANCE,)
        face &= seen(points.vertices, surface.vertices.astype(np.float64), surface.triangles, cameras, *slack)
        scan = points.vertices[face].astype(np.float64)
    categories = tuple(told.get(label, label) for label in one.categories)
    return replace(one, tags=capture.tags, categories=categories, scan=scan)


def _bad(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=_FIX)
