"""The input of `gnmreg stabilize`: subject folders as `gnmreg subject` writes them."""

import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registration.capture.native import natural_key
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.fetch import cached_path
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin, SubjectMeshes, subject_meshes
from registration.storage.cache import cache_folder
from registration.storage.files import read_json_of_kind
from registration.storage.registration_folder import load_registration, read_manifest
from workflows.records.subject import KIND, MANIFEST, USABLE

STABILIZED = "stabilized"  # the folder of the stabilized set within a run


@dataclass(frozen=True, kw_only=True)
class RunSubject:
    """One subject folder: what is stabilized, by (folder name, expression)."""

    folder: Path
    subject: str
    neutral: str
    expressions: tuple[tuple[str, str], ...]
    left_out: tuple[str, ...]  # names of registrations that are no use


@dataclass(frozen=True, kw_only=True)
class Run:
    """Subjects, checked as far as headers tell."""

    subjects: tuple[RunSubject, ...]
    inputs: Mapping[str, str]  # SUBJECT/NAME -> content id of its registration; model
    skin: SkullSkin

    def meshes(self) -> Iterator[SubjectMeshes]:
        """Subject after subject. Raises InputError for registrations that cannot be read."""
        for one in self.subjects:
            expressions = ((name, label, load_registration(one.folder / name)) for name, label in one.expressions)
            yield subject_meshes(one.subject, load_registration(one.folder / one.neutral), expressions, self.skin)


def read_run(folder: Path, data: GNMData, *, skip_failed: bool = False, only: Collection[str] | None = None) -> Run:
    """The subjects in a folder of subject folders, or the one whose folder it is, in the order of their folders' names.

    `only`: names of the folders that count, if not all do.

    Raises:
        InputError: no subject; one without a usable neutral or without expressions; two of one name; registrations that
            failed or are missing, unless `skip_failed` leaves them out; of another topology than the model; not finite.
    """
    skin, wanted = SkullSkin.of(data), gnm_npz.topology_hash(data.triangles)
    folders = [path for path in _subject_folders(folder) if only is None or path.name in only]
    subjects = tuple(_subject(path, skip_failed) for path in folders)
    inputs = {"model": gnm_npz.content_hash(data)}
    for one in subjects:
        for name in (one.neutral, *(name for name, _ in one.expressions)):
            key = f"{one.subject}/{name}"
            if key in inputs:
                raise InputError(
                    "Two folders hold the same subject",
                    where=folder,
                    expected="one folder a subject",
                    got=one.subject,
                    fix="move one of them away, or correct `subject` in its capture.toml files",
                )
            inputs[key] = read_manifest(one.folder / name).content_id
            _check_arrays(one.folder / name, wanted, data)
    return Run(subjects=subjects, inputs=inputs, skin=skin)


def known_model(run: Path) -> Path:
    """The first or the official model in the cache, if it is what the run's registrations were made with.

    Raises InputError if it is not, and as `read_run` for a run without subjects.
    """
    manifest = json.loads((_subject_folders(run)[0] / MANIFEST).read_text("utf-8"))
    wanted = str(manifest.get("model"))
    for file in (cached_path(), *sorted(cache_folder().glob("first-*/*.npz"))):
        if file.is_file() and gnm_npz.content_hash(gnm_npz.read(file)) == wanted:
            return file
    raise InputError(
        "The head model of these registrations is not known here",
        where=run,
        expected="the first or the official model, or the model's file",
        got=f"a model of sha256 {wanted[:16]}",
        fix="say where it is with --model",
    )


def _subject_folders(folder: Path) -> list[Path]:
    folder = Path(folder)
    below = [folder] if _is_subject(folder) else []
    if not below and folder.is_dir():
        below = [path for path in folder.iterdir() if not path.name.startswith(".") and _is_subject(path)]
    if not below:
        raise InputError(
            "There are no subjects to stabilize",
            where=folder,
            expected=f"a folder of subject folders with {MANIFEST}, or one such folder",
            got="none" if folder.is_dir() else "no such folder",
            fix="give the folder that holds what `gnmreg subject ... --out` wrote",
        )
    return sorted(below, key=lambda path: natural_key(path.name))


def _is_subject(folder: Path) -> bool:
    return read_json_of_kind(folder / MANIFEST, KIND) is not None


def _subject(folder: Path, skip_failed: bool) -> RunSubject:
    manifest = json.loads((folder / MANIFEST).read_text("utf-8"))
    try:
        rows: list[dict[str, Any]] = manifest["captures"]
        neutral = str(manifest["neutral"])
        named = {str(row["name"]): (str(row["expression"]), str(row["status"]), str(row["reason"])) for row in rows}
        subject = str(manifest["subject"])
    except (KeyError, TypeError) as error:
        raise _bad("The subject's record cannot be read", folder / MANIFEST, "entries as documented", error) from error
    _, status, reason = named.get(neutral, ("", "no such registration", ""))
    if status not in USABLE:
        raise _bad("A subject has no neutral", folder, f"a usable registration {neutral!r}", f"{status} {reason}")
    lost = {name: why for name, (_, state, why) in named.items() if state not in USABLE}
    if lost and not skip_failed:
        first = next(iter(lost))
        got = f"{first}: {named[first][1]}: {lost[first]}" + (f", and {len(lost) - 1} more" if len(lost) > 1 else "")
        raise _bad("A subject has registrations that failed", folder, "all converged or stopped", got)
    expressions = tuple((name, label) for name, (label, _, _) in named.items() if name != neutral and name not in lost)
    if not expressions:
        raise _bad("A subject has no expression to stabilize", folder, "at least one beside the neutral", "none")
    return RunSubject(
        folder=folder, subject=subject, neutral=neutral, expressions=expressions, left_out=tuple(sorted(lost))
    )


def _check_arrays(folder: Path, topology: str, data: GNMData) -> None:
    """What can be told without textures: before anything is computed, and in milliseconds."""
    file = folder / "registration.npz"
    try:
        with np.load(file, allow_pickle=False) as archive:
            triangles, vertices, confidence = (archive[name] for name in ("triangles", "vertices", "confidence"))
    except Exception as error:  # whatever a broken file makes zipfile, zlib and numpy raise
        raise _bad("A registration cannot be read", file, "an undamaged NPZ file", error) from error
    if gnm_npz.topology_hash(triangles) != topology:
        raise InputError(
            "A registration has another topology than the model",
            where=folder,
            expected=f"the model's {len(data.template_vertex_positions)} vertices and {len(data.triangles)} triangles",
            got=f"{len(vertices)} vertices and {len(triangles)} triangles, or another order",
            fix="register all subjects with one model, and give that one with --model",
        )
    if not (np.isfinite(vertices).all() and np.isfinite(confidence).all()):
        raise _bad("A registration is not finite", file, "finite vertices and confidence", "NaN or infinite numbers")


def _bad(what: str, where: object, expected: object, got: object) -> InputError:
    fix = "register again with `gnmreg subject`, or leave out what failed with --skip-failed"
    return InputError(what, where=where, expected=expected, got=got, fix=fix)
