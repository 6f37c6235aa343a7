"""One picture of a capture's rig: cameras, head and scan from three sides, a scale, and what is wrong in words."""

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from registration.capture import triangulation
from registration.capture.native import natural_key
from registration.capture.scan import read_scan
from registration.doctor.diagnosis import Diagnosis
from registration.errors import InputError
from registration.storage.files import atomic_file
from registration.types import Camera, Capture

_WIDTH, _PANEL, _MARGIN, _HEADING, _ROW = 1200, 420, 20, 84, 31
_BACKGROUND, _PANEL_COLOUR, _INK, _FAINT = (250, 250, 248), (255, 255, 255), (30, 32, 38), (120, 124, 132)
_GOOD, _BAD, _HEAD, _SCAN = (38, 98, 176), (208, 44, 36), (240, 140, 30), (110, 165, 150)
_AXES = ((200, 60, 60), (60, 150, 60), (60, 90, 200))
_SCAN_POINTS, _LINE, _MAX_LINES = 3000, 92, 16
_Colour = tuple[int, int, int]
_Place = Callable[[np.ndarray], np.ndarray]  # points of the scene to pixels
_HEAD_M = 0.11  # radius of the sphere that stands for a head of which only the place is known
# Title, and which axes of the rig's frame point right and down.
_SIDES = (("from the front", (0, 1)), ("from the side", (2, 1)), ("from above", (0, 2)))


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """What is drawn, in a frame whose x and z span the rig and whose y points down."""

    names: tuple[str, ...]
    frusta: Float[np.ndarray, "N 5 3"]  # centre and the four corners of the image, m
    wrong: frozenset[str]
    head: Float[np.ndarray, "P 3"]
    scan: Float[np.ndarray, "S 3"]
    rotation: Float[np.ndarray, "3 3"]  # world to the frame
    target: Float[np.ndarray, "3"]  # where the head is, in the frame


