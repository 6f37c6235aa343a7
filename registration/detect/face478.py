"""Google's 478-point face landmarker [FaceMesh], run by OpenCV.

Faces are found by the short-range detector. Each is cut out upright and its points predicted; from these the crop is
made anew, and predicted again, several times with small changes. The mean of the last passes are the points. Their
spread is a multiple of the passes' scatter, and a share that grows where the surface turns away from the camera.
"""

import hashlib
import tempfile
import threading
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from registration.detect import short_range
from registration.detect.blendshapes import NAMES, SUBSET
from registration.detect.crops import Crop
from registration.detect.faces import distinct
from registration.detect.facing import facing, seen
from registration.detect.provider import Face
from registration.detect.short_range import Detection
from registration.detect.weights import TASK_SHA256, FaceLandmarkerFiles, read_face_landmarker

SCHEME = "face478"
COUNT = 478
SIZE = 256  # px, of the crops
SCALE = 1.5  # of a crop, relative to the face
MIN_PRESENCE = 0.5
MAX_FACES = 4
RIGHT_EYE, LEFT_EYE = 33, 263  # outer corners, the subject's
# Spread = the root of (SCATTER scatter)^2 + (FLOOR size)^2 + (GRAZING size (1 - cosine of the surface's angle)^2)^2.
# Fitted to the distances from points triangulated over 14 views of three rendered captures: their median and mean
# square are right within a fifth, from 0.5 to 2.5 % of the face's size.
SCATTER = 1.75
FLOOR = 0.003
GRAZING = 0.015
_POINTS, _PRESENCE = "Identity", "Identity_1"
# Shift along both axes (fractions of the side), scale, turn (radians) of the crops whose scatter is measured.
_JITTER = (
    ((0.0, 0.0), 1.0, 0.0),
    ((0.02, 0.01), 1.04, 0.04),
    ((-0.02, 0.02), 0.96, -0.04),
    ((0.01, -0.02), 1.06, -0.06),
    ((-0.01, -0.01), 0.94, 0.06),
)
_FOLLOWING = 3  # passes for a face that was in the frame before
_CODE = 2  # raised when the same nets give other results


class _Nets(threading.local):
    """The nets of one thread: a net's forward pass changes it."""

    def __init__(self, files: FaceLandmarkerFiles) -> None:
        self.detector, self.points, self.blendshapes = map(_net, (files.detector, files.points, files.blendshapes))


def _net(content: bytes) -> cv2.dnn.Net:
    # The other engines of OpenCV 5 give wrong values for the second of two outputs, and a net from memory ignores which
    # engine was asked for: it is read from a file.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "net.tflite"
        path.write_bytes(content)
        return cv2.dnn.readNetFromTFLite(str(path), cv2.dnn.ENGINE_CLASSIC)


class Face478Provider:
    """Landmarks of scheme `face478`: 468 points of the skin, lips and lids, and five of each iris (468 to 477).

    Its nets are read, and downloaded if need be, by the first image. It may be used by several threads.
    """

    scheme = SCHEME
    count = COUNT

    @property
    def version(self) -> str:
        """Name, and digest of the nets, of OpenCV's version and of the code's."""
        decides = f"{TASK_SHA256} {cv2.__version__} {_CODE} {_JITTER}"
        return f"{SCHEME} {hashlib.sha256(decides.encode()).hexdigest()}"

    @cached_property
    def _nets(self) -> _Nets:
        return _Nets(read_face_landmarker())

    def detect(self, image: UInt8[np.ndarray, "H W 3"]) -> Sequence[Face]:
        """Return the faces in an image, the most certain first, at most `MAX_FACES`.

        Args:
            image: red green blue, sRGB, without distortion.

        Raises:
            InputError: the nets cannot be downloaded.
        """
        detections = short_range.detect(self._nets.detector, image)[:MAX_FACES]
        faces = [face for detection in detections if (face := self._refine(image, detection)) is not None]
        return distinct(faces)

    def follow(self, image: UInt8[np.ndarray, "H W 3"], before: Face) -> Face | None:
        """Return the face near a face of the frame before, from three passes, or None if there is none.

        The first pass places the crop anew, so that motions of a third of the face's size do no harm.
        """
        points, presence = self._predict(image, _crop_of(before.points))
        if presence < MIN_PRESENCE:
            return None
        return self._averaged(image, _crop_of(points[:, :2]), _JITTER[:_FOLLOWING], [presence], hints=False)

    def _refine(self, image: UInt8[np.ndarray, "H W 3"], detection: Detection) -> Face | None:
        points, presence = self._predict(image, detection.crop(SCALE))
        presences = [detection.score, presence]
        if min(presences) < MIN_PRESENCE:
            return None
        return self._averaged(image, _crop_of(points[:, :2]), _JITTER, presences)

    def _averaged(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        crop: Crop,
        changes: Sequence[tuple[tuple[float, float], float, float]],
        presences: list[float],
        *,
        hints: bool = True,
    ) -> Face | None:
        """The mean of several passes around a crop; None if one of them sees no face."""
        passes = []
        for shift, scale, turn in changes:
            points, presence = self._predict(image, crop.moved(shift, scale, turn))
            if presence < MIN_PRESENCE:
                return None
            presences.append(presence)
            passes.append(points)
        points = np.mean(passes, 0)
        least = float(min(presences))
        cosine = facing(points)
        scatter = np.std(passes, axis=0, ddof=1)[:, :2]
        points = points[:, :2]
        crop = _crop_of(points)
        grazing = GRAZING * (1 - np.clip(cosine, 0, 1)) ** 2
        squares = SCATTER**2 * (scatter**2).mean(-1) + (crop.side / SCALE) ** 2 * (FLOOR**2 + grazing**2)
        return Face(
            points=points,
            confidence=np.minimum(least, seen(cosine)),
            spread_px=np.sqrt(squares),
            presence=least,
            box=np.concatenate([points.min(0), points.max(0)]),
            roll=crop.roll,
            hints=self._blendshapes(crop.from_image(points)) if hints else {},
        )

    def _predict(self, image: UInt8[np.ndarray, "H W 3"], crop: Crop) -> tuple[Float[np.ndarray, "478 3"], float]:
        """Points from one crop, x, y and depth in px of the image, and whether there is a face."""
        net = self._nets.points
        net.setInput(cv2.dnn.blobFromImage(crop.pixels(image, SIZE), 1 / 255, (SIZE, SIZE)))
        points, presence = net.forward([_POINTS, _PRESENCE])
        local = np.asarray(points, np.float64).reshape(COUNT, 3) / SIZE
        score = float(1 / (1 + np.exp(-np.float64(presence).reshape(-1)[0])))
        return np.column_stack([crop.to_image(local[:, :2]), local[:, 2] * crop.side]), score

    def _blendshapes(self, points: Float[np.ndarray, "478 2"]) -> dict[str, float]:
        net = self._nets.blendshapes
        net.setInput(np.ascontiguousarray(points[list(SUBSET)] * SIZE, np.float32)[None])
        scores = np.asarray(net.forward(), np.float64).reshape(-1)
        return {name: float(score) for name, score in zip(NAMES, scores, strict=True) if not name.startswith("_")}


def _crop_of(points: Float[np.ndarray, "478 2"]) -> Crop:
    across = points[LEFT_EYE] - points[RIGHT_EYE]
    return Crop.around(points, float(np.arctan2(across[1], across[0])), SCALE)
