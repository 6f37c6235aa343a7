"""Read and write a stabilized set as a folder on disk (docs/formats.md, "Stabilized set")."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from registration.frames import compact
from registration.stabilize.components import RegionalComponents
from registration.stabilize.pipeline import StabilizedSubject
from registration.storage.files import atomic_directory, refuse_foreign
from registration.storage.hashing import hash_arrays
from registration.storage.npz import Kind, NpzSchema
from registration.storage.records import Record, structure

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
# Of each region, in the order in which they are hashed: field of `RegionalComponents` -> array name, kind, axes.
_COMPONENT_ARRAYS: dict[str, tuple[str, Kind, str]] = {
    "rows": ("rows", "integer", "R"),
    "modes": ("modes", "float", "K R 3"),
    "coefficients": ("coefficients", "float", "S K"),
    "energy": ("energy", "float", "K"),
    "twists": ("twists", "float", "K 6"),
    "rigid_fit_r2": ("rigid_share", "float", "K"),
    "rigid_size_ratio": ("rigid_size", "float", "K"),
    "label_independence": ("free_of_label", "float", "K"),
    "shared_motion": ("shared", "float", "K"),
    "flagged": ("flagged", "bool", "K"),
    "reference_twists": ("steady_twists", "float", "2 K 6"),
}
_MEAN_DISPLACEMENT: tuple[str, Kind, str] = ("along", "float", "K V 3")  # of each region, in `StoredComponents`


@dataclass(frozen=True, kw_only=True)
class StabilizationFigures:
    """The figures of a stabilized set."""

    samples: int
    residual_first_median_mm: float | None
    residual_median_mm: float
    residual_p95_mm: float
    components: Mapping[str, int]  # region -> number
    flagged: Mapping[str, tuple[int, ...]]  # region -> numbers of components
    regional_rms_mm: float
    regional_most_mm: float
    regional_turn_deg: float


@dataclass(frozen=True, kw_only=True)
class StabilizedManifest(Record, kind=KIND, schema=1, title=_TITLE, fix=_FIX):
    """`manifest.json` of a stabilized set."""

    content_id: str  # sha256 of the arrays of all files
    input_hash: str  # sha256 of inputs, settings and decisions
    dataset: str  # sha256 of inputs and settings, without decisions
    subjects: tuple[str, ...]  # in the order of their files
    left_out: Mapping[str, tuple[str, ...]]  # subject -> excluded registrations
    decisions: tuple[Mapping[str, Any], ...]  # as `to_jsonable` returns them
    figures: Mapping[str, Any]  # of `StabilizationFigures`
    config: Mapping[str, Any]  # the settings, as `to_jsonable` returns them
    inputs: Mapping[str, str]  # name -> sha256
    versions: Mapping[str, str]

    @classmethod
    def from_json(cls, value: Any, *, where: object) -> "StabilizedManifest":
        """Read a manifest from a JSON value. Raises InputError as `Record.read`, and for other figures than ours."""
        manifest = super().from_json(value, where=where)
        structure(manifest.figures, StabilizationFigures, where=f"{where}, figures", title=_TITLE, fix=_FIX)
        return manifest


@dataclass(frozen=True, kw_only=True)
class StoredComponents:
    """The contents of `components.npz`, which an operator reviews: S samples of all subjects."""

    components: tuple[RegionalComponents, ...]
    subjects: tuple[str, ...]  # of each sample, as names and labels
    names: tuple[str, ...]
    labels: tuple[str, ...]
    # Region -> mean displacement of the whole head per unit coefficient of each component, metres, the head frame.
    mean_displacement: Mapping[str, Float[np.ndarray, "K V 3"]]


def check_output_folder(out: Path) -> None:
    """Refuse an output folder that `gnmreg stabilize` did not write.

    Args:
        out: where a stabilized set is to be written. A missing or an empty folder is accepted.

    Raises:
        InputError: the folder holds anything else.
    """
    refuse_foreign(Path(out), kind=KIND, command="stabilize", files=_FILES)


def is_stabilized(out: Path) -> bool:
    """Return whether a folder holds the manifest of a stabilized set, of any schema version."""
    return StabilizedManifest.is_ours(Path(out) / MANIFEST)


def read_manifest(out: Path) -> StabilizedManifest:
    """Read the manifest of a stabilized set.

    Args:
        out: the set's folder.

    Returns:
        Its record.

    Raises:
        InputError: no manifest, one of another kind or schema version, or a field that is missing or of a wrong type.
    """
    return StabilizedManifest.read(Path(out) / MANIFEST)


@contextmanager
def new_stabilized_set(out: Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes the stabilized set when the block ends without an error.

    Args:
        out: the set's folder; an existing set is replaced in one step.

    Yields:
        The temporary folder, with an empty folder for the subjects.

    Raises:
        InputError: as `check_output_folder`.
    """
    check_output_folder(out)
    with atomic_directory(out) as temporary:
        (temporary / SUBJECTS).mkdir()
        yield temporary


