"""Decode one view: undistorted, resampled by area, in linear light.

A view is decoded at full size in its own 8 or 16 bits and converted to float in strips of rows, so that 6144 x 4096
needs a few hundred MB. Every result is the mean over the pixels of a block that undistortion has a source for.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from registration.capture.colour import require_encoding
from registration.capture.dense_maps import block_depth, depth_normals, is_colmap_map, read_colmap_map, read_depth
from registration.capture.file_colour import conversion_of
from registration.capture.headers import require_complete, require_size, undecodable
from registration.capture.label_maps import read_labels
from registration.capture.landmark_files import moved_spread
from registration.capture.masks import subject_coverage
from registration.capture.tiff import decode_tiff, is_tiff
from registration.errors import InputError
from registration.frames import opencv_intrinsics, srgb_to_linear
from registration.storage.exr_files import is_exr, read_exr
from registration.storage.image_files import decode
from registration.types import Camera, Capture, Colour, View, ViewPixels

STRIP_PIXELS = 2**21  # converted to float at a time: 25 MB of float32 RGB
_COLOUR = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
_SRGB = Colour()
_AS_STORED = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION


def read_view(view: View, capture: Capture, *, downsample: int = 1) -> ViewPixels:
    """Decode and undistort a view at 1/`downsample` of its size; K changes by that factor only.

    Args:
        view: its files are undistorted alike; normals stay in the camera's frame, and are those of the depths where the
            view has no others.
        capture: names the classes of the labels.
        downsample: whole factor; the remainder at the right and at the bottom is cut off.

    Raises:
        InputError: a file is missing, truncated, of another size or of an unusable pixel type, or the factor is larger
            than the image.
    """
    camera = view.camera
    if not 1 <= downsample <= min(camera.width_px, camera.height_px):
        raise InputError(
            "The view cannot be reduced by this factor",
            where=view.name,
            expected=f"1 to {min(camera.width_px, camera.height_px)}",
            got=downsample,
            fix="choose a smaller factor",
        )
    strips = list(_strips(camera, downsample))
    valid = _valid(camera, strips)
    rgb = _resample(read_image(view.image, camera, view.colour), _to_linear, strips, valid)
    mask = None if view.mask is None else _resample(read_mask(view.mask, camera), _to_coverage, strips, valid)
    reduced = downsampled_camera(camera, downsample)
    depth = None if view.depth is None else _block_depth(read_depth(view), strips, valid)
    normals = confidence = None
    if view.normals is not None:
        normals = _unit(in_camera(_resample(read_normals(view.normals, camera), decode_normals, strips, valid), view))
    elif depth is not None:
        normals = depth_normals(depth, _plane(reduced)).astype(np.float32)
    if view.confidence is not None:
        confidence = _resample(read_confidence(view.confidence, camera), _to_coverage, strips, valid)
    coverage = None
    if view.segmentation is not None:
        labels = read_labels(view.segmentation, camera, capture.classes, capture.labels)
        coverage = _label_coverage(labels, strips, valid, len(capture.classes))
    return ViewPixels(
        camera=reduced,
        rgb=rgb,
        mask=mask,
        normals=normals,
        label_coverage=coverage,
        valid=valid,
        depth=depth,
        confidence=confidence,
    )


def read_photograph(view: View, *, downsample: int = 1) -> tuple[UInt8[np.ndarray, "H W 3"], Camera]:
    """Decode and undistort a view's image alone, as 8 bit sRGB, for detectors and stereo.

    Args:
        view: its image.
        downsample: whole factor; the remainder at the right and at the bottom is cut off.

    Returns:
        The image, black where undistortion has no source, and its pinhole camera.

    Raises:
        InputError: as `read_image`.
    """
    strips = list(_strips(view.camera, downsample))
    raw = read_image(view.image, view.camera, view.colour)
    shape = (strips[-1].out.stop, strips[-1].columns)
    values = _resample(raw, lambda part: part.astype(np.float32), strips, np.ones(shape, np.float32))
    scale = np.float32(1 if raw.dtype == np.uint8 else 255 / 65535)
    return np.round(values * scale).astype(np.uint8), downsampled_camera(view.camera, downsample)


def read_coverage(view: View, *, downsample: int = 1) -> Float[np.ndarray, "H W"]:
    """Decode and undistort a view's mask alone; arguments as `read_photograph`.

    Raises:
        InputError: as `read_mask`.
    """
    assert view.mask is not None
    strips = list(_strips(view.camera, downsample))
    return _resample(read_mask(view.mask, view.camera), _to_coverage, strips, _valid(view.camera, strips))


def downsampled_camera(camera: Camera, downsample: int) -> Camera:
    """Return the undistorted camera of `read_view`'s arrays, whose pixels are blocks of `downsample` x `downsample`."""
    columns, rows = camera.width_px // downsample, camera.height_px // downsample
    whole = camera.cropped(0, 0, columns * downsample, rows * downsample)
    return replace(whole.scaled(columns, rows), distortion=())


