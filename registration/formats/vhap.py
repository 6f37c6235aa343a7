"""What VHAP exports as a NeRF dataset: `transforms.json` with time steps and cameras, `images/`, `fg_masks/`.

Poses are camera to world with OpenGL's axes in FLAME's metres. Of the principal point cy counts from the bottom of the
image: the export turns it with the axes. github.com/ShenhanQian/VHAP
"""

from pathlib import Path

import numpy as np

from registration.capture.text import listed
from registration.errors import InputError
from registration.formats.fields import Fields, read_object
from registration.formats.files import find_image
from registration.formats.photographs import check_rotation, world_to_camera
from registration.formats.source import Format, ReadOptions, SourceCapture, SourceView

_TITLE = "VHAP transforms.json"
_FILE = "transforms.json"
_PARTS = ("train", "val", "test")
_HEAD_BYTES = 2**16
_OPENGL = np.diag([1.0, -1.0, -1.0])


def is_export(path: Path) -> bool:
    """Whether a folder or file is such an export, by its first bytes: nerfstudio has files of the same names."""
    return any(_is_ours(file) for file in _files(path))


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix == ".json" else []
    if (path / _FILE).is_file():
        return [path / _FILE]
    return [file for part in _PARTS if (file := path / f"transforms_{part}.json").is_file()]


def _is_ours(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return b'"timestep_index"' in stream.read(_HEAD_BYTES)
    except OSError:
        return False


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read the cameras of one time step.

    Raises:
        InputError: a file is missing or malformed, a camera is there twice, or the time step does not exist.
    """
    files = _files(path)
    if not files:
        raise InputError(
            "The VHAP export cannot be read", where=path, expected=_FILE, got="no such file", fix="check the path"
        )
    frames = [(file, frame) for file in files for frame in read_object(file, _TITLE).objects("frames")]
    steps: dict[int, dict[str, tuple[Path, Fields]]] = {}
    for file, frame in frames:
        step = int(frame.number("timestep_index"))
        camera = _camera_id(frame)
        cameras = steps.setdefault(step, {})
        if camera in cameras:
            raise frame.error("camera_id", f"each camera once in time step {step}", camera)
        cameras[camera] = (file, frame)
    chosen = min(steps, default=0) if options.frame is None else options.frame
    if chosen not in steps:
        raise InputError(
            "There is no such time step",
            where=path,
            expected=f"one of {listed(sorted(steps), 8)}",
            got=chosen,
            fix="choose another with --frame",
        )
    views = tuple(_view(camera, file, frame) for camera, (file, frame) in sorted(steps[chosen].items()))
    folder = files[0].parent
    notes = [f"time step {chosen} was read", "the FLAME parameters were not read"]
    subject, expression = names_of(folder)
    return SourceCapture(
        format=FORMAT.name,
        root=folder,
        subject=options.subject or subject,
        expression=options.expression or expression,
        views=views,
        unit_m=1.0,
        notes=tuple(notes),
    )


def names_of(folder: Path) -> tuple[str, str]:
    """Return subject and expression from the name of an export's folder, as 074_EMO-1_v16_DS4_whiteBg."""
    subject, _, expression = folder.resolve().name.partition("_")
    return subject, expression.split("_")[0] or "neutral"


def _camera_id(frame: Fields) -> str:
    if "camera_id" in frame:
        value = frame.values["camera_id"]
        return str(value)
    return f"{int(frame.number('camera_index')):02d}"


def _view(camera: str, file: Path, frame: Fields) -> SourceView:
    T_world_cam = frame.array("transform_matrix", (4, 4))

    check_rotation(T_world_cam[:3, :3], frame.error, "transform_matrix")
    width_px, height_px = frame.size("w"), frame.size("h")
    fx, fy = frame.number("fl_x"), frame.number("fl_y")
    if min(fx, fy) <= 0:
        raise frame.error("fl_x", "focal lengths above 0 px", f"{fx}, {fy}")
    K = np.array([[fx, 0, frame.number("cx")], [0, fy, height_px - frame.number("cy")], [0, 0, 1]])
    mask = frame.text("fg_mask_path", "")
    return SourceView(
        name=f"cam_{camera}",
        image=find_image(file.parent, frame.text("file_path"), frame.error, "file_path"),
        width_px=width_px,
        height_px=height_px,
        intrinsics=K,
        T_cam_world=world_to_camera(_OPENGL @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]),
        mask=find_image(file.parent, mask, frame.error, "fg_mask_path") if mask else None,
    )


FORMAT = Format(
    name="vhap",
    title="VHAP export",
    files="transforms.json whose frames have timestep_index and camera_id",
    detect=is_export,
    read=read,
    sequences=True,
)
