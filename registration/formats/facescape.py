"""The FaceScape dataset's multi-view captures: a folder per expression with `params.json` and `VIEW.jpg`.

Poses are world to camera with OpenCV's axes; K and distortion (k1 k2 p1 p2 k3) are those of `cv2.undistort`, so pixel
(0, 0) has its centre at (0, 0): half a pixel is added. Each capture's world has a scale of its own; the dataset's
`Rt_scale_dict.json` gives its millimetres. github.com/zhuhao-nju/facescape
"""

import re
from pathlib import Path

import numpy as np

from registration.formats.fields import Fields, read_object
from registration.formats.files import find_image
from registration.formats.photographs import check_rotation, left_out
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView

_PARAMS, _SCALES = "params.json", "Rt_scale_dict.json"
_TITLE = "FaceScape params.json"
_KEY = re.compile(r"(\d+)_K")
_HEAD_BYTES = 65536


def _detect(path: Path) -> bool:
    file = path / _PARAMS
    if not file.is_file():
        return False
    with file.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    return re.search(rb'"\d+_(K|Rt|valid|sn|width)"', head) is not None


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read the folder of an expression.

    Raises:
        InputError: `params.json` is missing or malformed, no view is valid, or an image is missing.
    """
    folder = path.parent if path.is_file() else path
    params = read_object(folder / _PARAMS, _TITLE)
    numbers = sorted(int(m[1]) for name in params.values if (m := _KEY.fullmatch(name)))
    if not numbers:
        raise params.error("0_K", "intrinsics VIEW_K of each view", "none")
    invalid = [number for number in numbers if not params.values.get(f"{number}_valid", True)]
    views = tuple(_view(folder, params, number) for number in numbers if number not in invalid)
    if not views:
        raise params.error("0_valid", "at least one valid view", f"{len(invalid)} of {len(numbers)} invalid")
    subject, expression = folder.resolve().parent.name, folder.resolve().name
    scale = _unit_m(folder, subject, expression)
    scan = next((f for f in (folder / f"{expression}.ply", folder.parent / f"{expression}.ply") if f.is_file()), None)
    notes = list(left_out([str(n) for n in invalid], "whose cameras the dataset calls invalid"))
    if scale is None:
        notes.append(f"the world has a scale of its own: {_SCALES} of the dataset's toolkit was not found beside it")
    return SourceCapture(
        format=FORMAT.name,
        root=folder,
        subject=options.subject or subject,
        expression=options.expression or re.sub(r"^\d+_", "", expression),
        views=views,
        unit_m=scale,
        scan=scan,
        notes=tuple(notes),
    )


def _view(folder: Path, params: Fields, number: int) -> SourceView:
    K = params.array(f"{number}_K", (3, 3), (4, 4))[:3, :3].copy()
    Rt = params.array(f"{number}_Rt", (3, 4), (4, 4))[:3]
    coefficients = params.array(f"{number}_distortion", (5,))

    check_rotation(Rt[:, :3], params.error, f"{number}_Rt")
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.abs(K[2] - [0, 0, 1]).max() < 1e-9):
        raise params.error(f"{number}_K", "fx s cx / 0 fy cy / 0 0 1", K.tolist())
    K[:2, 2] += 0.5
    lens = Distortion(model="opencv", coefficients=tuple(coefficients.tolist()))
    return SourceView(
        name=str(number),
        image=find_image(folder, str(number), params.error, f"{number}_K", suffixes=(".jpg", ".png", ".jpeg")),
        width_px=params.size(f"{number}_width"),
        height_px=params.size(f"{number}_height"),
        intrinsics=K,
        T_cam_world=np.vstack([Rt, [0, 0, 0, 1]]),
        distortion=lens if coefficients.any() else Distortion(model="none"),
    )


def _unit_m(folder: Path, subject: str, expression: str) -> float | None:
    """Metres per unit of an expression's world from the dataset's table of scales, None without one."""
    resolved = folder.resolve()
    file = next((f / _SCALES for f in (resolved, *resolved.parents[:3]) if (f / _SCALES).is_file()), None)
    number = re.match(r"(\d+)_", expression)
    if file is None or number is None:
        return None
    table = read_object(file, f"FaceScape {_SCALES}")
    rows = table.values.get(subject)
    entry = rows.get(number[1]) if isinstance(rows, dict) else None
    if entry is None:
        return None
    if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[0], (int, float)) or entry[0] <= 0:
        raise table.error(f"{subject}: {number[1]}", "[scale above 0, 3 x 4 numbers]", f"{entry!r:.60}")
    return 0.001 * float(entry[0])


FORMAT = Format(
    name="facescape",
    title="FaceScape expression",
    files="params.json with 0_K, 0_Rt and so on, and VIEW.jpg",
    detect=_detect,
    read=read,
)