def undistort_landmarks(view: View, scheme: str) -> Float[np.ndarray, "L 3"]:
    """Return a view's landmarks (x_px, y_px, confidence) in the undistorted full-size image."""
    return _undistorted(view.camera, np.array(view.landmarks[scheme], np.float64))


def undistorted_spread(view: View, scheme: str) -> Float[np.ndarray, "L"]:
    """Return the spread of a view's landmarks in the undistorted full-size image, px."""
    spread_px = np.asarray(view.landmark_spread_px[scheme], np.float64)
    if not view.camera.distortion:
        return spread_px
    return moved_spread(partial(_undistorted, view.camera), np.array(view.landmarks[scheme], np.float64), spread_px)


def _undistorted(camera: Camera, landmarks: Float[np.ndarray, "L 3"]) -> Float[np.ndarray, "L 3"]:
    """Rows (x_px, y_px, confidence) without the camera's distortion."""
    landmarks = landmarks.copy()
    if camera.distortion and len(landmarks):
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
        # Points and K have the same pixel convention, so that OpenCV's does not matter.
        undistorted = cv2.undistortPoints(
            landmarks[:, None, :2],
            camera.intrinsics,
            np.array(camera.distortion),
            P=camera.intrinsics,
            criteria=criteria,
        )
        landmarks[:, :2] = undistorted[:, 0]
    return landmarks


def distort_points(camera: Camera, points: Float[np.ndarray, "P 2"]) -> Float[np.ndarray, "P 2"]:
    """Return pixels of the stored image, with the lens' distortion, for pixels of the undistorted full-size image."""
    if not camera.distortion or not len(points):
        return points.copy()
    rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(camera.intrinsics).T
    lens = np.array(camera.distortion)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.intrinsics, lens)[0][:, 0]


def read_image(path: Path, camera: Camera, colour: Colour = _SRGB) -> np.ndarray:
    """Read an image as (H, W, 3) uint8 or uint16 sRGB, distorted. Grey is repeated; alpha and EXIF are ignored.

    Args:
        path: of the file.
        camera: its size.
        colour: what its values mean; a profile in the file counts, too (`file_colour.conversion_of`). An image that is
            sRGB keeps its values, any other becomes 16 bit sRGB.

    Raises:
        InputError: the file is missing, damaged, of another size, or its colours cannot be converted.
    """
    if require_size(path, "image", camera.width_px, camera.height_px).floating:
        require_encoding(path, colour)
    conversion = conversion_of(path, colour)
    pixels = _imread(path, "image", camera, _COLOUR)
    if conversion is not None and pixels.dtype in (np.uint8, np.uint16, np.float32):
        return conversion.to_srgb(path, pixels)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(
            "The image has an unusable pixel type",
            where=path,
            expected="8 or 16 bits per channel",
            got=pixels.dtype,
            fix="convert it to 8 or 16 bit sRGB",
        )
    return pixels


def read_mask(path: Path, camera: Camera) -> UInt8[np.ndarray, "H W"]:
    """Read a mask, 255 = subject, distorted (`masks.subject_coverage`). Raises InputError if it is none."""
    return subject_coverage(path, _imread(path, "mask", camera, _AS_STORED))


