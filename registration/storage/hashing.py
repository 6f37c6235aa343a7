"""Digests that tell whether two inputs, or two results, are the same: sha256, hexadecimal, blind to names and dates."""

import hashlib
import json
import math
import platform
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from registration.types import Capture

PACKAGES = (
    "gnm-registration",
    "mitsuba",
    "drjit",
    "torch",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "kornia",
)


def hash_file(path: Path) -> str:
    """sha256 of a file's bytes, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_capture(capture: Capture) -> str:
    """sha256 of all a capture holds: cameras, landmarks, names and its files' bytes; not of where it lies."""
    digest = hashlib.sha256()
    _feed(digest, [capture.subject, capture.expression, capture.classes, capture.tags])
    for view in sorted(capture.views, key=lambda v: v.name):
        camera = view.camera
        _feed(digest, [view.name, camera.width_px, camera.height_px, camera.distortion])
        _feed(digest, [camera.intrinsics, camera.T_cam_world])
        _feed(digest, {name: np.asarray(points) for name, points in view.landmarks.items()})
        for file in (view.image, view.mask, view.normals, view.segmentation):
            _feed(digest, hash_file(file) if file else None)
    for file in (capture.scan, capture.ground_truth):
        _feed(digest, hash_file(file) if file else None)
    return digest.hexdigest()


def input_hash(inputs: Mapping[str, str], config: Mapping[str, Any]) -> str:
    """One digest of all that decides a result: input digests, resolved configuration and our own version."""
    digest = hashlib.sha256()
    _feed(digest, [dict(inputs), dict(config), _version("gnm-registration")])
    return digest.hexdigest()


def content_id(arrays: Mapping[str, np.ndarray], texture: np.ndarray) -> str:
    """sha256 over names, types, shapes and values of the arrays and of the 16 bit texture."""
    digest = hashlib.sha256()
    for name, array in sorted({**arrays, "texture": texture}.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def hash_arrays(*arrays: np.ndarray) -> str:
    """sha256 over the types, shapes and values of some arrays, in order."""
    digest = hashlib.sha256()
    _feed(digest, list(arrays))
    return digest.hexdigest()


def to_jsonable(value: Any) -> Any:
    """Any configuration as JSON values: dataclasses become objects with their type's name, non-finite numbers null."""
    if is_dataclass(value) and not isinstance(value, type):
        return {"type": type(value).__name__, **{f.name: to_jsonable(getattr(value, f.name)) for f in fields(value)}}
    if isinstance(value, Mapping):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, (set, frozenset)):
        return sorted((to_jsonable(item) for item in value), key=repr)
    if isinstance(value, (list, tuple)):
        return [to_jsonable(item) for item in value]
    if hasattr(value, "tolist"):  # NumPy and torch arrays and scalars
        return to_jsonable(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
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
