"""Coloured heads as GLB files, still or swinging between -3 and +3 standard deviations: the browser animates these by
itself, so that a slow line carries them once and nothing while they move."""

import json
import struct
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from registration.frames import srgb_to_linear
from registration.geometry.topology import vertex_normals

SWING = 3.0  # standard deviations either way
_SECONDS = 4.0  # a period
_KEYS = 33
_FLOAT, _UINT = 5126, 5125
_ARRAY, _ELEMENTS = 34962, 34963


def still_head(
    points: Float[np.ndarray, "P 3"], triangles: Int[np.ndarray, "F 3"], colours: Float[np.ndarray, "P 3"]
) -> bytes:
    """A GLB. Metres; colours are sRGB in [0, 255]."""
    normals = vertex_normals(torch.from_numpy(points), torch.from_numpy(triangles.astype(np.int64))).numpy()
    return _glb({"POSITION": points, "NORMAL": normals, "COLOR_0": _linear(colours)}, triangles)


def swinging_head(
    points: Float[np.ndarray, "P 3"],
    motion: Float[np.ndarray, "P 3"],
    triangles: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "P 3"],
) -> bytes:
    """A GLB with one morph target, `SWING` times the motion, and an endless animation of its weight.

    Metres; colours are sRGB in [0, 255].
    """
    faces = torch.from_numpy(triangles.astype(np.int64))
    ends = [points + side * SWING * motion for side in (-1, 0, 1)]
    low, rest, high = (vertex_normals(torch.from_numpy(end), faces).numpy() for end in ends)
    times = np.linspace(0, _SECONDS, _KEYS)
    arrays = {
        "POSITION": points,
        "NORMAL": rest,
        "COLOR_0": _linear(colours),
        "motion": SWING * motion,
        "turned": (high - low) / 2,
        "times": times,
        "weights": np.sin(2 * np.pi * times / _SECONDS),
    }
    return _glb(arrays, triangles)


def _linear(colours: Float[np.ndarray, "P 3"]) -> np.ndarray:
    return srgb_to_linear(np.clip(colours, 0, 255) / 255)


def _glb(arrays: dict[str, np.ndarray], triangles: Int[np.ndarray, "F 3"]) -> bytes:
    """Arrays by what they are called in the format; of a head that swings also motion, turned, times and weights."""
    blobs = {name: np.ascontiguousarray(array, "<f4") for name, array in arrays.items()}
    blobs["faces"] = np.ascontiguousarray(triangles, "<u4").reshape(-1)
    number = {name: k for k, name in enumerate(blobs)}
    views, accessors, offset = [], [], 0
    for name, array in blobs.items():
        target = _ELEMENTS if name == "faces" else None if name in ("times", "weights") else _ARRAY
        view = {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes}
        views.append(view | ({"target": target} if target else {}))
        kind = "VEC3" if array.ndim == 2 else "SCALAR"
        accessor = {"bufferView": number[name], "count": len(array), "type": kind}
        accessor["componentType"] = _UINT if name == "faces" else _FLOAT
        if name in ("POSITION", "motion", "times"):  # the format asks for these
            accessor |= {"min": np.atleast_1d(array.min(0)).tolist(), "max": np.atleast_1d(array.max(0)).tolist()}
        accessors.append(accessor)
        offset += array.nbytes
    primitive: dict[str, Any] = {
        "attributes": {name: number[name] for name in ("POSITION", "NORMAL", "COLOR_0")},
        "indices": number["faces"],
        "material": 0,
    }
    skin = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.75}, "doubleSided": True}
    scene: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "head"}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [skin],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    if "motion" in number:
        primitive["targets"] = [{"POSITION": number["motion"], "NORMAL": number["turned"]}]
        scene["meshes"][0]["weights"] = [0]
        sampler = {"input": number["times"], "output": number["weights"], "interpolation": "LINEAR"}
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        scene["animations"] = [{"samplers": [sampler], "channels": [channel]}]
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(array.tobytes() for array in blobs.values())
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