def read_normals(path: Path, camera: Camera) -> np.ndarray:
    """Read a normal map as (H, W, 3) uint16, encoded, or float32, as it is; distorted."""
    if is_colmap_map(path):
        return read_colmap_map(path, "normal map", camera, 3)
    pixels = _imread(path, "normal map", camera, _COLOUR)
    if pixels.dtype != np.uint16:
        raise InputError(
            "The normal map has too few bits",
            where=path,
            expected="16 bit RGB PNG, n = 2 v / 65535 - 1",
            got=pixels.dtype,
            fix="write it with 16 bits per channel",
        )
    return pixels


def read_confidence(path: Path, camera: Camera) -> UInt8[np.ndarray, "H W"]:
    """Read a confidence map of normals and depths, 255 = 1, distorted. Raises InputError if it is none."""
    pixels = _imread(path, "confidence map", camera, _AS_STORED)
    if pixels.dtype != np.uint8 or pixels.ndim != 2:
        raise InputError(
            "The confidence map cannot be used",
            where=path,
            expected="one channel of 8 bits, 255 where normals and depths are certain",
            got=f"{pixels.dtype}, shape {pixels.shape}",
            fix="write it as a grey PNG of 8 bits",
        )
    return pixels


def _imread(path: Path, role: str, camera: Camera, flags: int) -> np.ndarray:
    require_size(path, role, camera.width_px, camera.height_px)
    require_complete(path, role)
    refuse = undecodable(path, role)
    with path.open("rb") as file:
        start = file.read(4)
    if is_tiff(start):
        pixels = decode_tiff(path, refuse)
    else:
        pixels = read_exr(path, refuse) if is_exr(start) else decode(path, flags, refuse)
    if pixels.shape[:2] != (camera.height_px, camera.width_px):
        raise refuse(expected="the size in its header", got=f"shape {pixels.shape}")
    return pixels


@dataclass(frozen=True, kw_only=True)
class _Strip:
    """Some rows of the result and the source of their pixels."""

    out: slice  # rows of the result
    columns: int  # of the result
    downsample: int
    source: slice  # rows of the distorted full-size image that are needed
    warp: tuple[np.ndarray, np.ndarray] | None  # source x and y of every full-size pixel, relative to `source`

    def reduce(self, block: np.ndarray) -> np.ndarray:
        """Return block means of undistorted full-size pixels from float rows `source`; without a source they are 0."""
        if self.warp is None:
            block = block[:, : self.columns * self.downsample]
        else:
            block = cv2.remap(block, *self.warp, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0,) * 4)
        if self.downsample == 1:
            return block
        size = (self.columns, self.out.stop - self.out.start)
        return cv2.resize(block, size, interpolation=cv2.INTER_AREA)  # exact, because the factor is whole

    def average(self, block: np.ndarray, valid: Float[np.ndarray, "H W"]) -> np.ndarray:
        """As `reduce`, over pixels that have a source only; 0 where none has."""
        mean = self.reduce(block)
        if self.warp is None:
            return mean
        weight = valid[self.out].reshape(mean.shape[:2] + (1,) * (mean.ndim - 2))
        return np.where(weight > 1e-3, mean / np.maximum(weight, 1e-3), 0)


