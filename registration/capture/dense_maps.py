"""Read depth maps, and the depth and normal maps of COLMAP's dense reconstruction (docs/formats.md, "Depth maps")."""

import math
import re
from functools import partial
from io import BufferedReader
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from registration.capture.headers import require_complete
from registration.errors import InputError
from registration.storage.exr_files import exr_size, read_exr_depth
from registration.storage.image_files import MAX_PIXELS, decode, image_size
from registration.storage.reading import Refuse, open_file
from registration.types import Camera, View

COLMAP_SUFFIXES = (".geometric.bin", ".photometric.bin")
DEPTH_SUFFIXES = (".png", ".npy", ".tif", ".tiff", ".exr", *COLMAP_SUFFIXES)
_COLMAP_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&(\d{1,2})&")
_SAME_ASPECT = 0.01
_STEP_M, _STEP_PX = 3e-3, 8.0  # range of depths around a pixel, beyond which it lies between two surfaces
_SMOOTHING_PX = 1.0  # standard deviation, of depths before they are differentiated
_MIN_SHARE = 0.74  # of a block's pixels with a depth: three of four
_MAX_SPREAD = 0.01  # of a block's depths, of their mean: 5 mm at half a metre
_LEAST_COSINE = 0.25  # of incidence, 75 degrees: depths change too fast beyond


def is_colmap_map(path: Path) -> bool:
    """Return whether a path is that of a map of COLMAP's dense reconstruction."""
    return path.suffix == ".bin"


def read_colmap_map(path: Path, role: str, camera: Camera, channels: int) -> Float[np.ndarray, "H W C"]:
    """Read a map of COLMAP: `width&height&channels&`, then float32, rows of one channel after the other.

    Args:
        path: `NAME.geometric.bin` or `NAME.photometric.bin`.
        role: what messages call it.
        camera: a smaller map, as COLMAP makes with a largest image size, is enlarged to its size by repetition.
        channels: 1 for depths, 3 for normals.

    Raises:
        InputError: the file is damaged, or has another number of channels or another shape.
    """
    refuse = _refusal(path, role)
    with open_file(path, refuse) as stream:
        width, height, found = _colmap_header(stream, refuse)
        if found != channels:
            raise refuse(expected=f"{channels} channels", got=found)
        values = np.frombuffer(stream.read(4 * width * height * channels), "<f4").reshape(channels, height, width)
    if abs(width * camera.height_px / (height * camera.width_px) - 1) > _SAME_ASPECT:
        raise refuse(expected=f"the shape of {camera.width_px} x {camera.height_px} px", got=f"{width} x {height} px")
    size = (camera.width_px, camera.height_px)
    stretched = [cv2.resize(channel, size, interpolation=cv2.INTER_NEAREST) for channel in values]
    return np.nan_to_num(np.stack(stretched, -1), nan=0.0, posinf=0.0, neginf=0.0)


def _colmap_header(stream: BufferedReader, refuse: Refuse) -> tuple[int, int, int]:
    """Width, height, channels; the stream is then at the values, and holds exactly them. Raises InputError."""
    match = _COLMAP_HEADER.match(stream.read(24))
    if match is None:
        raise refuse(expected="a header width&height&channels&", got="another start")
    width, height, channels = (int(digits) for digits in match.groups())
    held = stream.seek(0, 2) - match.end()
    stream.seek(match.end())
    if not 0 < width * height <= MAX_PIXELS or held != 4 * width * height * channels:
        raise refuse(expected=f"{width} x {height} x {channels} float32 after the header", got=f"{held} bytes")
    return width, height, channels


