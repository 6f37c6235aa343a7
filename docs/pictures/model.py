"""Renders the images of docs/model.md from a first model: `python -m docs.pictures.model MODEL.npz docs/model`.

MODEL.npz is built by `gnmreg model bootstrap`; the face units come from MakeHuman's head in the cache.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8

from coregister.anatomy import eye_sections
from coregister.first_model import assembly, makehuman, population
from registration.geometry.rasterizer import rasterize
from registration.geometry.topology import vertex_normals
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme, schemes_beside
from registration.model.regions import group
from registration.report.head_pictures import COLOURS, FILL, KEY
from registration.report.pictures import BACKGROUND
from registration.types import Camera

SMOOTHING = 2  # images are rendered this many times larger and reduced
QUALITY = 82
REGIONS = (  # of the texture map and of the template, in distinct colours
    *("forehead", "left_brow", "middle_brow", "right_brow", "left_temple", "right_temple", "left_orbital"),
    *("right_orbital", "left_zygomatic", "right_zygomatic", "nose", "left_parotid", "right_parotid"),
    *("left_infraorbital", "right_infraorbital", "left_cheek", "right_cheek", "upper_lip", "lower_lip", "chin"),
)
UNITS = ("browInnerUp", "browDownLeft", "eyeBlinkLeft", "eyeWideRight", "noseSneerLeft") + (
    *("jawOpen", "mouthSmileLeft", "mouthFrownRight", "mouthPucker", "cheekPuff"),
)
FRONT, SIDE = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
HEAD = (0.0, 0.26, 0.03)
Picture = UInt8[np.ndarray, "H W 3"]


@dataclass(frozen=True, kw_only=True)
class Shot:
    """A camera position; metres, the model's frame."""

    target: tuple[float, float, float]
    direction: tuple[float, float, float]  # from the target to the camera
    width: float  # visible at the target
    size: tuple[int, int]  # px: width, height
    distance: float = 1.2

    def camera(self) -> Camera:
        back = np.array(self.direction) / np.linalg.norm(self.direction)
        right = np.cross((0, 1, 0), back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = right, -np.cross(back, right), -back
        pose[:3, 3] = -pose[:3, :3] @ (np.array(self.target) + self.distance * back)
        width, height = (SMOOTHING * side for side in self.size)
        focal = self.distance / self.width * width
        intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        return Camera(width_px=width, height_px=height, intrinsics=intrinsics, T_cam_world=pose)


def draw(
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    shot: Shot,
    *,
    lines: bool = False,
) -> Picture:
    """Render the mesh in soft light; back sides are darker and red. `lines` shows the quads."""
    camera = shot.camera()
    vertices, triangles = vertices.astype(np.float64), triangles.astype(np.int64)
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
    colour = np.einsum("pk,pkc->pc", weight, colours[corner]) * light[:, None]
    colour[behind] *= (0.75, 0.5, 0.5)
    if lines:  # a quad's triangles share the side from the last corner to the first
        colour[(weight[:, [0, 2]] < 0.05).any(1)] *= 0.72
    picture = np.empty((*shown.shape, 3))
    picture[:] = BACKGROUND
    picture[shown] = np.minimum(colour, 255)
    return cv2.resize(picture, shot.size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def dots(picture: Picture, points: Float[np.ndarray, "L 3"], shot: Shot, *, numbered: bool = False) -> Picture:
    """Draw points on an image, also hidden ones."""
    camera = shot.camera()
    pixels, _ = camera.project(points)
    drawn = cv2.resize(picture, (camera.width_px, camera.height_px), interpolation=cv2.INTER_NEAREST)
    for number, (x, y) in enumerate(np.round(pixels).astype(int).tolist()):
        cv2.circle(drawn, (x, y), 2 * SMOOTHING, (190, 30, 60), -1, cv2.LINE_AA)
        if numbered:
            text, corner = str(number), (x + 3 * SMOOTHING, y - 2 * SMOOTHING)
            cv2.putText(drawn, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.62, (20, 40, 120), 1, cv2.LINE_AA)
    return cv2.resize(drawn, shot.size, interpolation=cv2.INTER_AREA)


def captioned(picture: Picture, text: str, size: float = 1.0) -> Picture:
    """Add a line of text below an image; size 1 is for pictures shown in full, 3 for a third of their width."""
    strip, scale, width = np.full((round(24 * size), picture.shape[1], 3), 255, np.uint8), 0.42 * size, round(size)
    left = (picture.shape[1] - cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, width)[0][0]) // 2
    base = round(16 * size)
    cv2.putText(strip, text, (left, base), cv2.FONT_HERSHEY_SIMPLEX, scale, (60, 60, 60), width, cv2.LINE_AA)
    return np.concatenate([picture, strip])


def colours_of(data: GNMData) -> Float[np.ndarray, "V 3"]:
    """Return the colour of each vertex' part, sRGB in [0, 255]."""
    colours = np.zeros((len(data.template_vertex_positions), 3))
    for name, colour in COLOURS.items():
        colours[group(data, name) > 0.5] = colour
    return colours


def without_corneas(data: GNMData) -> Bool[np.ndarray, "F"]:
    """Return a mask of all triangles but those of the transparent corneas, which would hide the iris."""
    clear = np.zeros(len(data.template_vertex_positions), bool)
    for joint, side in ((2, "left_eye"), (3, "right_eye")):
        offset = data.template_vertex_positions - data.template_joint_positions[joint]
        angle = np.arctan2(np.linalg.norm(offset[:, :2], axis=1), offset[:, 2])
        outer = (group(data, side) > 0.5) & (group(data, "eye_exteriors") > 0.5)
        clear |= outer & (angle < np.arcsin(eye_sections.LIMBUS_RADIUS / eye_sections.SCLERA_RADIUS) + 0.05)
    return ~clear[data.triangles].any(1)


def template(data: GNMData, faces: Int[np.ndarray, "F 3"]) -> Picture:
    colours = colours_of(data)
    views = {"front": FRONT, "half profile": (0.7, 0.0, 0.7), "profile": SIDE}
    shots = [Shot(target=HEAD, direction=d, width=0.31, size=(360, 440)) for d in views.values()]
    pictures = [draw(data.template_vertex_positions, faces, colours, shot) for shot in shots]
    wire = Shot(target=HEAD, direction=FRONT, width=0.31, size=(360, 440))
    plain = np.full_like(colours, 202)
    pictures.append(draw(data.template_vertex_positions, faces, plain, wire, lines=True))
    return _row(pictures, [*views, "its quads"])


def mouth(data: GNMData, faces: Int[np.ndarray, "F 3"], opened: Float[np.ndarray, "V 3"]) -> Picture:
    colours, vertices = colours_of(data), data.template_vertex_positions + opened
    views = {"jaw open": FRONT, "from below": (0.35, -0.55, 0.8), "from above": (0.0, 0.45, 0.9)}
    pictures = [
        draw(vertices, faces, colours, Shot(target=(0, 0.222, 0.1), direction=d, width=0.105, size=(330, 330)))
        for d in views.values()
    ]
    left = (data.template_vertex_positions[:, 0] > -1e-5)[faces].all(1)
    for title, positions in (("cut, at rest", data.template_vertex_positions), ("cut, jaw open", vertices)):
        shot = Shot(target=(0, 0.232, 0.075), direction=(-1, 0, 0), width=0.15, size=(330, 330))
        pictures.append(draw(positions, faces[left], colours, shot))
        views[title] = SIDE
    return _row(pictures, list(views))


def eye(data: GNMData, faces: Int[np.ndarray, "F 3"]) -> Picture:
    colours = colours_of(data)
    (row,) = np.flatnonzero(np.char.startswith(data.expression_names, "pupils"))
    centre = tuple((data.template_joint_positions[2] + (0, 0, 0.012)).tolist())
    pictures, titles = [], []
    for c in (-1.5, 0, 1.5):
        vertices = data.template_vertex_positions + c * data.expression_basis[row]
        shot = Shot(target=centre, direction=FRONT, width=0.046, size=(300, 260), distance=0.5)
        pictures.append(draw(vertices, faces, colours, shot))
        titles.append(f"pupil {c:+g}" if c else "front")
    for title, direction in (("from the side", (0.85, 0.1, 0.5)), ("from below", (0.2, -0.6, 0.8))):
        shot = Shot(target=centre, direction=direction, width=0.046, size=(300, 260), distance=0.5)
        pictures.append(draw(data.template_vertex_positions, faces, colours, shot))
        titles.append(title)
    return _row(pictures, titles)


def identity(data: GNMData, faces: Int[np.ndarray, "F 3"]) -> Picture:
    colours, rows = colours_of(data), []
    shot = Shot(target=HEAD, direction=(0.45, 0.0, 0.9), width=0.33, size=(230, 280))
    for c in (-3, 3):
        heads = [data.template_vertex_positions + c * data.vertex_identity_basis[k] for k in range(6)]
        names = [f"{data.identity_names[k]}  {c:+d}" for k in range(6)]
        rows.append(_row([draw(head, faces, colours, shot) for head in heads], names))
    return np.concatenate(rows)


def expressions(data: GNMData, faces: Int[np.ndarray, "F 3"], moved: dict[str, Float[np.ndarray, "V 3"]]) -> Picture:
    colours = colours_of(data)
    shot = Shot(target=(0, 0.262, 0.06), direction=(0.18, 0.0, 0.98), width=0.20, size=(250, 290))
    pictures = [draw(data.template_vertex_positions + by, faces, colours, shot) for by in moved.values()]
    half, names = len(moved) // 2, list(moved)
    return np.concatenate([_row(pictures[:half], names[:half]), _row(pictures[half:], names[half:])])


def landmarks(
    data: GNMData,
    faces: Int[np.ndarray, "F 3"],
    schemes: dict[str, LandmarkScheme],
    opened: Float[np.ndarray, "V 3"],
) -> Picture:
    colours, rest = colours_of(data) * 0.45 + 130, data.template_vertex_positions.astype(np.float64)
    close = Shot(target=(0, 0.266, 0.06), direction=FRONT, width=0.175, size=(470, 500))
    pictures = [dots(draw(rest, faces, colours, close), schemes["68"].points(rest), close, numbered=True)]
    # `dense` surrounds the head: only points that face the camera are drawn.
    for direction in (FRONT, SIDE):
        shot = Shot(target=HEAD, direction=direction, width=0.29, size=(400, 500))
        facing = schemes["dense"].points(_normals(rest, data.triangles)) @ np.array(direction) > 0.05
        points = schemes["dense"].points(rest)[facing]
        pictures.append(dots(draw(rest, faces, colours, shot), points, shot))
    oral = np.max([group(data, name) for name in ("teeth", "gums", "tongue")], 0) > 0.5
    shot = Shot(target=(0, 0.228, 0.09), direction=(0.15, 0.35, 0.9), width=0.085, size=(400, 500))
    inside = draw(rest + opened, faces[oral[faces].all(1)], colours, shot)
    pictures.append(dots(inside, schemes["oral"].points(rest + opened), shot, numbered=True))
    return _row(pictures, ["68", "dense, front", "dense, side", "oral, skin left out"])


def _normals(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    return vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles.astype(np.int64))).numpy()


