"""The mesh that a reader of the report can turn: a GLB file with interchangeable vertex colours, and its viewer."""

import base64
import gzip
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from jaxtyping import Float

from registration.frames import linear_to_srgb
from registration.report.glb import colour_bytes, static_glb
from registration.report.heat_map import PLAIN, UNMEASURED, upright
from registration.report.inputs import HeatMap
from registration.report.pictures import scale_colours
from registration.types import Registration

VIEWER_FILE = "model-viewer-4.1.0.min.js"  # @google/model-viewer, from npm; see NOTICE
_POSITION_STEP = 2.0**-16  # m; rounded positions and normals compress to half
_GZIP_LEVEL = 6


@dataclass(frozen=True, kw_only=True)
class MeshViewer:
    """Contents of the page's viewer; all bytes gzipped, base64."""

    code: str  # JavaScript that defines the element <model-viewer>
    glb: str
    colours: Mapping[str, str]  # title -> bytes that replace the end of the GLB file; the first are the file's own


def mesh_viewer(mesh: HeatMap, colours: Mapping[str, Float[np.ndarray, "V 3"]]) -> MeshViewer:
    """Return what the page's viewer needs.

    Args:
        mesh: finite.
        colours: title -> sRGB in [0, 255] of each vertex, at least one.
    """
    first = next(iter(colours.values()))
    points = np.round(upright(mesh) / _POSITION_STEP) * _POSITION_STEP
    return MeshViewer(
        code=_viewer_code(),
        glb=_packed(static_glb(points, mesh.triangles, first)),
        colours={title: _packed(colour_bytes(values)) for title, values in colours.items()},
    )


def vertex_colours(registration: Registration, mesh: HeatMap, limit_mm: float) -> dict[str, Float[np.ndarray, "V 3"]]:
    """Return the colourings of the viewer: the distance from the scan, if it was measured, texture, plain.

    Args:
        registration: its texture is sampled at the vertices.
        mesh: of the registration, with distances.
        limit_mm: distance at the end of the colour scale.
    """
    colours = {}
    measured = np.isfinite(mesh.distance_mm)
    if measured.any():
        scale = scale_colours(mesh.distance_mm / limit_mm)
        colours["distance from the scan"] = np.where(measured[:, None], scale, UNMEASURED)
    colours["texture"] = _texture_at_vertices(registration)
    colours["plain"] = np.tile(np.array(PLAIN, float), (len(mesh.vertices), 1))
    return colours


def _texture_at_vertices(registration: Registration) -> Float[np.ndarray, "V 3"]:
    """The texel at each vertex, of the last corner that has it."""
    size = len(registration.texture)
    uvs = np.zeros((len(registration.vertices), 2))
    uvs[registration.triangles.reshape(-1)] = registration.corner_uvs.reshape(-1, 2)
    column, row = (np.clip(axis * size, 0, size - 1).astype(np.int64) for axis in (uvs[:, 0], 1 - uvs[:, 1]))
    return np.asarray(255 * linear_to_srgb(registration.texture[row, column].astype(np.float64)))


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, _GZIP_LEVEL, mtime=0)).decode("ascii")


@cache
def _viewer_code() -> str:
    return _packed(files("registration.report.templates").joinpath(VIEWER_FILE).read_bytes())