def draw_rig(diagnosis: Diagnosis, path: Path) -> None:
    """Write the picture of a capture as a PNG file.

    Cameras are drawn as they are written, before any mend; a capture that cannot be read is a picture of its findings.

    Args:
        diagnosis: of the capture.
        path: the file; its folder is created.
    """
    capture = diagnosis.as_written
    scene = None if capture is None else _scene(capture, diagnosis)
    lines = _words(diagnosis)
    height = _HEADING + (_PANEL + _MARGIN if scene is not None else 0) + _ROW * len(lines) + _MARGIN
    page = Image.new("RGB", (_WIDTH, height), _BACKGROUND)
    pen = ImageDraw.Draw(page)
    _heading(pen, diagnosis, capture)
    top = _HEADING
    if scene is not None:
        for number, (title, axes) in enumerate(_SIDES):
            panel = _draw_side(scene, axes, title)
            page.paste(panel, (number * _WIDTH // 3 + 6, top))
        top += _PANEL + _MARGIN // 2
    for row, (text, colour) in enumerate(lines):
        pen.text((_MARGIN, top + _ROW * row), text, colour, _font(25))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as temporary:
        page.save(temporary, "PNG")


def _heading(pen: ImageDraw.ImageDraw, diagnosis: Diagnosis, capture: Capture | None) -> None:
    errors, warnings = len(diagnosis.errors), len(diagnosis.findings) - len(diagnosis.errors)
    counts = [f"{n} {word}{'' if n == 1 else 's'}" for n, word in ((errors, "error"), (warnings, "warning")) if n]
    verdict = " and ".join(counts) or "no fault found"
    title = (
        diagnosis.root.name
        if capture is None
        else f"{capture.subject}, {capture.expression}: {len(capture.views)} views"
    )
    pen.text((_MARGIN, 8), f"{title}; {verdict}", _INK if not errors else _BAD, _font(36))
    x = float(_MARGIN)
    for text, colour in (
        ("camera and its optical axis", _GOOD),
        ("wrong camera", _BAD),
        ("head", _HEAD),
        ("scan", _SCAN),
    ):
        pen.rectangle((x, 58, x + 16, 74), fill=colour)
        pen.text((x + 22, 52), text, _FAINT, _font(23))
        x += 22 + pen.textlength(text, _font(23)) + 26


def _words(diagnosis: Diagnosis) -> list[tuple[str, _Colour]]:
    """The findings as lines, errors first."""
    lines: list[tuple[str, _Colour]] = []
    for finding in diagnosis.findings:
        error = finding.severity == "error"
        evidence = f" ({finding.evidence})" if finding.evidence else ""
        text = f"{'ERROR' if error else 'warning'}: {finding.believed}{evidence}. {finding.mend}"
        wrapped = textwrap.wrap(text, _LINE, subsequent_indent="      ")
        lines += [(line, _BAD if error else _INK) for line in wrapped]
    if len(lines) > _MAX_LINES:
        lines = [*lines[: _MAX_LINES - 1], ("... and more: gnmreg capture check lists all", _FAINT)]
    return lines or [("No fault found.", _GOOD)]


def _scene(capture: Capture, diagnosis: Diagnosis) -> _Scene | None:
    if not capture.views or not all(np.isfinite(view.camera.T_cam_world).all() for view in capture.views):
        return None
    views = sorted(capture.views, key=lambda view: natural_key(view.name))
    cameras = [view.camera for view in views]
    landmarks = _landmarks(capture)
    scan = _scan(capture)
    target = _target(cameras, landmarks)
    rotation = _frame(cameras, target, landmarks)
    centres = np.stack([camera.centre for camera in cameras])
    size = 0.16 * max(float(np.median(np.linalg.norm(centres - target, axis=1))), 1e-6)
    head = landmarks if len(landmarks) else target + _HEAD_M * _sphere()
    wrong = {
        name for name in (view.name for view in views) for f in diagnosis.findings if _is_named(name, f.line, f.kind)
    }
    if any(finding.kind.startswith("poses") and finding.severity == "error" for finding in diagnosis.findings):
        wrong = {view.name for view in views}
    return _Scene(
        names=tuple(view.name for view in views),
        frusta=np.stack([_frustum(camera, size) for camera in cameras]) @ rotation.T,
        wrong=frozenset(wrong),
        head=head @ rotation.T,
        scan=scan @ rotation.T,
        rotation=rotation,
        target=rotation @ target,
    )


def _is_named(name: str, line: str, kind: str) -> bool:
    """Whether a finding about single cameras names a view."""
    words = line.replace(",", " ").replace(":", " ").replace(";", " ").split()
    return kind in ("unseen", "views-exchanged", "exposure", "distortion", "camera") and name in words


def _landmarks(capture: Capture) -> Float[np.ndarray, "P 3"]:
    names = {name for view in capture.views for name in view.landmarks}
    if not names:
        return np.zeros((0, 3))
    points = triangulation.triangulate(capture, "68" if "68" in names else sorted(names)[0])[0]
    return points[np.isfinite(points).all(-1)]


def _scan(capture: Capture) -> Float[np.ndarray, "S 3"]:
    if capture.scan is None:
        return np.zeros((0, 3))
    try:
        vertices = read_scan(capture.scan).vertices
    except InputError:  # it is a finding
        return np.zeros((0, 3))
    return vertices[:: max(1, len(vertices) // _SCAN_POINTS)]


def _target(cameras: Sequence[Camera], landmarks: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "3"]:
    """Where the head is: at the landmarks, else where the optical axes come nearest to one another."""
    if len(landmarks) >= 6:
        return np.median(landmarks, axis=0)
    axes = np.stack([camera.T_cam_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    centres = np.stack([camera.centre for camera in cameras])
    return np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]


def _frame(
    cameras: Sequence[Camera], target: Float[np.ndarray, "3"], landmarks: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "3 3"]:
    """Rotation whose rows are the rig's right, down and away from the first camera's side, by the images' down."""
    down = np.mean([camera.T_cam_world[1, :3] for camera in cameras], axis=0)
    away = target - np.mean([camera.centre for camera in cameras], axis=0)
    if np.linalg.norm(down) < 0.1:
        down = cameras[0].T_cam_world[1, :3]
    down = down / np.linalg.norm(down)
    away = away - (away @ down) * down
    if np.linalg.norm(away) < 1e-6:
        away = np.cross(down, [1.0, 0.3, 0.2])
    away = away / np.linalg.norm(away)
    return np.stack([np.cross(down, away), down, away])


def _frustum(camera: Camera, size: float) -> Float[np.ndarray, "5 3"]:
    corners = np.array(
        [[0, 0], [camera.width_px, 0], [camera.width_px, camera.height_px], [0, camera.height_px]], float
    )
    rays = np.column_stack([corners, np.ones(4)]) @ np.linalg.inv(camera.intrinsics).T
    rays *= size / np.linalg.norm(rays[:, :2], axis=1).mean() / 2.0
    depth = min(float(rays[0, 2]), 1.5 * size)
    rays *= depth / rays[:, 2:]
    return np.concatenate([camera.centre[None], rays @ camera.T_cam_world[:3, :3] + camera.centre])


def _sphere() -> Float[np.ndarray, "P 3"]:
    """Points on three circles."""
    angle = np.linspace(0, 2 * np.pi, 60)
    zero = np.zeros_like(angle)
    c, s = np.cos(angle), np.sin(angle)
    return np.concatenate([np.stack(p, -1) for p in ((c, s, zero), (c, zero, s), (zero, c, s))])


def _draw_side(scene: _Scene, axes: tuple[int, int], title: str) -> Image.Image:
    """One view of the scene without perspective."""
    width = _WIDTH // 3 - 12
    image = Image.new("RGB", (2 * width, 2 * _PANEL), _PANEL_COLOUR)
    pen = ImageDraw.Draw(image)
    flat = scene.frusta[:, :, list(axes)]
    points = np.concatenate([flat.reshape(-1, 2), scene.target[None, list(axes)]])
    low, high = points.min(0), points.max(0)
    room = np.array([2 * width - 240, 2 * _PANEL - 290])
    scale = float((room / np.maximum(high - low, 1e-9)).min())
    offset = np.array([width, _PANEL + 10]) - scale * (low + high) / 2

    def place(values: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
        return np.clip(values[:, list(axes)] * scale + offset, -1e5, 1e5)

    for x, y in place(scene.scan):
        pen.ellipse((x - 2, y - 2, x + 2, y + 2), fill=_SCAN)
    for x, y in place(scene.head):
        pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill=_HEAD)
    for name, frustum in zip(scene.names, scene.frusta, strict=True):
        _draw_camera(pen, place, frustum, scene.target, _BAD if name in scene.wrong else _GOOD)
    _draw_names(pen, place, scene, 2 * width)
    _draw_scale(pen, scale, 2 * _PANEL)
    _draw_axes(pen, scene.rotation, axes, (2 * width - 110, 2 * _PANEL - 100))
    pen.text((20, 12), title, _INK, _font(44))
    return image.resize((width, _PANEL), Image.Resampling.LANCZOS)


def _draw_camera(
    pen: ImageDraw.ImageDraw,
    place: _Place,
    frustum: Float[np.ndarray, "5 3"],
    target: Float[np.ndarray, "3"],
    colour: _Colour,
) -> None:
    """The pyramid of an image and its optical axis."""
    centre, *image = (_xy(corner) for corner in place(frustum))
    axis = frustum[1:].mean(0) - frustum[0]
    length = max(float((target - frustum[0]) @ axis) / float(axis @ axis), 1.6)
    end = _xy(place((frustum[0] + length * axis)[None])[0])
    pen.line((*centre, *end), fill=_pale(colour), width=3)
    pen.polygon(image, outline=colour, width=4)
    for corner in image:
        pen.line((*centre, *corner), fill=colour, width=4)
    pen.ellipse((centre[0] - 7, centre[1] - 7, centre[0] + 7, centre[1] + 7), fill=colour)


def _draw_names(pen: ImageDraw.ImageDraw, place: _Place, scene: _Scene, side: int) -> None:
    """The cameras' names, away from the head; those of wrong ones first, and no name over another."""
    (middle,) = place(scene.target[None])
    taken: list[tuple[float, float, float, float]] = []
    order = sorted(range(len(scene.names)), key=lambda k: (scene.names[k] not in scene.wrong, k))
    for number in order:
        name, (centre,) = scene.names[number][-14:], place(scene.frusta[number, :1])
        away = centre - middle
        away = away / max(float(np.linalg.norm(away)), 1e-6)
        width = pen.textlength(name, _font(38))
        x, y = centre + away * 26
        x, y = x - width * (0.5 - 0.5 * away[0]), y - 25 + 16 * away[1]
        x = float(np.clip(x, 4, side - width - 4))
        box = (x, y, x + width, y + 42)
        if any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
            continue
        taken.append(box)
        pen.text((x, y), name, _BAD if scene.names[number] in scene.wrong else _INK, _font(38))


def _draw_scale(pen: ImageDraw.ImageDraw, scale: float, height: int) -> None:
    """A bar of a round length."""
    length = 10.0 ** np.floor(np.log10(400 / scale))
    length *= next(factor for factor in (5, 2, 1) if factor * length * scale <= 400 or factor == 1)
    x, y = 30, height - 40
    pen.line((x, y, x + length * scale, y), fill=_INK, width=6)
    text = f"{length:g} m" if 1 <= length < 1e4 else f"{1000 * length:g} mm" if length < 1 else f"{length:.0e} m"
    pen.text((x, y - 56), text, _INK, _font(42))


def _draw_axes(
    pen: ImageDraw.ImageDraw, rotation: Float[np.ndarray, "3 3"], axes: tuple[int, int], origin: tuple[int, int]
) -> None:
    """The world's axes."""
    for name, colour, axis in zip("xyz", _AXES, rotation.T, strict=True):
        x, y = origin[0] + 70 * axis[axes[0]], origin[1] + 70 * axis[axes[1]]
        if np.hypot(x - origin[0], y - origin[1]) > 12:
            pen.line((*origin, x, y), fill=colour, width=5)
            pen.text((x + 6 * np.sign(x - origin[0]) - 8, y - 18), name, colour, _font(32))


def _xy(point: Float[np.ndarray, "2"]) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _pale(colour: _Colour) -> _Colour:
    red, green, blue = ((value + 2 * 255) // 3 for value in colour)
    return red, green, blue


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