def maps(data: GNMData) -> Picture:
    """Render the texture maps of skin (in the colours of its regions), left eye, upper teeth and tongue as quads."""
    hues = np.linspace(0, 179, len(REGIONS), endpoint=False)[np.argsort(np.arange(len(REGIONS)) * 7 % len(REGIONS))]
    region = [cv2.cvtColor(np.array([[[hue, 70, 235]]], np.uint8), cv2.COLOR_HSV2RGB)[0, 0] for hue in hues]
    colours = colours_of(data)
    for name, colour in zip(REGIONS, region, strict=True):
        colours[group(data, f"{name}_region") > 0.5] = colour
    pictures = []
    for name, side in (("skin", 641), ("left_eye", 190), ("upper_teeth_and_gums", 190), ("tongue", 190)):
        canvas = np.full((SMOOTHING * side, SMOOTHING * side, 3), BACKGROUND, np.uint8)
        own = group(data, name)[data.quads[:, 0]] > 0.5
        corners = np.round(data.quad_uvs[own] * (1, -1) * SMOOTHING * side + (0, SMOOTHING * side)).astype(np.int32)
        fills = colours[data.quads[own]].mean(1).astype(int)
        for corner, fill in zip(corners, fills.tolist(), strict=True):
            cv2.fillConvexPoly(canvas, corner, fill)
        cv2.polylines(canvas, list(corners), True, (110, 110, 110), 1, cv2.LINE_AA)
        small = cv2.resize(canvas, (side, side), interpolation=cv2.INTER_AREA)
        pictures.append(captioned(small, name.replace("_", " ")))
    column = np.concatenate(pictures[1:])
    height = max(len(column), len(pictures[0]))
    page = np.full((height, pictures[0].shape[1] + 12 + column.shape[1], 3), 255, np.uint8)
    page[: len(pictures[0]), : pictures[0].shape[1]] = pictures[0]
    page[: len(column), -column.shape[1] :] = column
    return page


