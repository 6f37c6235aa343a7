"""Read native capture folders: `capture.toml`, a COLMAP model, and image files (docs/formats.md)."""

import os
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path, PurePosixPath

from registration.capture.colmap import read_cameras
from registration.capture.colour import require_encoding
from registration.capture.dense_maps import COLMAP_SUFFIXES, DEPTH_SUFFIXES
from registration.capture.file_colour import conversion_of
from registration.capture.headers import require_size
from registration.capture.image_names import image_file
from registration.capture.landmark_files import read_landmarks
from registration.capture.scan import find_scan
from registration.capture.settings import CaptureSettings, read_settings
from registration.errors import InputError
from registration.storage.reading import open_file
from registration.types import Camera, Capture, View

_MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


def read_capture(root: Path, *, cameras_of: Callable[[Path], Mapping[str, Camera]] = read_cameras) -> Capture:
    """Read a native capture folder; of images only the headers. Views are in natural order of their names.

    A capture may come from an untrusted source: symbolic links that lead out of its folder are refused.

    Args:
        root: the folder, with capture.toml, sparse/ and images/ (docs/formats.md).
        cameras_of: reads the cameras in the folder of the COLMAP model, by the images' file names.

    Raises:
        InputError: `capture.toml`, the COLMAP model or a landmark file is damaged, a camera model is not supported, a
            pose is singular or not finite, an image is missing or of another size than its camera's, or a link leads
            out of the folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise InputError(
            "The capture folder is missing",
            where=root,
            expected="a folder with capture.toml and sparse/",
            got="no such folder",
            fix="check the path",
        )
    settings = read_settings(_inside(root, root / "capture.toml"), partial(_inside, root))
    return assemble(root, settings, read_calibration(root, cameras_of))


def read_leniently(root: Path) -> CaptureSettings:
    """Read a capture's settings with a world in any unit. Raises InputError as `read_capture`."""
    return read_settings(_inside(root, root / "capture.toml"), partial(_inside, root), any_unit=True)


def read_calibration(
    root: Path, cameras_of: Callable[[Path], Mapping[str, Camera]] = read_cameras
) -> Mapping[str, Camera]:
    """Read a capture's cameras by the names of their images. Raises InputError as `read_capture`."""
    for path in (root / "sparse", *sorted((root / "sparse").rglob("*"))):
        _inside(root, path)
    return cameras_of(root / "sparse")


def assemble(root: Path, settings: CaptureSettings, cameras: Mapping[str, Camera]) -> Capture:
    """Read the other files of a capture. Raises InputError as `read_capture`."""
    views = tuple(_read_view(root, name, cameras[name], settings) for name in sorted(cameras, key=natural_key))
    _check_names(root, views)
    settings.colours.require_views(root / "capture.toml", [view.name for view in views])
    scan, truth = find_scan(root), root / "ground_truth.npz"
    return Capture(
        root=root,
        subject=settings.subject,
        expression=settings.expression,
        views=views,
        classes=settings.classes,
        labels=settings.labels,
        tags=settings.tags,
        scan=None if scan is None else _optional(root, scan),
        ground_truth=_optional(root, truth),
        photographs=settings.photographs,
        head=settings.head,
    )


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts cam2 before cam10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def _read_view(root: Path, file_name: str, camera: Camera, settings: CaptureSettings) -> View:
    relative = image_file(root, file_name)
    image = _inside(root, root / "images" / relative)
    name = str(relative.with_suffix(""))
    colour = settings.colours.of(name)
    if require_size(image, "image", camera.width_px, camera.height_px).floating:
        require_encoding(image, colour)
    conversion_of(image, colour)
    landmarks = _channel(root, "landmarks", relative, ".json")
    marks = None if landmarks is None else read_landmarks(landmarks)
    return View(
        name=name,
        camera=camera,
        image=image,
        mask=_channel(root, "masks", relative, *_MASK_SUFFIXES),
        normals=_channel(root, "normals", relative, ".png", *COLMAP_SUFFIXES),
        normals_frame=settings.normals_frame,
        depth=_channel(root, "depth", relative, *DEPTH_SUFFIXES),
        depth_unit_m=settings.depth_unit_m,
        confidence=_channel(root, "confidence", relative, ".png"),
        segmentation=_channel(root, "segmentation", relative, ".png"),
        landmarks={} if marks is None else marks.points,
        landmark_spread_px={} if marks is None else marks.spread_px,
        colour=colour,
    )


def _channel(root: Path, folder: str, image: PurePosixPath, *suffixes: str) -> Path | None:
    """The file of an image in a channel's folder: its suffix replaced, or kept and followed by another."""
    names = [image.with_suffix(suffix) for suffix in suffixes]
    names += [image.with_name(image.name + suffix) for suffix in suffixes]
    return next((path for name in names if (path := _optional(root, root / folder / name)) is not None), None)


def _optional(root: Path, path: Path) -> Path | None:
    """The path of a file that may be missing. Raises InputError if something else is in its place."""
    if not os.path.lexists(path):
        return None
    fix = "put the file itself there, or remove what is in its place"
    open_file(
        _inside(root, path), partial(InputError, "A file of the capture cannot be read", where=path, fix=fix)
    ).close()
    return path


def _inside(root: Path, path: Path) -> Path:
    """Return the path if it stays within the capture when symbolic links are followed. Raises InputError."""
    if not (target := Path(os.path.realpath(path))).is_relative_to(os.path.realpath(root)):
        raise InputError(
            "A link leads out of the capture",
            where=path,
            expected="a file inside the capture's folder",
            got=f"a link to {target}",
            fix="put the file itself there",
        )
    return path


def _check_names(root: Path, views: tuple[View, ...]) -> None:
    lengths: dict[str, tuple[int, str]] = {}
    images: dict[str, Path] = {}
    for view in views:
        if view.name in images:
            raise InputError(
                "Two images differ in their suffix only",
                where=root / "images",
                expected="names that stay unique without it: they also name masks and landmarks",
                got=f"{images[view.name].name} and {view.image.name}",
                fix="rename one of them",
            )
        images[view.name] = view.image
    for view in views:
        for scheme, points in view.landmarks.items():
            count, name = lengths.setdefault(scheme, (len(points), view.name))
            if len(points) != count:
                raise InputError(
                    "A landmark scheme has two lengths",
                    where=root / "landmarks" / f"{view.name}.json",
                    expected=f'{count} points in scheme "{scheme}", as for {name}',
                    got=f"{len(points)} points",
                    fix="give every view the whole scheme, with confidence 0 where a point is not visible",
                )
