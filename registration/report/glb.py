"""Coloured heads as GLB files, static or animated between -3 and +3 standard deviations.

The browser runs the animation by itself: a slow connection transfers the file once and nothing afterwards.
"""

import json
import struct
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt16

from registration.frames import srgb_to_linear
from registration.geometry.topology import vertex_normals

AMPLITUDE_SIGMAS = 3.0  # of the animation, in standard deviations to either side
_PERIOD_S = 4.0
_KEYFRAMES = 33
_FLOAT, _UINT, _USHORT = 5126, 5125, 5123
_ARRAY, _ELEMENTS = 34962, 34963


def static_glb(
    points: Float[np.ndarray, "P 3"], triangles: Int[np.ndarray, "F 3"], colours: Float[np.ndarray, "P 3"]
) -> bytes:
    """Return a mesh as GLB; positions in metres, colours sRGB in [0, 255].

    The file ends with the bytes of `colour_bytes`.
    """
    normals = vertex_normals(torch.from_numpy(points), torch.from_numpy(triangles.astype(np.int64))).numpy()
    return _glb({"POSITION": points, "NORMAL": normals}, triangles, colours)


def colour_bytes(colours: Float[np.ndarray, "P 3"]) -> bytes:
    """Return vertex colours as a GLB file holds them: linear RGBA of 16 bits.

    Args:
        colours: sRGB in [0, 255].
    """
    return _colours(colours).tobytes()


def animated_glb(
    points: Float[np.ndarray, "P 3"],
    motion: Float[np.ndarray, "P 3"],
    triangles: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "P 3"],
) -> bytes:
    """Return a mesh as GLB with one morph target and an endless animation of its weight.

    Args:
        points: vertices, metres.
        motion: displacement of one standard deviation, metres; the target is `AMPLITUDE_SIGMAS` times as large.
        triangles: vertex indices.
        colours: sRGB in [0, 255].
    """
    faces = torch.from_numpy(triangles.astype(np.int64))
    ends = [points + side * AMPLITUDE_SIGMAS * motion for side in (-1, 0, 1)]
    low, rest, high = (vertex_normals(torch.from_numpy(end), faces).numpy() for end in ends)
    times = np.linspace(0, _PERIOD_S, _KEYFRAMES)
    arrays = {
        "POSITION": points,
        "NORMAL": rest,
        "motion": AMPLITUDE_SIGMAS * motion,
        "normal_change": (high - low) / 2,
        "times": times,
        "weights": np.sin(2 * np.pi * times / _PERIOD_S),
    }
    return _glb(arrays, triangles, colours)


def _colours(colours: Float[np.ndarray, "P 3"]) -> UInt16[np.ndarray, "P 4"]:
    linear = srgb_to_linear(np.clip(np.asarray(colours, np.float64), 0, 255) / 255)
    opaque = np.concatenate([linear, np.ones((len(linear), 1))], 1)
    return np.ascontiguousarray(np.round(opaque * 65535), "<u2")


def _glb(arrays: dict[str, np.ndarray], triangles: Int[np.ndarray, "F 3"], colours: np.ndarray) -> bytes:
    """Return the file. `arrays`: vertex attributes by their glTF names; an animated head also has motion,
    normal_change, times and weights. Colours come last."""
    blobs = {name: np.ascontiguousarray(array, "<f4") for name, array in arrays.items()}
    blobs["faces"] = np.ascontiguousarray(triangles, "<u4").reshape(-1)
    blobs["COLOR_0"] = _colours(colours)
    number = {name: k for k, name in enumerate(blobs)}
    views, accessors, offset = [], [], 0
    for name, array in blobs.items():
        target = _ELEMENTS if name == "faces" else None if name in ("times", "weights") else _ARRAY
        view = {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes}
        views.append(view | ({"target": target} if target else {}))
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        accessor = {"bufferView": number[name], "count": len(array), "type": kind}
        accessor["componentType"] = {"<f4": _FLOAT, "<u4": _UINT, "<u2": _USHORT}[array.dtype.str]
        if name == "COLOR_0":
            accessor["normalized"] = True
        if name in ("POSITION", "motion", "times"):  # glTF requires these
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
        primitive["targets"] = [{"POSITION": number["motion"], "NORMAL": number["normal_change"]}]
        scene["meshes"][0]["weights"] = [0]
        sampler = {"input": number["times"], "output": number["weights"], "interpolation": "LINEAR"}
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        scene["animations"] = [{"samplers": [sampler], "channels": [channel]}]
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(array.tobytes() for array in blobs.values())
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