def _row(pictures: list[Picture], titles: list[str]) -> Picture:
    return np.concatenate([captioned(picture, title) for picture, title in zip(pictures, titles, strict=True)], 1)


def units(data: GNMData) -> dict[str, Float[np.ndarray, "V 3"]]:
    """Project MakeHuman's face units onto the model's expression basis."""
    source = makehuman.read(makehuman.fetch())
    head = assembly.build_assembly(source, population.mean_person())
    basis, _ = np.linalg.qr(data.expression_basis.reshape(len(data.expression_basis), -1).T.astype(np.float64))
    displacements = {name: head.expression_displacement(source.target(f"faceunits/{name}")) for name in UNITS}
    return {name: (basis @ (basis.T @ unit.ravel())).reshape(unit.shape) for name, unit in displacements.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    data = gnm_npz.read(arguments.model)
    schemes = schemes_beside(arguments.model, data.template_vertex_positions)
    faces = data.triangles[without_corneas(data)]
    moved = units(data)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, picture in (
        ("template", template(data, faces)),
        ("mouth", mouth(data, faces, moved["jawOpen"])),
        ("eye", eye(data, faces)),
        ("identity", identity(data, faces)),
        ("expressions", expressions(data, faces, moved)),
        ("landmarks", landmarks(data, faces, schemes, 0.7 * moved["jawOpen"])),
        ("maps", maps(data)),
    ):
        file = arguments.out / f"{name}.jpg"
        cv2.imwrite(str(file), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        print(f"{file}: {picture.shape[1]} x {picture.shape[0]}, {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
