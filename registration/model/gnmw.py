"""Read and write GNMW files, Google's container of head models for the web, version 1.

The format is that of google/GNM, `gnm/shape/web`: the magic `GNMW`, the version and the length of the header as
little-endian 32 bit integers, a JSON header that lists named arrays, and the arrays, each at a multiple of 4 bytes. A
model is its template, its triangles, and both bases with 8 bits a value and one scale a component. It has no joints,
vertex groups, names or texture coordinates, so it cannot be registered with.
"""

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int8, Integer

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.model.gnm_npz import GNMData
from registration.storage.files import atomic_write_bytes
from registration.storage.npz import NpzSchema
from registration.storage.reading import parse_json, read_bytes

SUFFIX = ".gnmw"
MAGIC, VERSION = b"GNMW", 1
_PREAMBLE = struct.Struct("<4sII")
_ALIGNMENT = 4
_DTYPES = ("float32", "int8", "uint8", "uint16", "int32", "uint32")
_MAX_BYTES = 2**30  # of a file; the official model has 35 MB
_MAX_INT8 = 127
_MIN_SCALE = 1e-12  # of a component that is zero
_FIX = "export the model again (`gnmreg model export`), or use a file of Google's exporter"
_SCHEMA = NpzSchema(
    title="GNMW model",
    fix=_FIX,
    fields={
        "vertices": ("float", "V 3"),
        "triangles": ("integer", "F 3"),
        "identity_quantized": ("integer", "I 3*V"),
        "identity_scales": ("float", "I"),
        "expression_quantized": ("integer", "E 3*V"),
        "expression_scales": ("float", "E"),
    },
    indices={"triangles": "V"},
    never_empty="VFIE",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class WebModel:
    """The contents of a GNMW file. Metres, the model's frame."""

    vertices: Float[np.ndarray, "V 3"]
    triangles: Integer[np.ndarray, "F 3"]
    identity_quantized: Int8[np.ndarray, "I 3*V"]
    identity_scales: Float[np.ndarray, "I"]  # metres per step
    expression_quantized: Int8[np.ndarray, "E 3*V"]
    expression_scales: Float[np.ndarray, "E"]
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)  # arrays that this project does not know

    @property
    def identity_basis(self) -> Float[np.ndarray, "I V 3"]:
        """The identity basis, float32 metres per coefficient."""
        return _dequantized(self.identity_quantized, self.identity_scales)

    @property
    def expression_basis(self) -> Float[np.ndarray, "E V 3"]:
        """The expression basis, float32 metres per coefficient."""
        return _dequantized(self.expression_quantized, self.expression_scales)


@dataclass(frozen=True, kw_only=True)
class QuantizationError:
    """What 8 bits cost: distances of vertices, mm, for coefficients of one."""

    worst_mm: float  # of any vertex and component
    rms_mm: float  # over all vertices and components


def web_model(data: GNMData) -> WebModel:
    """Return a model as a GNMW file holds it; bases are rounded to 255 steps a component.

    Raises:
        InputError: the model has no identity or no expression components, which the format requires.
    """
    for name, basis in (("identity", data.vertex_identity_basis), ("expression", data.expression_basis)):
        if not len(basis):
            raise InputError(
                f"The model has no {name} components",
                where=f"{name}_names",
                expected="at least one, which a GNMW file needs",
                got="none",
                fix="export a model with both bases",
            )
    identity, identity_scales = _quantized(data.vertex_identity_basis)
    expression, expression_scales = _quantized(data.expression_basis)
    return WebModel(
        vertices=data.template_vertex_positions.astype(np.float32),
        triangles=data.triangles.astype(np.uint32),
        identity_quantized=identity,
        identity_scales=identity_scales,
        expression_quantized=expression,
        expression_scales=expression_scales,
    )


def quantization_error(model: WebModel, data: GNMData) -> Mapping[str, QuantizationError]:
    """Measure the bases of a GNMW model, "identity" and "expression", against those of the model it was made from."""
    errors = {}
    for name, basis in (("identity", data.vertex_identity_basis), ("expression", data.expression_basis)):
        quantized, scales = getattr(model, f"{name}_quantized"), getattr(model, f"{name}_scales")
        squared = [
            ((row.astype(np.float64) - steps.reshape(row.shape) * np.float64(scale)) ** 2).sum(-1)
            for row, steps, scale in zip(basis, quantized, scales, strict=True)
        ]
        worst, mean = max(row.max() for row in squared), np.mean([row.mean() for row in squared])
        errors[name] = QuantizationError(worst_mm=MM_PER_M * math.sqrt(worst), rms_mm=MM_PER_M * math.sqrt(mean))
    return errors


def write(model: WebModel, path: Path) -> None:
    """Write a GNMW file in one rename. Equal models make equal files."""
    arrays = {name: getattr(model, name) for name in _SCHEMA.fields} | dict(model.extra)
    sections, body = [], bytearray()
    for name, array in arrays.items():
        content = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
        section = {"name": name, "dtype": array.dtype.name, "shape": list(array.shape)}
        sections.append({**section, "offset": len(body), "byteLength": len(content)})
        body += content + bytes(-len(content) % _ALIGNMENT)
    described = {"meta": {"num_vertices": len(model.vertices)}, "sections": sections}
    header = json.dumps(described, separators=(",", ":"), sort_keys=True).encode()
    header += b" " * (-len(header) % _ALIGNMENT)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    atomic_write_bytes(Path(path), _PREAMBLE.pack(MAGIC, VERSION, len(header)) + header + bytes(body))


