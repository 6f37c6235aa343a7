"""A `Registration` <-> its folder on disk. The files and fields are described in docs/formats.md.

A folder appears, or is replaced, in one rename; its content id is a digest of its arrays, checked on reading.
"""

import json
import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from registration.errors import InputError
from registration.frames import linear_to_srgb, srgb_to_linear
from registration.storage.files import atomic_directory, atomic_write_text, has_kind, write_json
from registration.storage.hashing import content_id, input_hash, versions
from registration.storage.mesh import write_obj, write_ply
from registration.types import Registration

SCHEMA = 1
KIND = "gnm-registration"
FILES = (
    "manifest.json",
    "history.json",
    "registration.npz",
    "mesh.ply",
    "mesh.obj",
    "mesh.mtl",
    "texture.png",
    "report.html",
)
# Axis letters of the arrays in registration.npz; one letter is one length within a file.
AXES = {
    "identity": "I",
    "expression": "E",
    "rotations": "J 3",
    "translation": "3",
    "scale": "",
    "offsets": "V 3",
    "vertices": "V 3",
    "triangles": "F 3",
    "confidence": "V",
    "corner_uvs": "F 3 2",
}
LANDMARKS = "landmarks_"  # prefix of the arrays that hold one scheme's landmarks each


def check_output_folder(out: Path) -> None:
    """Refuse, before any compute, an output folder that is not ours to replace.

    Raises:
        InputError: `out` is a file, is a folder holding anything that we did not write, or cannot be created.
    """
    out = Path(out).resolve()
    if out.exists() and not out.is_dir():
        raise _refused(out, got="a file", fix="choose another output folder")
    if out.is_dir() and (names := sorted(p.name for p in out.iterdir())):
        if not is_registration(out):
            raise _refused(out, got=f"a folder that holds {_listed(names)}", fix="choose another output folder")
        if foreign := [name for name in names if name not in FILES]:
            raise _refused(out, got=f"also {_listed(foreign)}", fix="move these files away, they would be lost")
    parent = out.parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise _refused(out, got=f"no folder can be made in {parent}", fix="choose a folder that you may write to")


def is_registration(path: Path) -> bool:
    """Whether the folder holds a manifest that we wrote, of any schema version."""
    return has_kind(Path(path) / "manifest.json", KIND)


def save_registration(registration: Registration, out: Path, report_html: str | None = None) -> Path:
    """Write the whole folder beside `out` and move it there in one rename; our former folder is replaced.

    Returns the folder. Arrays are stored as float32 (triangles int32), the texture as 16 bit sRGB.

    Raises:
        InputError: as `check_output_folder`.
        ValueError: an array is not finite or not of the documented shape; a `failed` one may hold non-finite numbers.
    """
    out = Path(out).resolve()
    check_output_folder(out)
    arrays = _arrays(registration)
    if problem := _problem(arrays, finite=registration.status != "failed"):
        raise ValueError("{}: expected {}, got {}".format(*problem))
    texture = _encode_texture(registration.texture)
    with atomic_directory(out) as fresh:
        np.savez(fresh / "registration.npz", allow_pickle=False, **arrays)
        _write_png(fresh / "texture.png", texture)
        write_ply(fresh / "mesh.ply", arrays["vertices"], arrays["triangles"])
        write_obj(fresh / "mesh.obj", arrays["vertices"], arrays["triangles"], arrays["corner_uvs"], "texture.png")
        write_json(fresh / "history.json", registration.history)
        if report_html is not None:
            (fresh / "report.html").write_text(report_html, encoding="utf-8")
        write_json(fresh / "manifest.json", _manifest(registration, content_id(arrays, texture)))
    return out


def load_registration(path: Path) -> Registration:
    """Read a folder of `save_registration`; the texture comes back as linear float32.

    Raises:
        InputError: no folder of ours, a newer schema, a field that is missing, of a wrong shape, not finite or
            pickled, an unreadable texture, or arrays that do not have the manifest's content id.
    """
    path = Path(path)
    manifest = read_manifest(path)
    arrays = _read_arrays(path / "registration.npz")
    texture = _read_png(path / "texture.png")
    history = _read_json(path / "history.json")
    if (found := content_id(arrays, texture)) != manifest["content_id"]:
        raise InputError(
            "The registration was changed after it was written",
            where=path,
            expected=f"content id {manifest['content_id']}",
            got=found,
            fix="register again, or restore registration.npz and texture.png",
        )
    return Registration(
        status=manifest["status"],
        reason=manifest["reason"],
        **{name: arrays[name] for name in AXES},
        texture=srgb_to_linear((texture / 65535.0).astype(np.float32)),
        landmarks={name.removeprefix(LANDMARKS): a for name, a in arrays.items() if name.startswith(LANDMARKS)},
        seconds=manifest["seconds"],
        history={stage: {term: _floats(v) for term, v in terms.items()} for stage, terms in history.items()},
        figures=manifest["figures"],
        config=manifest["config"],
        inputs=manifest["inputs"],
    )


def find_existing(out: Path, wanted: str) -> Registration | None:
    """What `out` already holds if it was made from the same inputs (`input_hash`) and is intact, else None.

    Its status may be any; the caller decides whether a failure is worth another try.
    """
    try:
        return load_registration(out) if read_manifest(out)["input_hash"] == wanted else None
    except InputError:
        return None


