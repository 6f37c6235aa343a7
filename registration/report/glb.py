"""Coloured heads as GLB files, static or animated between -3 and +3 standard deviations.

The browser runs the animation by itself: a slow connection transfers the file once and nothing afterwards.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt16

from registration.export.gltf import ELEMENTS, VERTICES, GlbFile
from registration.frames import srgb_to_linear
from registration.geometry.topology import vertex_normals

AMPLITUDE_SIGMAS = 3.0  # of the animation, in standard deviations to either side
_PERIOD_S = 4.0
_KEYFRAMES = 33


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
    file, number = GlbFile(), {}
    for name, array in arrays.items():
        target = None if name in ("times", "weights") else VERTICES
        bounds = name in ("POSITION", "motion", "times")  # glTF requires these
        number[name] = file.array(np.ascontiguousarray(array, "<f4"), target=target, bounds=bounds)
    faces = file.array(np.ascontiguousarray(triangles, "<u4").reshape(-1), target=ELEMENTS)
    number["COLOR_0"] = file.array(_colours(colours), target=VERTICES, normalized=True)
    primitive: dict[str, Any] = {
        "attributes": {name: number[name] for name in ("POSITION", "NORMAL", "COLOR_0")},
        "indices": faces,
        "material": 0,
    }
    skin = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.75}, "doubleSided": True}
    scene: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "head"}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [skin],
    }
    if "motion" in number:
        primitive["targets"] = [{"POSITION": number["motion"], "NORMAL": number["normal_change"]}]
        scene["meshes"][0]["weights"] = [0]
        sampler = {"input": number["times"], "output": number["weights"], "interpolation": "LINEAR"}
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        scene["animations"] = [{"samplers": [sampler], "channels": [channel]}]
    return file.content(scene)