def read(path: Path) -> WebModel:
    """Read a GNMW file.

    Raises:
        InputError: it is none, of another version, damaged, or its arrays make no model.
    """
    refuse = partial(InputError.unreadable, "GNMW model", where=path, fix=_FIX)
    content = read_bytes(Path(path), refuse, max_bytes=_MAX_BYTES)
    header, body = _split(content, refuse)
    arrays = _arrays(header, body, refuse)
    if (defect := _SCHEMA.find_defect(arrays)) is not None:
        raise _SCHEMA.error(defect, path)
    for name in ("identity", "expression"):
        if arrays[f"{name}_quantized"].dtype != np.int8:
            got = arrays[f"{name}_quantized"].dtype
            raise refuse(expected="bases of 8 bits a value", got=f"{name}_quantized of type {got}")
        if not (arrays[f"{name}_scales"] > 0).all():
            raise refuse(expected="scales above 0", got=f"{name}_scales of {arrays[f'{name}_scales'].min()}")
    stated, count = header.get("meta", {}).get("num_vertices"), len(arrays["vertices"])
    if stated not in (None, count):
        raise refuse(expected=f"num_vertices {count}, as the array of vertices has", got=stated)
    known = {name: arrays.pop(name) for name in _SCHEMA.fields}
    return WebModel(**known, extra=arrays)


def _split(content: bytes, refuse: Any) -> tuple[dict[str, Any], memoryview]:
    """The JSON header and the bytes behind it."""
    if len(content) < _PREAMBLE.size or not content.startswith(MAGIC):
        raise refuse(expected="a file that begins with GNMW", got=f"{len(content)} bytes, first {content[:4]!r}")
    _, version, length = _PREAMBLE.unpack_from(content)
    if version != VERSION:
        raise refuse(expected=f"version {VERSION} of the format", got=f"version {version}")
    end = _PREAMBLE.size + length
    if end > len(content):
        raise refuse(expected=f"a header of {length} bytes", got=f"a file of {len(content)} bytes, cut short")
    header = parse_json(content[_PREAMBLE.size : end], refuse)
    if not isinstance(header, dict) or not isinstance(header.get("meta", {}), dict):
        raise refuse(expected="a header that is a JSON object, with an object `meta`", got=str(header)[:80])
    return header, memoryview(content)[end:]


def _arrays(header: Mapping[str, Any], body: memoryview, refuse: Any) -> dict[str, np.ndarray]:
    sections = header.get("sections", [])
    if not isinstance(sections, list):
        raise refuse(expected="a list of sections", got=str(sections)[:80])
    arrays: dict[str, np.ndarray] = {}
    for section in sections:
        name = section.get("name") if isinstance(section, dict) else None
        if not isinstance(name, str) or not name or name in arrays:
            raise refuse(expected="sections with names of their own", got=str(section)[:80])
        arrays[name] = _array(section, body, partial(refuse, expected=f"a section '{name}' of a known type and size"))
    return arrays


def _array(section: Mapping[str, Any], body: memoryview, refuse: Any) -> np.ndarray:
    shape, dtype = section.get("shape"), section.get("dtype")
    numbers = [section.get("offset"), section.get("byteLength"), *(shape if isinstance(shape, list) else [None])]
    if not all(type(number) is int and number >= 0 for number in numbers) or dtype not in _DTYPES:
        raise refuse(got=str({key: section.get(key) for key in ("dtype", "shape", "offset", "byteLength")})[:200])
    offset, length, *axes = numbers
    if offset % _ALIGNMENT or length != math.prod(axes) * np.dtype(dtype).itemsize:
        raise refuse(got=f"{dtype} {axes} in {length} bytes from {offset}")
    if offset + length > len(body):
        raise refuse(got=f"bytes {offset} to {offset + length} of {len(body)}: the file is cut short")
    values = np.frombuffer(body, np.dtype(dtype).newbyteorder("<"), math.prod(axes), offset)
    return values.reshape(axes).astype(dtype)


def _quantized(basis: Float[np.ndarray, "K V 3"]) -> tuple[Int8[np.ndarray, "K 3*V"], Float[np.ndarray, "K"]]:
    rows = np.empty((len(basis), basis[0].size), np.int8)
    scales = np.empty(len(basis), np.float32)
    for k, component in enumerate(basis):
        values = component.astype(np.float64).ravel()
        scales[k] = max(np.abs(values).max() / _MAX_INT8, _MIN_SCALE)
        rows[k] = np.clip(np.round(values / scales[k]), -_MAX_INT8, _MAX_INT8)
    return rows, scales


def _dequantized(rows: Int8[np.ndarray, "K N"], scales: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K V 3"]:
    basis: np.ndarray = rows.astype(np.float32) * scales.astype(np.float32)[:, None]
    return basis.reshape(len(rows), -1, 3)
