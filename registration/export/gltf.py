"""Binary glTF 2.0 files: arrays with their accessors, and the container around them."""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

VERTICES, ELEMENTS = 34962, 34963  # targets of buffer views
FLOAT = 5126
_COMPONENTS = {"<f4": FLOAT, "<u4": 5125, "<u2": 5123, "|u1": 5121}
_ROUND_UP = 4  # bytes; the alignment of buffer views


class GlbFile:
    """Collects arrays and images and returns the bytes of the file; its buffer holds them in the order of the calls."""

    def __init__(self) -> None:
        self._blobs: list[bytes] = []
        self._length = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def array(
        self, array: np.ndarray, *, target: int | None = None, bounds: bool = False, normalized: bool = False
    ) -> int:
        """Add an array of one type: float32, uint32, uint16 or uint8; (N,) or (N, 2 to 4).

        Args:
            array: the values, contiguous.
            target: VERTICES, ELEMENTS, or None for data that is neither.
            bounds: store minimum and maximum, which glTF requires of positions and of times.
            normalized: integers stand for [0, 1].

        Returns:
            The number of its accessor.
        """
        accessor = {"bufferView": self.view(array.tobytes(), target), **_header(array)}
        if normalized:
            accessor["normalized"] = True
        return self._accessor(accessor, array if bounds else None)

    def sparse_array(self, array: np.ndarray, rows: np.ndarray, *, bounds: bool = False) -> int:
        """Add a float array that is zero outside `rows`, in the size of those rows; returns the accessor's number."""
        if not len(rows):
            return self._accessor(_header(array), array if bounds else None)
        index = np.ascontiguousarray(rows, "<u4")
        accessor = _header(array) | {
            "sparse": {
                "count": len(rows),
                "indices": {"bufferView": self.view(index.tobytes()), "componentType": _COMPONENTS["<u4"]},
                "values": {"bufferView": self.view(np.ascontiguousarray(array[rows]).tobytes())},
            }
        }
        return self._accessor(accessor, array if bounds else None)

    def view(self, content: bytes, target: int | None = None) -> int:
        """Add bytes, such as an image's; returns the number of the buffer view."""
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(content)}
        self._views.append(view | ({"target": target} if target else {}))
        padded = content + bytes(-len(content) % _ROUND_UP)
        self._blobs.append(padded)
        self._length += len(padded)
        return len(self._views) - 1

    def content(self, scene: Mapping[str, Any]) -> bytes:
        """Return the file.

        Args:
            scene: the glTF object without asset, buffers, buffer views and accessors.
        """
        whole: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "gnm-registration"},
            **scene,
            "buffers": [{"byteLength": self._length}],
            "bufferViews": self._views,
            "accessors": self._accessors,
        }
        text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % _ROUND_UP)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", self._length, b"BIN\0")
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + self._length) + chunks + b"".join(self._blobs)

    def _accessor(self, accessor: dict[str, Any], bounded: np.ndarray | None) -> int:
        if bounded is not None:
            limits = {"min": bounded.min(0), "max": bounded.max(0)}
            accessor |= {name: np.atleast_1d(value).tolist() for name, value in limits.items()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1


def _header(array: np.ndarray) -> dict[str, Any]:
    kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
    return {"componentType": _COMPONENTS[array.dtype.str], "count": len(array), "type": kind}
