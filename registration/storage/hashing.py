"""Digests of inputs and results: sha256, hexadecimal, independent of paths and dates."""

import hashlib
import json
import platform
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from registration.storage.jsonable import to_jsonable
from registration.types import Capture, Registration

PACKAGES = (
    "gnm-registration",
    "mitsuba",
    "drjit",
    "torch",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
)


def hash_file(path: Path) -> str:
    """Return the sha256 of a file's bytes."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# Fields that decide nothing, each with the reason. All others are hashed, also those that are added later.
NOT_HASHED: Mapping[type, Mapping[str, str]] = {
    Capture: {"root": "the files' contents decide, not where they lie"},
    Registration: {
        "status": "an assessment of the arrays",
        "reason": "an assessment of the arrays",
        "seconds": "how long it took",
        "history": "how it was fitted",
        "figures": "measurements of the arrays",
        "config": "the arrays are its result",
        "inputs": "the arrays are their result",
        "provenance": "where the inputs lay",
    },
}


def hash_capture(capture: Capture) -> str:
    """sha256 of all that a capture holds, cameras, landmarks, names and the bytes of its files; not of its path.

    The order of the views does not matter.
    """
    return hash_fields(replace(capture, views=tuple(sorted(capture.views, key=lambda view: view.name))))


def hash_fields(value: Any) -> str:
    """sha256 of the fields of a dataclass, nested ones too, but for those of `NOT_HASHED`.

    Of a path the file's bytes count, of an array its type, shape and values.
    """
    digest = hashlib.sha256()
    _feed(digest, _field_digests(value))
    return digest.hexdigest()


def hashed_fields(value: Any, not_hashed: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The fields of a dataclass that decide a result, by name: all but those of `NOT_HASHED` and `not_hashed`.

    A field may also say `not_hashed` itself, with the reason, in its metadata.
    """
    excluded = {name for kind, names in NOT_HASHED.items() if isinstance(value, kind) for name in names}
    excluded |= set(not_hashed or {})
    excluded |= {f.name for f in fields(value) if "not_hashed" in f.metadata}
    return {f.name: getattr(value, f.name) for f in fields(value) if f.name not in excluded}


def _field_digests(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {name: _field_digests(item) for name, item in hashed_fields(value).items()}
    if isinstance(value, Mapping):
        return {str(key): _field_digests(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_field_digests(item) for item in value]
    return hash_file(value) if isinstance(value, Path) else value


def input_hash(inputs: Mapping[str, str], config: Mapping[str, Any]) -> str:
    """Return one digest of everything that determines a result: input digests, configuration, the project's version."""
    digest = hashlib.sha256()
    _feed(digest, [dict(inputs), dict(config), _version("gnm-registration")])
    return digest.hexdigest()


def content_id(arrays: Mapping[str, np.ndarray], texture: np.ndarray) -> str:
    """Return the sha256 over names, types, shapes and values of the arrays and of the 16 bit texture."""
    digest = hashlib.sha256()
    for name, array in sorted({**arrays, "texture": texture}.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def hash_arrays(*arrays: np.ndarray) -> str:
    """Return the sha256 over the types, shapes and values of arrays, in order."""
    digest = hashlib.sha256()
    _feed(digest, list(arrays))
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _feed(digest: Any, value: Any) -> None:
    digest.update(json.dumps(to_jsonable(_arrays_digested(value)), sort_keys=True).encode() + b"\n")


def _arrays_digested(value: Any) -> Any:
    """The same nested value with type, shape and digest in place of every array: as JSON a mesh would take seconds."""
    if isinstance(value, Mapping):
        return {key: _arrays_digested(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_arrays_digested(item) for item in value]
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()]
    return value
