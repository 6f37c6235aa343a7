"""Read and write a stabilized set as a folder on disk. Files and fields are described in docs/formats.md."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.stabilize.components import Components
from registration.stabilize.pipeline import StabilizedSubject
from registration.storage.files import atomic_directory, refuse_foreign
from registration.storage.hashing import hash_arrays
from registration.storage.npz import Kind, NpzSchema
from registration.storage.records import Record

KIND = "gnm-stabilized"
MANIFEST, PAGE, COMPONENTS, SUBJECTS = "manifest.json", "index.html", "components.npz", "subjects"
_FILES = (MANIFEST, PAGE, COMPONENTS, SUBJECTS)
_TITLE, _FIX = "stabilized set", "run `gnmreg stabilize` again"
_SUBJECT_ARRAYS = ("neutral", "T_neutral_expression", "vertices", "confidence_map", "residual_mm", "T_head_world")
_SUBJECT = NpzSchema(
    title=_TITLE,
    fix=_FIX,
    fields={
        "neutral": ("float", "V 3"),
        "T_neutral_expression": ("float", "S 4 4"),
        "vertices": ("float", "S V 3"),
        "confidence_map": ("float", "V"),
        "residual_mm": ("float", "S R"),
        "T_head_world": ("float", "4 4"),
        "subject": ("text", ""),
        "names": ("text", "S"),
        "labels": ("text", "S"),
    },
    finite=False,
)
_COMPONENTS = NpzSchema(
    title=_TITLE,
    fix=_FIX,
    fields={"regions": ("text", "N"), "subjects": ("text", "S"), "names": ("text", "S"), "labels": ("text", "S")},
)
_COMPONENT_ARRAYS: dict[str, tuple[Kind, str]] = {  # of each region: fields of `Components`
    "rows": ("integer", "R"),
    "modes": ("float", "K R 3"),
    "coefficients": ("float", "S K"),
    "energy": ("float", "K"),
    "twists": ("float", "K 6"),
    "rigid_share": ("float", "K"),
    "rigid_size": ("float", "K"),
    "free_of_label": ("float", "K"),
    "shared": ("float", "K"),
    "flagged": ("bool", "K"),
    "steady_twists": ("float", "2 K 6"),
}
_ALONG = "along"  # array of each region: a field of `StoredComponents`


@dataclass(frozen=True, kw_only=True)
class StabilizedManifest(Record, kind=KIND, schema=1, title=_TITLE, fix=_FIX):
    """`manifest.json` of a stabilized set."""

    content_id: str  # sha256 of the arrays of all files
    input_hash: str  # sha256 of inputs, settings and decisions
    dataset: str  # sha256 of inputs and settings, without decisions
    subjects: tuple[str, ...]  # in the order of their files
    left_out: Mapping[str, tuple[str, ...]]  # subject -> excluded registrations
    decisions: tuple[Mapping[str, Any], ...]  # as `to_jsonable` returns them
    figures: Mapping[str, Any]
    config: Mapping[str, Any]  # the settings, as `to_jsonable` returns them
    inputs: Mapping[str, str]  # name -> sha256
    versions: Mapping[str, str]


@dataclass(frozen=True, kw_only=True)
class StoredComponents:
    """The components that an operator reviews: `components.npz`."""

    components: tuple[Components, ...]
    subjects: tuple[str, ...]  # of every sample, as the next two
    names: tuple[str, ...]
    labels: tuple[str, ...]
    along: Mapping[str, Float[np.ndarray, "K V 3"]]  # region -> displacement of the whole head for a coefficient of 1


def check_out(out: Path) -> None:
    """Refuse, before any work, a folder that is not ours to replace. Raises InputError."""
    refuse_foreign(Path(out), kind=KIND, command="stabilize", files=_FILES)


def is_stabilized(out: Path) -> bool:
    """Return whether the folder holds a manifest that we wrote, of any schema version."""
    return StabilizedManifest.is_ours(Path(out) / MANIFEST)


def read_manifest(out: Path) -> StabilizedManifest:
    """Read the manifest of a stabilized set.

    Raises:
        InputError: no manifest, not ours, another schema version, or a field that is missing or of a wrong type.
    """
    return StabilizedManifest.read(Path(out) / MANIFEST)


@contextmanager
def new_stabilized_set(out: Path) -> Iterator[Path]:
    """Yield a new folder for a set, as `atomic_directory`. Raises InputError as `check_out`."""
    check_out(out)
    with atomic_directory(out) as temporary:
        (temporary / SUBJECTS).mkdir()
        yield temporary


def write_subject(subject: StabilizedSubject, folder: Path, number: int) -> str:
    """Write `subjects/NNNN.npz`, numbered because a subject's name may be no file name.

    Returns:
        The content id of its arrays.
    """
    arrays = {name: getattr(subject, name) for name in _SUBJECT_ARRAYS}
    for name in ("neutral", "vertices", "confidence_map", "residual_mm"):
        arrays[name] = arrays[name].astype(np.float32)
    texts = {name: np.array(getattr(subject, name)) for name in ("subject", "names", "labels")}
    np.savez(folder / SUBJECTS / f"{number:04d}.npz", allow_pickle=False, **arrays, **texts)
    return hash_arrays(*arrays.values())


def read_subject(folder: Path, number: int) -> StabilizedSubject:
    """Read what `write_subject` wrote. Raises InputError for a file that is missing or damaged."""
    arrays = _SUBJECT.read(folder / SUBJECTS / f"{number:04d}.npz")
    return StabilizedSubject(
        subject=str(arrays["subject"]),
        names=tuple(arrays["names"].tolist()),
        labels=tuple(arrays["labels"].tolist()),
        **{name: arrays[name] for name in _SUBJECT_ARRAYS},
    )


def write_components(stored: StoredComponents, folder: Path) -> str:
    """Write `components.npz`. Returns the content id of its arrays."""
    arrays: dict[str, np.ndarray] = {}
    for part in stored.components:
        for name in _COMPONENT_ARRAYS:
            value = getattr(part, name)
            arrays[f"{part.region}_{name}"] = value.astype(np.float32) if name == "modes" else value
        arrays[f"{part.region}_{_ALONG}"] = stored.along[part.region].astype(np.float32)
    texts = {name: np.array(getattr(stored, name)) for name in ("subjects", "names", "labels")}
    regions = np.array([part.region for part in stored.components])
    np.savez(folder / COMPONENTS, allow_pickle=False, regions=regions, **texts, **arrays)
    return hash_arrays(*arrays.values())


def read_components(folder: Path) -> StoredComponents:
    """Read what `write_components` wrote. Raises InputError for a file that is missing or damaged."""
    file = folder / COMPONENTS
    arrays = _COMPONENTS.read(file)
    regions = arrays["regions"].tolist()
    for region in regions:
        fields = {f"{region}_{n}": kind for n, kind in {**_COMPONENT_ARRAYS, _ALONG: ("float", "K V 3")}.items()}
        schema = NpzSchema(title=_TITLE, fix=_FIX, fields=fields, finite=False)
        if (defect := schema.find_defect(arrays)) is not None:
            raise schema.error(defect, file)
    return StoredComponents(
        components=tuple(
            Components(region=r, **{name: arrays[f"{r}_{name}"] for name in _COMPONENT_ARRAYS}) for r in regions
        ),
        subjects=tuple(arrays["subjects"].tolist()),
        names=tuple(arrays["names"].tolist()),
        labels=tuple(arrays["labels"].tolist()),
        along={r: arrays[f"{r}_{_ALONG}"] for r in regions},
    )
