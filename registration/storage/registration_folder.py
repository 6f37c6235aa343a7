"""Read and write a `Registration` as a folder on disk. The files and fields are described in docs/formats.md.

A folder appears, or is replaced, in one rename; its content id is a digest of its arrays and is checked on reading.
"""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from registration.errors import InputError
from registration.frames import compact, linear_to_srgb, srgb_to_linear
from registration.storage.files import atomic_directory, atomic_write_text, has_kind, write_json
from registration.storage.hashing import content_id, input_hash, to_jsonable, versions
from registration.storage.image_files import decode, image_size
from registration.storage.mesh import write_obj, write_ply
from registration.storage.npz import Kind, NpzSchema
from registration.storage.records import Record, read_json, structure
from registration.types import Registration, Status

KIND = "gnm-registration"
MANIFEST = "manifest.json"
REPORT = "report.html"
FILES = {  # and what each is, for people
    MANIFEST: "inputs, configuration, status and figures, for programs",
    "registration.npz": "all arrays: vertices, parameters, offsets, confidence, landmarks",
    "mesh.ply": "the mesh: the model's vertices in the model's order",
    "mesh.obj": "the same mesh with uvs",
    "mesh.mtl": "the material of mesh.obj",
    "texture.png": "the texture, 16 bit sRGB",
    "history.json": "the loss terms of every step",
    REPORT: "this page",
}
SPARSE = "sparse"  # a COLMAP model of the corrected cameras, where the fit corrected or estimated them
FIT_FILES = {  # of some fits, mostly to landmarks alone, and what each is
    "cranium.npz": "the completed cranium: where, and how far it may be off",
    "overlay.jpg": "the mesh drawn over the images",
    "uncertainty.npz": "posterior covariances and standard deviations",
    "uncertainty.png": "standard deviations of the vertices as colours",
}
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
_TITLE = "registration"
_FIX = "give the folder that `gnmreg register` wrote, or register again"
_INTEGERS = ("triangles",)
_FIELDS: dict[str, tuple[Kind, str]] = {
    name: ("integer" if name in _INTEGERS else "float", axes) for name, axes in AXES.items()
}
SCHEMA = NpzSchema(
    title=_TITLE,
    fix=_FIX,
    fields=_FIELDS,
    families={LANDMARKS: ("float", "L 3")},
    indices={"triangles": "V"},
    max_bytes=2**30,  # ten million vertices
)


@dataclass(frozen=True, kw_only=True)
class RegistrationManifest(Record, kind=KIND, schema=1, title=_TITLE, fix=_FIX):
    """`manifest.json` of a registration folder."""

    status: Status
    reason: str
    content_id: str  # sha256 of the arrays and the texture
    input_hash: str  # sha256 of inputs, config and the project's version
    figures: Mapping[str, Any]
    seconds: Mapping[str, float | None]  # per stage
    inputs: Mapping[str, str]  # name -> sha256
    versions: Mapping[str, str]
    config: Mapping[str, Any]  # the resolved configuration, as `to_jsonable` returns it
    provenance: Mapping[str, str] = field(default_factory=dict)  # the command, and the paths of what it read


def check_output_folder(out: Path) -> None:
    """Refuse, before any compute, an output folder that is not ours to replace.

    Raises:
        InputError: `out` is a file, is a folder that holds anything that we did not write, or cannot be created.
    """
    out = Path(out).resolve()
    ours = "a new or empty folder, or one that gnmreg wrote"
    if out.exists() and not out.is_dir():
        raise InputError.output_folder(out, expected=ours, got="a file")
    if out.is_dir() and (names := sorted(p.name for p in out.iterdir())):
        if not is_registration(out):
            raise InputError.output_folder(out, expected=ours, got=f"a folder that holds {_listed(names)}")
        if foreign := [name for name in names if name not in (*FILES, *FIT_FILES, SPARSE)]:
            fix = "move these files elsewhere: they would be lost"
            raise InputError.output_folder(out, expected=ours, got=f"also {_listed(foreign)}", fix=fix)
    parent = out.parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        got, fix = f"no folder can be created in {parent}", "choose a folder that you may write to"
        raise InputError.output_folder(out, expected=ours, got=got, fix=fix)


def is_registration(path: Path) -> bool:
    """Return whether the folder holds a manifest that we wrote, of any schema version."""
    return has_kind(Path(path) / MANIFEST, KIND)


def save_registration(
    registration: Registration,
    out: Path,
    report_html: str | None = None,
    write_sparse: Callable[[Path], None] | None = None,
    write_fit_files: Callable[[Path], None] | None = None,
) -> Path:
    """Write the whole folder; one that we wrote before is replaced in one rename.

    Arrays are stored as float32 (triangles as int32; translation, vertices and landmarks as float64 where the world's
    origin is far), the texture as 16 bit sRGB.

    Args:
        registration: the result.
        out: the folder.
        report_html: the content of `report.html`; None: no report.
        write_sparse: writes the COLMAP model of corrected cameras into the folder that it is given; None: there are
            none.
        write_fit_files: writes some of `FIT_FILES` into the folder that it is given; None: there are none.

    Returns:
        The folder, as an absolute path.

    Raises:
        InputError: as `check_output_folder`.
        ValueError: an array is not finite or not of the documented shape; a `failed` one may hold non-finite numbers.
    """
    out = Path(out).resolve()
    check_output_folder(out)
    arrays = _arrays(registration)
    if defect := SCHEMA.find_defect(arrays, finite=registration.status != "failed"):
        raise ValueError(f"{defect.name}: expected {defect.expected}, got {defect.got}")
    texture = _encode_texture(registration.texture)
    with atomic_directory(out) as temporary:
        np.savez(temporary / "registration.npz", allow_pickle=False, **arrays)
        _write_png(temporary / "texture.png", texture)
        write_ply(temporary / "mesh.ply", arrays["vertices"], arrays["triangles"])
        write_obj(temporary / "mesh.obj", arrays["vertices"], arrays["triangles"], arrays["corner_uvs"], "texture.png")
        write_json(temporary / "history.json", registration.history)
        if report_html is not None:
            (temporary / REPORT).write_text(report_html, encoding="utf-8")
        if write_sparse is not None:
            write_sparse(temporary / SPARSE)
        if write_fit_files is not None:
            write_fit_files(temporary)
        _manifest(registration, content_id(arrays, texture)).write(temporary / MANIFEST)
    return out


