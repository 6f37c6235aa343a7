"""Google's short-range face detector (BlazeFace): boxes, six key points and scores from an image of 128 x 128.

The net predicts one box for each of 896 anchors [BlazeFace]; overlapping boxes are merged, weighted by their scores.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from registration.detect.crops import Crop

SIZE = 128  # px
MIN_SCORE = 0.5
_STRIDES = (8, 16, 16, 16)  # px, of the layers with two anchors a cell
_MAX_LOGIT = 100.0
_SAME_FACE = 0.3  # intersection over union of boxes of one face
_OUTPUTS = ("regressors", "classificators")
RIGHT_EYE, LEFT_EYE = 0, 1  # the subject's, among the key points


@dataclass(frozen=True, kw_only=True, eq=False)
class Detection:
    """A face that the detector found."""

    box: Float[np.ndarray, "4"]  # x0 y0 x1 y1, px of the image
    key_points: Float[np.ndarray, "6 2"]  # right eye, left eye, nose, mouth, right ear, left ear; px
    score: float

    @property
    def roll(self) -> float:
        """Turn of the line between the eyes, radians, 0 where the face is upright."""
        across = self.key_points[LEFT_EYE] - self.key_points[RIGHT_EYE]
        return float(np.arctan2(across[1], across[0]))

    def crop(self, scale: float) -> Crop:
        """Return the square around the face, `scale` times its box."""
        centre = (self.box[:2] + self.box[2:]) / 2
        return Crop(centre=centre, side=scale * float((self.box[2:] - self.box[:2]).max()), roll=self.roll)


def anchors() -> Float[np.ndarray, "896 2"]:
    """Return the centres of the anchors, as fractions of the image's side."""
    layers = []
    for stride in dict.fromkeys(_STRIDES):  # layers of one stride share their cells
        y, x = (np.mgrid[: SIZE // stride, : SIZE // stride] + 0.5) * stride / SIZE
        layers.append(np.repeat(np.stack([x.ravel(), y.ravel()], -1), 2 * _STRIDES.count(stride), axis=0))
    return np.concatenate(layers)


def detect(net: cv2.dnn.Net, image: UInt8[np.ndarray, "H W 3"]) -> list[Detection]:
    """Return the faces in an image (red green blue), the most certain first."""
    whole = Crop.whole(image)
    pixels = whole.pixels(image, SIZE, black=True)
    net.setInput(cv2.dnn.blobFromImage(pixels, 1 / 127.5, (SIZE, SIZE), (127.5, 127.5, 127.5)))
    values, logits = (np.asarray(output, np.float64) for output in net.forward(list(_OUTPUTS)))
    scores = 1 / (1 + np.exp(-np.clip(logits.reshape(-1), -_MAX_LOGIT, _MAX_LOGIT)))
    chosen = np.flatnonzero(scores >= MIN_SCORE)
    values = values.reshape(-1, 8, 2)[chosen] / SIZE  # centre, size, six key points
    centres = values[:, :1] + anchors()[chosen, None]
    points = np.concatenate(
        [centres - values[:, 1:2] / 2, centres + values[:, 1:2] / 2, values[:, 2:] + anchors()[chosen, None]], 1
    )
    return [
        Detection(box=whole.to_image(merged[:2]).reshape(4), key_points=whole.to_image(merged[2:]), score=float(score))
        for merged, score in _merged(points, scores[chosen])
    ]


def _merged(
    points: Float[np.ndarray, "N 8 2"], scores: Float[np.ndarray, "N"]
) -> list[tuple[Float[np.ndarray, "8 2"], float]]:
    """Means of the boxes and key points of each face, weighted by their scores, and the highest score."""
    result = []
    left = np.argsort(-scores)
    while len(left):
        same = _overlap(points[left[0], :2], points[left, :2]) > _SAME_FACE
        same[0] = True
        group = left[same]
        mean = np.average(points[group], axis=0, weights=scores[group])
        result.append((mean, scores[group[0]]))
        left = left[~same]
    return result


def _overlap(box: Float[np.ndarray, "2 2"], boxes: Float[np.ndarray, "N 2 2"]) -> Float[np.ndarray, "N"]:
    """Intersection over union of one box with others."""
    low, high = np.maximum(box[0], boxes[:, 0]), np.minimum(box[1], boxes[:, 1])
    common = np.clip(high - low, 0, None).prod(-1)
    union = (box[1] - box[0]).prod() + (boxes[:, 1] - boxes[:, 0]).prod(-1) - common
    return common / np.maximum(union, 1e-12)
