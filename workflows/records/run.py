"""The input of `gnmreg stabilize`: subject folders as `gnmreg subject` writes them."""

from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.native import natural_key
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.fetch import installed_files
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes, subject_meshes
from registration.storage.cache import cache_folder
from registration.storage.registration_folder import SCHEMA, load_registration, read_manifest
from workflows.records.subject import MANIFEST, SubjectRecord, is_subject_folder, read_subject

STABILIZED = "stabilized"  # the folder of the stabilized set within a run


@dataclass(frozen=True, kw_only=True)
class StabilizationSubject:
    """The registrations of one subject folder that are stabilized."""

    folder: Path
    subject: str
    neutral: str
    expressions: tuple[tuple[str, str], ...]  # (folder name, expression)
    excluded: tuple[str, ...]  # names of unusable registrations


@dataclass(frozen=True, kw_only=True)
class StabilizationInputs:
    """The subjects of a run, checked without reading textures."""

    subjects: tuple[StabilizationSubject, ...]
    inputs: Mapping[str, str]  # SUBJECT/NAME -> content id of its registration; model
    skin: SkullSkin

    def meshes(self) -> Iterator[SubjectMeshes]:
        """Yield the meshes of each subject. Raises InputError for registrations that cannot be read."""
        for subject in self.subjects:
            folder, pairs = subject.folder, subject.expressions
            expressions = ((name, label, load_registration(folder / name)) for name, label in pairs)
            yield subject_meshes(subject.subject, load_registration(folder / subject.neutral), expressions, self.skin)


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which registrations of a run are used."""

    skip_failed: bool = False  # exclude failed registrations instead of refusing the run
    only: Collection[str] | None = None  # names of the subject folders to use; None: all
    left_out: Collection[str] = ()  # registrations that are not used, as SUBJECT/NAME of the folders; no neutrals


def read_run(folder: Path, data: GNMData, selection: Selection = Selection()) -> StabilizationInputs:  # noqa: B008
    """Read and check the subjects of a run, in natural order of their folders' names.

    Args:
        folder: holds subject folders, or is one.
        data: the model that the captures were registered with.
        selection: of subject folders and registrations.

    Raises:
        InputError: there is no subject; a `subject.json` is malformed; a subject has no usable neutral or no
            expression; two have one name; a registration failed or is missing, has another topology than the model, or
            is not finite.
    """
    skin, topology = SkullSkin.from_model(data), gnm_npz.topology_hash(data.triangles)
    folders = [path for path in _subject_folders(folder) if selection.only is None or path.name in selection.only]
    subjects = tuple(_subject(path, selection) for path in folders)
    inputs = {"model": gnm_npz.content_hash(data)}
    for subject in subjects:
        identity: np.ndarray | None = None
        for name in (subject.neutral, *(name for name, _ in subject.expressions)):
            key = f"{subject.subject}/{name}"
            if key in inputs:
                raise InputError(
                    "Two folders hold the same subject",
                    where=folder,
                    expected="one folder per subject",
                    got=subject.subject,
                    fix="move one of them, or correct `subject` in its capture.toml files",
                )
            manifest = read_manifest(subject.folder / name)
            inputs[key] = manifest.content_id
            own = _check_arrays(subject.folder / name, topology, data)
            identity = own if identity is None else identity  # the neutral comes first
            if "neutral" in manifest.inputs:
                _check_identity(subject.folder / name, own, identity, subject.neutral)
    return StabilizationInputs(subjects=subjects, inputs=inputs, skin=skin)


def known_model(run: Path) -> Path:
    """Return the cached model file that the run's captures were registered with: the first or the official model.

    Raises:
        InputError: it is neither of them; there is no subject, or its record is malformed.
    """
    content = _read(_subject_folders(run)[0]).model
    for file in (*installed_files(), *sorted(cache_folder().glob("first-*/*.npz"))):
        with suppress(InputError):  # a damaged file is not the one
            if gnm_npz.content_hash(gnm_npz.read(file)) == content:
                return file
    raise InputError(
        "The head model of these registrations is not in the cache",
        where=run,
        expected="the first or the official model, or the model's file",
        got=f"a model of sha256 {content[:16]}",
        fix="give its file with --model",
    )


def _subject_folders(folder: Path) -> list[Path]:
    folder = Path(folder)
    below = [folder] if is_subject_folder(folder) else []
    if not below and folder.is_dir():
        below = [path for path in folder.iterdir() if not path.name.startswith(".") and is_subject_folder(path)]
    if not below:
        raise InputError(
            "There are no subjects to stabilize",
            where=folder,
            expected=f"a folder of subject folders with {MANIFEST}, or one such folder",
            got="none" if folder.is_dir() else "no such folder",
            fix="give the folder that holds the output folders of `gnmreg subject`",
        )
    return sorted(below, key=lambda path: natural_key(path.name))


def _read(folder: Path) -> SubjectRecord:
    record = read_subject(folder)
    assert record is not None, "one of `_subject_folders`"
    return record


def _subject(folder: Path, selection: Selection) -> StabilizationSubject:
    record = _read(folder)
    neutral = record.row(record.neutral)
    if neutral is None or not neutral.usable:
        got = "no such registration" if neutral is None else f"{neutral.status} {neutral.reason}"
        raise _input_error("A subject has no neutral", folder, f"a usable registration {record.neutral!r}", got)
    lost = [row for row in record.rows if not row.usable]
    if lost and not selection.skip_failed:
        others = f", and {len(lost) - 1} more" if len(lost) > 1 else ""
        got = f"{lost[0].name}: {lost[0].status}: {lost[0].reason}{others}"
        raise _input_error("A subject has registrations that failed", folder, "all converged or stopped", got)
    refused = {row.name for row in record.rows if row.usable and f"{folder.name}/{row.name}" in selection.left_out}
    expressions = tuple(
        (row.name, row.expression) for row in record.rows if row.usable and row != neutral and row.name not in refused
    )
    if not expressions:
        expected = "at least one besides the neutral"
        raise _input_error("A subject has no expression to stabilize", folder, expected, "none")
    return StabilizationSubject(
        folder=folder,
        subject=record.subject,
        neutral=record.neutral,
        expressions=expressions,
        excluded=tuple(sorted({row.name for row in lost} | refused)),
    )


def _check_arrays(folder: Path, topology: str, data: GNMData) -> Float[np.ndarray, "I"]:
    """Check the arrays other than textures, in milliseconds, before anything is computed. Return the identity."""
    file = folder / "registration.npz"
    arrays = SCHEMA.read(file, only=("triangles", "vertices", "confidence", "identity"))
    triangles, vertices = arrays["triangles"], arrays["vertices"]
    if gnm_npz.topology_hash(triangles) != topology:
        raise InputError(
            "A registration has another topology than the model",
            where=folder,
            expected=f"the model's {len(data.template_vertex_positions)} vertices and {len(data.triangles)} triangles",
            got=f"{len(vertices)} vertices and {len(triangles)} triangles, or another order",
            fix="register all subjects with one model, and give that one with --model",
        )
    return arrays["identity"]


def _check_identity(
    folder: Path, identity: Float[np.ndarray, "I"], neutral: Float[np.ndarray, "J"], neutral_name: str
) -> None:
    """Refuse an expression that started from another neutral than the subject's: it would have that one's identity."""
    if identity.shape != neutral.shape or not np.allclose(identity, neutral, atol=1e-3):
        raise InputError(
            "An expression was registered from another neutral than its subject's",
            where=folder,
            expected=f"the identity of {folder.parent / neutral_name}",
            got="another identity, perhaps another person's",
            fix="register the subject again with `gnmreg subject`",
        )


def _input_error(what: str, where: object, expected: object, got: object) -> InputError:
    fix = "register again with `gnmreg subject`, or exclude failed registrations with --skip-failed"
    return InputError(what, where=where, expected=expected, got=got, fix=fix)
