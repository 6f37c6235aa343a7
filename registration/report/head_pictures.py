"""Pictures of heads without a capture: soft light on the colours of their parts, and sheets of many with captions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from registration.geometry.rasterizer import rasterize
from registration.geometry.topology import vertex_normals
from registration.model.gnm_npz import GNMData
from registration.model.regions import group
from registration.render.studio.eyes import corneas
from registration.report.pictures import BACKGROUND
from registration.storage.files import atomic_file
from registration.types import Camera

_SMOOTHING = 2  # pictures are rendered this many times larger and reduced
_DISTANCE_M = 1.2  # of the camera from the face
COLOURS = {  # by vertex group; later ones override
    "skin": (222, 190, 168),
    "upper_lip": (200, 132, 122),
    "lower_lip": (200, 132, 122),
    "mouth_sock": (150, 78, 80),
    "eye_sockets": (190, 120, 110),
    "tongue": (206, 108, 112),
    "gums": (216, 124, 126),
    "teeth": (240, 236, 222),
    "eyes": (240, 240, 238),
    "irises": (96, 134, 160),
    "pupils": (20, 20, 22),
}
# Towards the light from the camera: x right, y down, z forward.
KEY, FILL = np.array([-0.45, -0.6, -0.66]), np.array([0.8, -0.1, -0.59])
_INK, _FAINT = (40, 40, 44), (110, 110, 116)
_LINE_PX, _HEADING_PX, _GAP_PX = 31, 52, 8

Picture = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True, kw_only=True)
class Tile:
    """One picture of a sheet."""

    picture: Picture
    caption: str  # one or more lines


class HeadPainter:
    """Draws heads of one model, all seen from the same side.

    The camera is aimed at the template: heads of other sizes and positions are seen as they are.
    """

    def __init__(self, data: GNMData, size: tuple[int, int] = (240, 290), turn_deg: float = 20.0):
        """Prepare a model.

        Args:
            data: the model.
            size: of the pictures, width and height in pixels.
            turn_deg: from which side the head is seen: 0 from the front, positive from the subject's left.
        """
        self._triangles = data.triangles[~corneas(data)].astype(np.int64)
        self._colours = _part_colours(data)
        self._size = size
        self._camera = _camera(data, size, turn_deg)

    def draw(self, vertices: Float[np.ndarray, "V 3"]) -> Picture:
        """Return the picture of a head, sRGB. Vertices are in metres, in the model's frame."""
        vertices, triangles, camera = np.asarray(vertices, np.float64), self._triangles, self._camera
        face, weight = rasterize(vertices, triangles, camera)
        shown = face >= 0
        corner, weight = triangles[face[shown]], weight[shown]
        normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles)).numpy()
        rotation = camera.T_cam_world[:3, :3]
        normal = np.einsum("pk,pkc->pc", weight, normals[corner]) @ rotation.T
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        point = np.einsum("pk,pkc->pc", weight, vertices[corner]) @ rotation.T + camera.T_cam_world[:3, 3]
        behind = (normal * point).sum(1) > 0
        normal[behind] *= -1
        light = 0.30 + 0.62 * np.clip(normal @ KEY, 0, 1) + 0.22 * np.clip(normal @ FILL, 0, 1)
        colour = np.einsum("pk,pkc->pc", weight, self._colours[corner]) * light[:, None]
        colour[behind] *= (0.75, 0.5, 0.5)
        picture = np.empty((*shown.shape, 3))
        picture[:] = BACKGROUND
        picture[shown] = np.minimum(colour, 255)
        return cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def sheet(tiles: Sequence[Tile], heading: str, columns: int) -> Image.Image:
    """Return a page of pictures of one size, each with its caption below.

    Args:
        tiles: at least one.
        heading: a line above them.
        columns: pictures in a row.
    """
    height, width = tiles[0].picture.shape[:2]
    lines = max(tile.caption.count("\n") + 1 for tile in tiles)
    cell = (width + _GAP_PX, height + lines * _LINE_PX + _GAP_PX)
    rows = math.ceil(len(tiles) / columns)
    page = Image.new("RGB", (columns * cell[0] + _GAP_PX, rows * cell[1] + _HEADING_PX + _GAP_PX), BACKGROUND)
    pen = ImageDraw.Draw(page)
    pen.text((_GAP_PX, 8), heading, _INK, _fitting(pen, heading, page.width - 2 * _GAP_PX, 32))
    for number, tile in enumerate(tiles):
        x, y = _GAP_PX + number % columns * cell[0], _HEADING_PX + number // columns * cell[1]
        page.paste(Image.fromarray(tile.picture), (x, y))
        for line, text in enumerate(tile.caption.split("\n")):
            font = _fitting(pen, text, width, 26)
            place = (x + width / 2, y + height + line * _LINE_PX)
            pen.text(place, text, _FAINT if line else _INK, font, anchor="ma")
    return page


def write_sheet(page: Image.Image, file: Path) -> None:
    """Write a page as a PNG file, in one rename."""
    with atomic_file(file) as temporary:
        page.save(temporary, "PNG")


def _fitting(
    pen: ImageDraw.ImageDraw, text: str, width: float, size: int
) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the largest font up to a size in which a line fits a width."""
    while size > 9 and pen.textlength(text, ImageFont.load_default(size)) > width:
        size -= 1
    return ImageFont.load_default(size)


def _part_colours(data: GNMData) -> Float[np.ndarray, "V 3"]:
    colours = np.tile(np.array(COLOURS["skin"], float), (len(data.template_vertex_positions), 1))
    for name, colour in COLOURS.items():
        if name in data.vertex_group_names:
            colours[group(data, name) > 0.5] = colour
    return colours


def _camera(data: GNMData, size: tuple[int, int], turn_deg: float) -> Camera:
    """Return a camera that sees the template's face and the cranium above it."""
    points = data.template_vertex_positions.astype(np.float64)
    face = group(data, "hockey_mask") > 0.5 if "hockey_mask" in data.vertex_group_names else np.ones(len(points), bool)
    low, high = points[face].min(0), points[face].max(0)
    visible_m = 1.55 * float(high[1] - low[1])  # vertically, at the target
    target = np.array([0.0, low[1] + 0.52 * (high[1] - low[1]), low[2] + 0.4 * (high[2] - low[2])])
    turn = math.radians(turn_deg)
    back = np.array([math.sin(turn), 0.0, math.cos(turn)])
    right = np.cross((0, 1, 0), back)
    pose = np.eye(4)
    pose[:3, :3] = right, -np.cross(back, right), -back
    pose[:3, 3] = -pose[:3, :3] @ (target + _DISTANCE_M * back)
    width, height = (_SMOOTHING * side for side in size)
    focal = _DISTANCE_M / visible_m * height
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(width_px=width, height_px=height, intrinsics=intrinsics, T_cam_world=pose)