def read_depth(view: View) -> Float[np.ndarray, "H W"]:
    """Read a view's depth map: metres along the optical axis, float32, distorted as the image; 0 where there is none.

    Args:
        view: with a depth map.

    Raises:
        InputError: it cannot be read, has another size than the camera, or integers without a stated unit.
    """
    path, camera, role = view.depth, view.camera, "depth map"
    assert path is not None
    refuse = _refusal(path, role)
    if is_colmap_map(path):
        values: np.ndarray = read_colmap_map(path, role, camera, 1)[..., 0]
    elif path.suffix == ".npy":
        values = _read_npy(path, refuse)
    elif path.suffix == ".exr":
        exr_size(path, refuse, depth=True)
        values = read_exr_depth(path, refuse)
    else:
        image_size(path, refuse)
        require_complete(path, role)
        values = decode(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION, refuse)
    if values.shape != (camera.height_px, camera.width_px):
        raise refuse(expected=f"one channel of {camera.width_px} x {camera.height_px} px", got=f"shape {values.shape}")
    if values.dtype == np.uint8:
        raise refuse(expected="16 bit or floating-point depths", got="8 bits, steps of a centimetre or more")
    unit_m = view.depth_unit_m
    if unit_m is None and values.dtype.kind in "ui":
        raise InputError(
            "The depth maps have no unit",
            where=path,
            expected='[depth] unit = "mm", or another one, in capture.toml',
            got=f"integers up to {values.max()}",
            fix='write [depth] and the line unit = "mm" into capture.toml',
        )
    depth = np.nan_to_num(values.astype(np.float32) * np.float32(unit_m or 1.0), nan=0.0, posinf=0.0, neginf=0.0)
    return depth.clip(0)


def _read_npy(path: Path, refuse: Refuse) -> np.ndarray:
    with open_file(path, refuse) as stream:
        try:
            version = np.lib.format.read_magic(stream)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(stream)
            start = stream.tell()
            held = stream.seek(0, 2) - start
        except Exception as error:  # a damaged header makes NumPy raise nearly anything
            raise refuse(expected="a NumPy array", got=f"{type(error).__name__}: {error}") from None
        if dtype.kind not in "fui" or math.prod(shape) * dtype.itemsize != held:
            raise refuse(expected="one array of numbers", got=f"type {dtype}, shape {shape}, {held} bytes")
        stream.seek(0)
        array: np.ndarray = np.lib.format.read_array(stream, allow_pickle=False)
        return array


def block_depth(
    share: Float[np.ndarray, "h w"], total: Float[np.ndarray, "h w"], squares: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Return the mean depth of blocks of pixels; 0 where few have one, or where they are of two surfaces.

    Args:
        share: of a block's pixels, those that have a depth.
        total: mean over all of a block's pixels of their depths, 0 for those without.
        squares: the same of the squared depths.
    """
    mean, square = total / np.maximum(share, 1e-3), squares / np.maximum(share, 1e-3)
    spread = np.sqrt(np.maximum(square - mean**2, 0))
    return np.where((share > _MIN_SHARE) & (spread < _MAX_SPREAD * mean), mean, 0)


def depth_normals(depth: Float[np.ndarray, "h w"], rays: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Compute the unit normals of a depth map, towards the camera, in its frame.

    Args:
        depth: along the optical axis, metres; 0 where there is none.
        rays: through the pixels, with z = 1.

    Returns:
        0 where there is none: beside pixels without a depth, at steps, and at grazing incidence.
    """
    known = depth > 0
    if not known.any() or min(depth.shape) < 3:
        return np.zeros_like(rays)
    pixel = float(np.median(np.linalg.norm(np.diff(rays, axis=1), axis=-1)))
    known &= ~_at_step(depth, known, pixel)
    smooth = _blurred(np.where(known, depth, 0)) / np.maximum(_blurred(known.astype(np.float64)), 1e-6)
    points = rays * smooth[..., None]
    normals = np.zeros_like(points)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    towards = np.cross(down, right)  # right x down points away from the camera
    length = np.linalg.norm(towards, axis=-1, keepdims=True)
    normals[1:-1, 1:-1] = towards / np.maximum(length, 1e-20)
    whole = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0).astype(bool)
    cosine = -(normals * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
    normals[~whole | (cosine < _LEAST_COSINE)] = 0
    return normals


def _at_step(depth: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], pixel: float) -> Bool[np.ndarray, "h w"]:
    kernel = np.ones((3, 3), np.uint8)
    lowest = cv2.erode(np.where(known, depth, np.inf).astype(np.float32), kernel)
    highest = cv2.dilate(np.where(known, depth, 0).astype(np.float32), kernel)
    return np.asarray(highest - lowest > np.maximum(_STEP_M, _STEP_PX * pixel * depth))


def _blurred(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return cv2.GaussianBlur(values.astype(np.float64), (0, 0), _SMOOTHING_PX)


def _refusal(path: Path, role: str) -> Refuse:
    return partial(InputError, f"The {role} cannot be used", where=path, fix="see depth maps in docs/formats.md")