def write_subject(subject: StabilizedSubject, folder: Path, number: int) -> str:
    """Write a subject to `subjects/NNNN.npz`: numbered, since its name may not be a valid file name.

    Args:
        subject: after either stage.
        folder: of the set.
        number: index of the subject in the set.

    Returns:
        The content id of its arrays.
    """
    arrays = {name: getattr(subject, name) for name in _SUBJECT_ARRAYS}
    for name in ("confidence_map", "residual_mm"):
        arrays[name] = arrays[name].astype(np.float32)
    for name in ("neutral", "vertices"):
        arrays[name] = compact(arrays[name])
    texts = {name: np.array(getattr(subject, name)) for name in ("subject", "names", "labels")}
    np.savez(folder / SUBJECTS / f"{number:04d}.npz", allow_pickle=False, **arrays, **texts)
    return hash_arrays(*arrays.values())


def read_subject(folder: Path, number: int) -> StabilizedSubject:
    """Read what `write_subject` wrote.

    Args:
        folder: of the set.
        number: index of the subject in the set.

    Returns:
        The subject.

    Raises:
        InputError: its file is missing or damaged.
    """
    arrays = _SUBJECT.read(folder / SUBJECTS / f"{number:04d}.npz")
    return StabilizedSubject(
        subject=str(arrays["subject"]),
        names=tuple(arrays["names"].tolist()),
        labels=tuple(arrays["labels"].tolist()),
        **{name: arrays[name] for name in _SUBJECT_ARRAYS},
    )


def write_components(stored: StoredComponents, folder: Path) -> str:
    """Write `components.npz`.

    Args:
        stored: components and samples.
        folder: of the set.

    Returns:
        The content id of its arrays.
    """
    arrays: dict[str, np.ndarray] = {}
    for part in stored.components:
        for name, (key, _, _) in _COMPONENT_ARRAYS.items():
            value = getattr(part, name)
            arrays[f"{part.region}_{key}"] = value.astype(np.float32) if name == "modes" else value
        arrays[f"{part.region}_{_MEAN_DISPLACEMENT[0]}"] = stored.mean_displacement[part.region].astype(np.float32)
    texts = {name: np.array(getattr(stored, name)) for name in ("subjects", "names", "labels")}
    regions = np.array([part.region for part in stored.components])
    np.savez(folder / COMPONENTS, allow_pickle=False, regions=regions, **texts, **arrays)
    return hash_arrays(*arrays.values())


def read_components(folder: Path) -> StoredComponents:
    """Read what `write_components` wrote.

    Args:
        folder: of the set.

    Returns:
        Components and samples.

    Raises:
        InputError: the file is missing or damaged.
    """
    file = folder / COMPONENTS
    arrays = _COMPONENTS.read(file)
    regions = arrays["regions"].tolist()
    for region in regions:
        expected = (*_COMPONENT_ARRAYS.values(), _MEAN_DISPLACEMENT)
        fields = {f"{region}_{key}": (kind, axes) for key, kind, axes in expected}
        schema = NpzSchema(title=_TITLE, fix=_FIX, fields=fields, finite=False)
        if (defect := schema.find_defect(arrays)) is not None:
            raise schema.error(defect, file)
    return StoredComponents(
        components=tuple(
            RegionalComponents(
                region=region, **{name: arrays[f"{region}_{key}"] for name, (key, _, _) in _COMPONENT_ARRAYS.items()}
            )
            for region in regions
        ),
        subjects=tuple(arrays["subjects"].tolist()),
        names=tuple(arrays["names"].tolist()),
        labels=tuple(arrays["labels"].tolist()),
        mean_displacement={region: arrays[f"{region}_{_MEAN_DISPLACEMENT[0]}"] for region in regions},
    )
