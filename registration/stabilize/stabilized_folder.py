"""A stabilized set <-> its folder on disk. Files and fields are described in docs/formats.md."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.stabilize.components import Components
from registration.stabilize.pipeline import StabilizedSubject
from registration.storage.files import atomic_directory, read_json_of_kind, refuse_foreign
from registration.storage.hashing import hash_arrays, to_jsonable

SCHEMA = 1
KIND = "gnm-stabilized"
MANIFEST, PAGE, COMPONENTS, SUBJECTS = "manifest.json", "index.html", "components.npz", "subjects"
_FILES = (MANIFEST, PAGE, COMPONENTS, SUBJECTS)
_SUBJECT_ARRAYS = ("neutral", "T_neutral_expression", "vertices", "confidence_map", "residual_mm", "T_head_world")
_COMPONENT_ARRAYS = (
    *("rows", "modes", "coefficients", "energy", "twists", "rigid_share", "rigid_size", "free_of_label", "shared"),
    *("flagged", "steady_twists"),
)


@dataclass(frozen=True, kw_only=True)
class StoredComponents:
    """What a person looks at: read from `components.npz`."""

    components: tuple[Components, ...]
    subjects: tuple[str, ...]  # of every sample, as the next two
    names: tuple[str, ...]
    labels: tuple[str, ...]
    along: Mapping[str, Float[np.ndarray, "K V 3"]]  # region -> what the whole head does along with a coefficient of 1


def check_out(out: Path) -> None:
    """Refuse, before any work, a folder that is not ours to replace. Raises InputError."""
    refuse_foreign(Path(out), kind=KIND, command="stabilize", files=_FILES)


def is_stabilized(out: Path) -> bool:
    """Whether the folder holds a manifest that we wrote."""
    return read_json_of_kind(out / MANIFEST, KIND) is not None


def read_manifest(out: Path) -> dict[str, Any]:
    """Raises InputError for a folder that is not ours, or of another schema version."""
    manifest = read_json_of_kind(out / MANIFEST, KIND)
    if manifest is None:
        raise _unreadable(out, expected=f'{MANIFEST} with "kind": "{KIND}"', got="none")
    if manifest.get("schema") != SCHEMA:
        raise _unreadable(out / MANIFEST, expected=f"schema {SCHEMA}", got=manifest.get("schema"))
    return manifest


@contextmanager
def fresh_set(out: Path) -> Iterator[Path]:
    """As `artifacts.atomic_directory`, for a stabilized set. Raises InputError as `check_out`."""
    check_out(out)
    with atomic_directory(out) as fresh:
        (fresh / SUBJECTS).mkdir()
        yield fresh


def write_subject(subject: StabilizedSubject, folder: Path, number: int) -> str:
    """Writes `subjects/NNNN.npz`; returns the content id of its arrays. A subject's name may be no file's."""
    arrays = {name: getattr(subject, name) for name in _SUBJECT_ARRAYS}
    for name in ("neutral", "vertices", "confidence_map", "residual_mm"):
        arrays[name] = arrays[name].astype(np.float32)
    texts = {name: np.array(getattr(subject, name)) for name in ("subject", "names", "labels")}
    np.savez(folder / SUBJECTS / f"{number:04d}.npz", allow_pickle=False, **arrays, **texts)
    return hash_arrays(*arrays.values())


def read_subject(folder: Path, number: int) -> StabilizedSubject:
    """Raises InputError for a file that is missing or damaged."""
    arrays = _read(folder / SUBJECTS / f"{number:04d}.npz", (*_SUBJECT_ARRAYS, "subject", "names", "labels"))
    return StabilizedSubject(
        subject=str(arrays["subject"]),
        names=tuple(arrays["names"].tolist()),
        labels=tuple(arrays["labels"].tolist()),
        **{name: arrays[name] for name in _SUBJECT_ARRAYS},
    )


def write_components(stored: StoredComponents, folder: Path) -> str:
    """Writes `components.npz`; returns the content id of its arrays."""
    arrays: dict[str, np.ndarray] = {}
    for part in stored.components:
        for name in _COMPONENT_ARRAYS:
            value = getattr(part, name)
            arrays[f"{part.region}_{name}"] = value.astype(np.float32) if name == "modes" else value
        arrays[f"{part.region}_along"] = stored.along[part.region].astype(np.float32)
    texts = {name: np.array(getattr(stored, name)) for name in ("subjects", "names", "labels")}
    regions = np.array([part.region for part in stored.components])
    np.savez(folder / COMPONENTS, allow_pickle=False, regions=regions, **texts, **arrays)
    return hash_arrays(*arrays.values())


def read_components(folder: Path) -> StoredComponents:
    """Raises InputError for a file that is missing or damaged."""
    file = folder / COMPONENTS
    arrays = _read(file, ("regions", "subjects", "names", "labels"))
    regions = arrays["regions"].tolist()
    if missing := [f"{r}_{name}" for r in regions for name in _COMPONENT_ARRAYS if f"{r}_{name}" not in arrays]:
        raise _unreadable(file, expected=f"the array {missing[0]!r}", got="no such array")
    return StoredComponents(
        components=tuple(
            Components(region=r, **{name: arrays[f"{r}_{name}"] for name in _COMPONENT_ARRAYS}) for r in regions
        ),
        subjects=tuple(arrays["subjects"].tolist()),
        names=tuple(arrays["names"].tolist()),
        labels=tuple(arrays["labels"].tolist()),
        along={r: arrays[f"{r}_along"] for r in regions},
    )


def write_manifest(manifest: Mapping[str, Any], folder: Path) -> None:
    text = json.dumps(to_jsonable({"kind": KIND, "schema": SCHEMA, **manifest}), indent=1, allow_nan=False) + "\n"
    (folder / MANIFEST).write_text(text, encoding="utf-8")


def _read(file: Path, needed: tuple[str, ...]) -> dict[str, np.ndarray]:
    try:
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # whatever a broken file makes zipfile, zlib and numpy raise
        raise _unreadable(file, expected="an undamaged NPZ file", got=f"{type(error).__name__}: {error}") from error
    if missing := [name for name in needed if name not in arrays]:
        raise _unreadable(file, expected=f"the array {missing[0]!r}", got="no such array")
    return arrays


def _unreadable(where: object, *, expected: object, got: object) -> InputError:
    return InputError(
        "The stabilized set cannot be read",
        where=where,
        expected=expected,
        got=got,
        fix="run `gnmreg stabilize` again",
    )
