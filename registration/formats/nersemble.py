"""The NeRSemble dataset: a participant's sequence, versions 1 and 2 and VHAP's layout of both.

`camera_params.json` has one K for all cameras, of images of 2200 x 3208 px, and poses world to camera with OpenCV's
axes in metres. The images of version 1 are half as large: K is scaled. The centre of pixel (0, 0) is taken to be at
(0.5, 0.5), as the dataset's own renderers do. github.com/tobias-kirschstein/nersemble-data (version 2),
github.com/tobias-kirschstein/nersemble (version 1), github.com/ShenhanQian/VHAP
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.capture.native import natural_key
from registration.capture.text import listed
from registration.errors import InputError
from registration.formats.fields import Fields, number_array, read_object
from registration.formats.files import stored_size
from registration.formats.photographs import check_rotation, left_out
from registration.formats.source import Format, ReadOptions, SourceCapture, SourceView, VideoFrame
from registration.formats.videos import read_video_header
from registration.storage.reading import read_bytes
from registration.types import Colour

_TITLE = "NeRSemble camera file"
_PARAMS = "camera_params.json"
_SIZE_PX = (2200, 3208)  # of the images that K belongs to, where the file does not say it
_IMAGES = ("images", "images-2x", "images-2x-73fps", "images_2", "images_4")  # folders, with their alpha maps:
_ALPHAS = ("alpha_maps", "alpha_map", "alpha_map-73fps")
_FRAME_FOLDER = re.compile(r"frame_(\d+)")
_IMAGE = re.compile(r"cam_([0-9A-Za-z]+)(?:_(\d+))?\.(png|jpg|jpeg|mp4)", re.IGNORECASE)
_MAX_NPY_BYTES = 2**16


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Where the files of a sequence are.

    Attributes:
        sequence: folder of the images.
        participant: name of the participant.
        params: the cameras' file.
        colours: colour_calibration.json, or a folder of SERIAL.npy; None: there are none.
    """

    sequence: Path
    participant: str
    params: Path
    colours: Path | None


def _detect(path: Path) -> bool:
    return path.is_dir() and (find_params(path) is not None) and bool(sequences(path))


def find_params(path: Path) -> Path | None:
    """Return the cameras' file of a participant's or a sequence's folder, None if there is none."""
    path = path.resolve()
    for folder in (path, path.parent, path.parent.parent):
        for file in (folder / "calibration" / _PARAMS, folder / _PARAMS):
            if file.is_file():
                return file
    for root, name in ((path.parent, path.name), (path.parent.parent, path.parent.name)):  # VHAP's layout of version 1
        if (file := root / "camera_params" / name / _PARAMS).is_file():
            return file
    return None


def sequences(path: Path) -> list[Path]:
    """Return the sequences in a participant's folder, or the folder itself if it is a sequence."""
    if _is_sequence(path):
        return [path]
    parent = path / "sequences" if (path / "sequences").is_dir() else path
    below = [folder for folder in parent.iterdir() if folder.is_dir() and _is_sequence(folder)]
    return sorted(below, key=lambda folder: natural_key(folder.name))