def update_figures(path: Path, figures: Mapping[str, Any], report_html: str | None = None) -> None:
    """Add figures to a folder (same names are overwritten); each file is replaced in one rename.

    Raises:
        InputError: no folder of ours.
    """
    path = Path(path)
    manifest = read_manifest(path)
    manifest["figures"] = {**manifest["figures"], **figures}
    write_json(path / "manifest.json", manifest)
    if report_html is not None:
        atomic_write_text(path / "report.html", report_html)


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a registration folder, without reading its arrays.

    Raises:
        InputError: no manifest, not ours, an unknown schema version, or a missing entry.
    """
    file = Path(path) / "manifest.json"
    manifest = _read_json(file)
    if manifest.get("kind") != KIND:
        raise _unreadable(file, expected=f'"kind": "{KIND}"', got=repr(manifest.get("kind")))
    if manifest.get("schema") != SCHEMA:
        raise InputError(
            "The registration has another schema version",
            where=file,
            expected=SCHEMA,
            got=manifest.get("schema"),
            fix="read it with the version of gnmreg that wrote it, or register again",
        )
    needed = ("status", "reason", "content_id", "input_hash", "inputs", "figures", "config", "seconds")
    if missing := [name for name in needed if name not in manifest]:
        raise _unreadable(file, expected=f"the entry {missing[0]!r}", got="no such entry")
    return manifest


def _arrays(registration: Registration) -> dict[str, np.ndarray]:
    arrays = {name: np.asarray(getattr(registration, name), np.float32) for name in AXES if name != "triangles"}
    arrays["triangles"] = np.asarray(registration.triangles, np.int32)
    for scheme, points in registration.landmarks.items():
        arrays[LANDMARKS + scheme] = np.asarray(points, np.float32)
    return arrays


def _problem(arrays: Mapping[str, np.ndarray], finite: bool = True) -> tuple[str, str, str] | None:
    """The first field that breaks the format: (name, expected, got)."""
    lengths: dict[str, int] = {}
    marks = {name: "L 3" for name in arrays if name.startswith(LANDMARKS)}
    for name, axes in {**AXES, **marks}.items():
        letters = axes.split()
        expected = f"shape ({', '.join(str(lengths.get(a, a)) for a in letters)})"
        if name not in arrays:
            return name, expected, "no such field"
        array = arrays[name]
        if array.dtype.kind not in ("iu" if name == "triangles" else "f"):
            return name, "integers" if name == "triangles" else "floats", str(array.dtype)
        if name not in marks:
            pairs = list(zip(letters, array.shape, strict=False))
            lengths |= {a: n for a, n in pairs if not a.isdigit() and a not in lengths}
        known = [int(a) if a.isdigit() else lengths.get(a) for a in letters]
        if array.ndim != len(letters) or any(n not in (None, m) for n, m in zip(known, array.shape, strict=True)):
            return name, expected, f"shape {array.shape}"
        if finite and not np.isfinite(array).all():
            return name, "finite numbers", f"{np.count_nonzero(~np.isfinite(array))} that are not"
    triangles, count = arrays["triangles"], lengths["V"]
    if triangles.size and not (0 <= triangles.min() and triangles.max() < count):
        return "triangles", f"indices below {count}", f"{triangles.min()} to {triangles.max()}"
    return None


def _read_arrays(file: Path) -> dict[str, np.ndarray]:
    arrays, name = {}, ""
    try:
        with np.load(file, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise _unreadable(file, expected="an NPZ archive", got="a single array")
            for name in archive.files:
                arrays[name] = archive[name]
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError) as error:
        where = f"{file}, field {name!r}" if name else file
        raise _unreadable(where, expected="an NPZ archive of plain arrays", got=error) from error
    if problem := _problem(arrays):
        field, expected, got = problem
        raise _unreadable(f"{file}, field {field!r}", expected=expected, got=got)
    return arrays


def _manifest(registration: Registration, content: str) -> dict[str, Any]:
    return {
        "kind": KIND,
        "schema": SCHEMA,
        "status": registration.status,
        "reason": registration.reason,
        "content_id": content,
        "input_hash": input_hash(registration.inputs, registration.config),
        "figures": registration.figures,
        "seconds": registration.seconds,
        "inputs": registration.inputs,
        "versions": versions(),
        "config": registration.config,
    }


def _encode_texture(texture: np.ndarray) -> np.ndarray:
    return np.round(linear_to_srgb(np.nan_to_num(np.asarray(texture, np.float64))) * 65535.0).astype(np.uint16)


def _write_png(file: Path, texture: np.ndarray) -> None:
    import cv2

    if not cv2.imwrite(str(file), texture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {file}")


def _read_png(file: Path) -> np.ndarray:
    import cv2

    texture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) if file.is_file() else None
    if texture is None or texture.dtype != np.uint16 or texture.ndim != 3 or texture.shape[2] != 3:
        got = "nothing readable" if texture is None else f"{texture.dtype} of shape {texture.shape}"
        raise _unreadable(file, expected="a 16 bit RGB PNG", got=got)
    return np.ascontiguousarray(texture[..., ::-1])


def _floats(values: list[float | None]) -> list[float]:
    return [math.nan if value is None else value for value in values]


def _read_json(file: Path) -> dict[str, Any]:
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise _unreadable(file, expected="a JSON object", got=error) from error
    if not isinstance(value, dict):
        raise _unreadable(file, expected="a JSON object", got=type(value).__name__)
    return value


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _refused(out: Path, *, got: str, fix: str) -> InputError:
    return InputError(
        "The output folder cannot be used",
        where=out,
        expected="a new or empty folder, or one that gnmreg wrote",
        got=got,
        fix=fix,
    )


def _unreadable(where: object, *, expected: object, got: object) -> InputError:
    return InputError(
        "The registration cannot be read",
        where=where,
        expected=expected,
        got=got,
        fix="give the folder that `gnmreg register` wrote, or register again",
    )