def _strips(camera: Camera, downsample: int) -> Iterator[_Strip]:
    rows, columns = camera.height_px // downsample, camera.width_px // downsample
    step = max(1, STRIP_PIXELS // (camera.width_px * downsample))
    for first in range(0, rows, step):
        out = slice(first, min(first + step, rows))
        source, warp = slice(out.start * downsample, out.stop * downsample), None
        if camera.distortion:
            source, warp = _warp(camera, source, columns * downsample)
        yield _Strip(out=out, columns=columns, downsample=downsample, source=source, warp=warp)


def _warp(camera: Camera, rows: slice, width_px: int) -> tuple[slice, tuple[np.ndarray, np.ndarray]]:
    """Return the source rows that undistorted rows need, and the maps into them."""
    intrinsics = opencv_intrinsics(camera.intrinsics)
    window = intrinsics.copy()
    window[1, 2] -= rows.start
    size = (width_px, rows.stop - rows.start)
    x, y = cv2.initUndistortRectifyMap(intrinsics, np.array(camera.distortion), None, window, size, cv2.CV_32FC1)
    if not np.isfinite(y).all():  # a rational model's denominator crosses zero: no source
        x, y = np.nan_to_num(x, nan=-1e6), np.nan_to_num(y, nan=-1e6)
    first = int(np.clip(np.floor(y.min()), 0, camera.height_px - 1))
    last = int(np.clip(np.ceil(y.max()) + 1, first + 1, camera.height_px))
    return slice(first, last), (x, y - first)


def _valid(camera: Camera, strips: list[_Strip]) -> Float[np.ndarray, "H W"]:
    """Return the fraction of each block that has a source."""
    valid = np.ones((strips[-1].out.stop, strips[-1].columns), np.float32)
    if camera.distortion:
        for strip in strips:
            valid[strip.out] = strip.reduce(
                np.ones((strip.source.stop - strip.source.start, camera.width_px), np.float32)
            )
    return valid


def _resample(
    raw: np.ndarray, decode: Callable[[np.ndarray], np.ndarray], strips: list[_Strip], valid: Float[np.ndarray, "h w"]
) -> np.ndarray:
    """Means of the decoded pixels: (h, w) or (h, w, 3)."""
    result = np.empty((*valid.shape, *raw.shape[2:]), np.float32)
    for strip in strips:
        result[strip.out] = strip.average(decode(raw[strip.source]), valid)
    return result


def _block_depth(
    depth: Float[np.ndarray, "H W"], strips: list[_Strip], valid: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Mean depth of the pixels of each block that have one; 0 where few have, or where they are of two surfaces."""
    share = _resample(depth, lambda raw: (raw > 0).astype(np.float32), strips, valid)
    total, squares = _resample(depth, np.positive, strips, valid), _resample(depth, np.square, strips, valid)
    return block_depth(share, total, squares).astype(np.float32)


def _plane(camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Rays through the pixels of a camera without distortion, with z = 1."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    return np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics).T


def _label_coverage(
    labels: UInt8[np.ndarray, "H W"], strips: list[_Strip], valid: Float[np.ndarray, "h w"], count: int
) -> Float[np.ndarray, "h w K"]:
    """Return the coverage of each block by each class: classes are resampled one by one, as masks are."""
    coverage = np.zeros((*valid.shape, count), np.float32)
    for strip in strips:
        block = labels[strip.source]
        for index in np.flatnonzero(np.bincount(block.ravel(), minlength=count)):
            coverage[strip.out, :, index] = strip.average((block == index).astype(np.float32), valid)
    return coverage


@cache
def _linear_table(bits: int) -> Float[np.ndarray, "levels"]:
    levels = 2**bits
    return srgb_to_linear(np.arange(levels) / (levels - 1)).astype(np.float32)


def _to_linear(raw: np.ndarray) -> Float[np.ndarray, "H W 3"]:
    if raw.dtype == np.uint8:
        return cv2.LUT(raw, _linear_table(8))
    return _linear_table(16)[raw]


def _to_coverage(raw: UInt8[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    return raw.astype(np.float32) / 255


def decode_normals(raw: np.ndarray) -> Float[np.ndarray, "H W 3"]:
    """Return the vectors that `read_normals` has encoded, as stored: about unit length; 0 where there is none."""
    if raw.dtype == np.float32:
        return raw
    background = (raw[..., 0] | raw[..., 1] | raw[..., 2]) == 0
    normals = raw * np.float32(2 / 65535) - 1
    normals[background] = 0
    return normals


def in_camera(normals: Float[np.ndarray, "*S 3"], view: View) -> Float[np.ndarray, "*S 3"]:
    """Return normals of a view's map, in the axes that it is said to have, in the camera's frame (OpenCV's axes)."""
    if view.normals_frame == "camera_opencv":
        return normals
    rotation = view.camera.T_cam_world[:3, :3] if view.normals_frame == "world" else np.diag([1.0, -1.0, -1.0])
    return np.asarray(normals @ rotation.T.astype(normals.dtype), normals.dtype)


def _unit(vectors: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Normalize; 0 where the mean is too short to have a direction (background, or normals that cancel)."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-2, vectors / np.maximum(length, 1e-2), 0)