def _is_sequence(folder: Path) -> bool:
    if any((folder / name).is_dir() for name in _IMAGES):
        return True
    return any(_FRAME_FOLDER.fullmatch(item.name) and item.is_dir() for item in folder.glob("frame_*"))


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read one frame of a sequence; of a participant's folder the sequence that `options.expression` names.

    Raises:
        InputError: the cameras are missing or malformed, no sequence is named, the frame does not exist, an image is
            missing, or sizes are not those of the calibration.
    """
    layout = _layout(path, options)
    params = read_object(layout.params, _TITLE)
    poses = _poses(params)
    K, size_px = params.array("intrinsics", (3, 3)), _SIZE_PX
    if "width" in params or "height" in params:
        size_px = (params.size("width"), params.size("height"))
    frame, images = _images(layout.sequence, options.frame)
    unknown = sorted(set(images) - set(poses), key=natural_key)
    used = [serial for serial in sorted(images, key=natural_key) if serial in poses]
    if not used:
        raise params.error("world_2_cam", f"poses of the cameras {listed(unknown, 4)}", listed(list(poses), 4))
    colours = _colours(layout.colours, used)
    alphas = _alpha_maps(layout.sequence, frame)
    views, resized = [], []
    for serial in used:
        image = images[serial]
        width_px, height_px = _size(image)
        mask = alphas.get(serial)
        if mask is not None and stored_size(mask) != (width_px, height_px):  # as version 1 has beside smaller images
            resized.append(mask.name)
            mask = None
        views.append(
            SourceView(
                name=f"cam_{serial}",
                image=VideoFrame(file=image, index=frame) if image.suffix.lower() == ".mp4" else image,
                width_px=width_px,
                height_px=height_px,
                intrinsics=_scaled(K, size_px, (width_px, height_px), params),
                T_cam_world=poses[serial],
                colour=colours.get(serial, Colour()),
                mask=mask,
            )
        )
    notes = [f"frame {frame} was read", *left_out(unknown, f"not in {_PARAMS}")]
    if resized:
        names = listed(resized, 3)
        notes.append(f"{len(resized)} alpha maps were left out, not of their image's size: {names}; resize them to it")
    return SourceCapture(
        format=FORMAT.name,
        root=layout.sequence,
        subject=options.subject or layout.participant,
        expression=options.expression or layout.sequence.name,
        views=tuple(views),
        unit_m=1.0,
        notes=tuple(notes),
    )


def _layout(path: Path, options: ReadOptions) -> Layout:
    params = find_params(path)
    found = sequences(path) if path.is_dir() else []
    if params is None or not found:
        expected = f"a participant's or a sequence's folder, with calibration/{_PARAMS}"
        got = "no sequence with images" if params else f"no {_PARAMS}"
        raise _error("The NeRSemble capture cannot be read", path, expected, got, "check the path")
    if len(found) == 1:
        sequence = found[0]
    else:
        named = [folder for folder in found if folder.name == options.expression]
        if not named:
            names = listed([folder.name for folder in found], 8)
            fix = "name one of them with --expression, or give its folder"
            raise _error("The participant has several sequences", path, "one sequence", names, fix)
        sequence = named[0]
    resolved = sequence.resolve()
    home = resolved.parent.parent if resolved.parent.name == "sequences" else resolved.parent
    candidates = (
        params.parent / "color_calibration.json",
        home / "annotations" / resolved.name / "color_correction",
        home.parent / "color_correction" / home.name,
    )
    colours = next((file for file in candidates if file.exists()), None)
    return Layout(sequence=sequence, participant=home.name, params=params, colours=colours)


def _error(what: str, where: object, expected: object, got: object, fix: str) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix=fix)


def _poses(params: Fields) -> dict[str, Float[np.ndarray, "4 4"]]:
    value = params.values.get("world_2_cam")
    if not isinstance(value, Mapping) or not value:
        raise params.error("world_2_cam", "an object: serial -> 4 x 4 numbers", type(value).__name__)
    poses = {}
    for serial, matrix in value.items():
        entry = f"world_2_cam: {serial}"
        T = number_array(matrix, [(4, 4)], partial(params.error, entry))
        check_rotation(T[:3, :3], params.error, entry)
        poses[str(serial).removeprefix("cam_")] = T
    return poses


def _images(sequence: Path, number: int | None) -> tuple[int, dict[str, Path]]:
    """The frame that is read, and its images or videos by serial."""
    folders = {int(m[1]): f for f in sequence.glob("frame_*") if (m := _FRAME_FOLDER.fullmatch(f.name))}
    if folders:  # one folder per frame
        frame = _chosen(sequence, number, folders)
        return frame, _by_serial(_first_folder(folders[frame], _IMAGES))
    folder = _first_folder(sequence, _IMAGES)
    found = [(m, f) for f in folder.iterdir() if (m := _IMAGE.fullmatch(f.name))]
    videos = {m[1]: f for m, f in found if m[3].lower() == "mp4"}
    if videos:  # one video per camera
        frames = min(read_video_header(file).frames for file in videos.values())
        if number is not None and frames and number >= frames:
            raise _error(
                "There is no such frame", sequence, f"0 to {frames - 1}", number, "choose another with --frame"
            )
        return number or 0, videos
    steps: dict[int, dict[str, Path]] = {}
    for m, file in found:
        steps.setdefault(int(m[2] or 0), {})[m[1]] = file
    frame = _chosen(sequence, number, steps)
    return frame, steps[frame]


def _chosen(sequence: Path, number: int | None, frames: Mapping[int, object]) -> int:
    if not frames:
        raise _error("The sequence has no images", sequence, "cam_SERIAL.mp4, or images of frames", "none", "check it")
    if number is None:
        return min(frames)
    if number not in frames:
        names = listed(sorted(frames), 8)
        raise _error("There is no such frame", sequence, f"one of {names}", number, "choose another with --frame")
    return number


def _first_folder(parent: Path, names: tuple[str, ...]) -> Path:
    found = [parent / name for name in names if (parent / name).is_dir()]
    if not found:
        raise _error("The images are missing", parent, f"a folder {' or '.join(names[:2])}", "none", "check the path")
    return found[0]


def _by_serial(folder: Path) -> dict[str, Path]:
    return {m[1]: file for file in sorted(folder.iterdir()) if (m := _IMAGE.fullmatch(file.name))}


def _alpha_maps(sequence: Path, frame: int) -> dict[str, Path]:
    """Alpha maps of a frame by serial."""
    folders = [f for f in sequence.glob("frame_*") if (m := _FRAME_FOLDER.fullmatch(f.name)) and int(m[1]) == frame]
    parent = folders[0] if folders else sequence
    folder = next((parent / name for name in _ALPHAS if (parent / name).is_dir()), None)
    if folder is None:
        return {}
    found = [(m, f) for f in sorted(folder.iterdir()) if (m := _IMAGE.fullmatch(f.name)) and m[3].lower() != "mp4"]
    return {m[1]: f for m, f in found if bool(folders) or int(m[2] or 0) == frame}


def _size(image: Path) -> tuple[int, int]:
    if image.suffix.lower() == ".mp4":
        header = read_video_header(image)
        return header.width_px, header.height_px
    return stored_size(image)


def _scaled(
    K: Float[np.ndarray, "3 3"], calibrated: tuple[int, int], size: tuple[int, int], params: Fields
) -> Float[np.ndarray, "3 3"]:
    """K for images of another size than those of the calibration."""
    scale = np.array(size) / calibrated
    if abs(scale[0] / scale[1] - 1) > 0.01:
        expected = f"images of {calibrated[0]} x {calibrated[1]} px, or smaller ones of the same shape"
        raise params.error("intrinsics", expected, f"{size[0]} x {size[1]} px")
    return np.diag([*scale, 1.0]) @ K


def _colours(source: Path | None, serials: list[str]) -> dict[str, Colour]:
    """Colour corrections by serial.

    Version 2 multiplies linear light by a 3 x 3 matrix. Version 1 multiplies sRGB values, as rows, by a 3 x 3 matrix
    and adds the fourth column.
    """
    if source is None:
        return {}
    if source.is_file():
        table = read_object(source, "NeRSemble colour calibration")
        matrices = {s: table.array(s, (3, 3)) for s in serials if s in table}
        return {s: Colour(matrix=_rows(M), matrix_space="linear") for s, M in matrices.items()}
    read = {s: _affine(source / f"{s}.npy") for s in serials if (source / f"{s}.npy").is_file()}
    return {s: Colour(matrix=_rows(M), matrix_space="encoded") for s, M in read.items()}


def _rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in matrix)


def _affine(file: Path) -> Float[np.ndarray, "3 4"]:
    """The affine transform in an NPY file, for columns."""

    def refuse(expected: object, got: object) -> InputError:
        fix = "remove the file to use the images' own colours"
        return _error("The colour correction cannot be read", file, expected, got, fix)

    content = read_bytes(file, refuse, max_bytes=_MAX_NPY_BYTES)
    try:
        array = np.lib.format.read_array(BytesIO(content), allow_pickle=False)
    except Exception as error:  # a damaged header makes NumPy raise nearly anything
        raise refuse("an NPY file of 3 x 4 or 4 x 4 numbers", f"{type(error).__name__}: {error}") from None
    A = number_array(array, [(3, 4), (4, 4)], refuse)
    return np.column_stack([A[:3, :3].T, A[:3, 3]])


FORMAT = Format(
    name="nersemble",
    title="NeRSemble sequence",
    files=f"calibration/{_PARAMS} and sequences with images or cam_SERIAL.mp4",
    detect=_detect,
    read=read,
    sequences=True,
)