def load_registration(path: Path) -> Registration:
    """Read a registration folder.

    Args:
        path: the folder that `save_registration` wrote.

    Returns:
        The registration; its texture is linear float32.

    Raises:
        InputError: no folder of ours, another schema version, a field that is missing, of a wrong shape, not finite or
            pickled, an unreadable texture, or arrays that do not have the manifest's content id.
    """
    path = Path(path)
    manifest = read_manifest(path)
    arrays = SCHEMA.read(path / "registration.npz")
    texture = _read_png(path / "texture.png")
    history = _read_history(path / "history.json")
    if (actual := content_id(arrays, texture)) != manifest.content_id:
        raise InputError(
            "The registration was changed after it was written",
            where=path,
            expected=f"content id {manifest.content_id}",
            got=actual,
            fix="register again, or restore registration.npz and texture.png",
        )
    return Registration(
        status=manifest.status,
        reason=manifest.reason,
        **{name: arrays[name] for name in AXES},
        texture=srgb_to_linear((texture / 65535.0).astype(np.float32)),
        landmarks={name.removeprefix(LANDMARKS): a for name, a in arrays.items() if name.startswith(LANDMARKS)},
        seconds={stage: _number(seconds) for stage, seconds in manifest.seconds.items()},
        history=history,
        figures=manifest.figures,
        config=manifest.config,
        inputs=manifest.inputs,
        provenance=manifest.provenance,
    )


def find_existing(out: Path, expected_hash: str) -> Registration | None:
    """Return the registration in `out` if it is intact and has this `input_hash`, else None.

    Its status may be any; the caller decides whether to retry a failed one.
    """
    try:
        return load_registration(out) if read_manifest(out).input_hash == expected_hash else None
    except InputError:
        return None


def update_figures(path: Path, figures: Mapping[str, Any], report_html: str | None = None) -> None:
    """Add figures to a folder (same names are overwritten); each file is replaced in one rename.

    Raises:
        InputError: no folder of ours.
    """
    path = Path(path)
    manifest = read_manifest(path)
    replace(manifest, figures={**manifest.figures, **figures}).write(path / MANIFEST)
    if report_html is not None:
        atomic_write_text(path / REPORT, report_html)


def read_manifest(path: Path) -> RegistrationManifest:
    """Read the manifest of a registration folder, without its arrays.

    Raises:
        InputError: no manifest, not ours, another schema version, or a field that is missing or of a wrong type.
    """
    return RegistrationManifest.read(Path(path) / MANIFEST)


def _arrays(registration: Registration) -> dict[str, np.ndarray]:
    world = compact(registration.vertices).dtype
    types: dict[str, np.dtype] = {"triangles": np.dtype(np.int32), "vertices": world, "translation": world}
    arrays = {name: np.asarray(getattr(registration, name), types.get(name, np.dtype(np.float32))) for name in AXES}
    for scheme, points in registration.landmarks.items():
        arrays[LANDMARKS + scheme] = np.asarray(points, world)
    return arrays


def _manifest(registration: Registration, content: str) -> RegistrationManifest:
    return RegistrationManifest(
        status=registration.status,
        reason=registration.reason,
        content_id=content,
        input_hash=input_hash(registration.inputs, registration.config),
        figures=registration.figures,
        seconds=registration.seconds,
        inputs=registration.inputs,
        versions=versions(),
        config=to_jsonable(registration.config),
        provenance=registration.provenance,
    )


def _read_history(file: Path) -> dict[str, dict[str, list[float]]]:
    """Loss values: stage -> term -> value per step. Values that were not finite are NaN."""
    history = read_json(file, title=_TITLE, fix=_FIX)
    stages = structure(history, Mapping[str, Mapping[str, list[float | None]]], where=file, title=_TITLE, fix=_FIX)
    return {stage: {term: [_number(v) for v in values] for term, values in s.items()} for stage, s in stages.items()}


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _encode_texture(texture: np.ndarray) -> np.ndarray:
    return np.round(linear_to_srgb(np.nan_to_num(np.asarray(texture, np.float64))) * 65535.0).astype(np.uint16)


def _write_png(file: Path, texture: np.ndarray) -> None:
    import cv2

    if not cv2.imwrite(str(file), texture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise OSError(f"cannot write {file}")


def _read_png(file: Path) -> np.ndarray:
    import cv2

    refuse = partial(InputError.unreadable, _TITLE, where=file, fix=_FIX)
    image_size(file, refuse)
    texture = decode(file, cv2.IMREAD_UNCHANGED, refuse)
    if texture.dtype != np.uint16 or texture.ndim != 3 or texture.shape[2] != 3:
        raise refuse(expected="a 16 bit RGB PNG", got=f"{texture.dtype} of shape {texture.shape}")
    return np.ascontiguousarray(texture[..., ::-1])


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
