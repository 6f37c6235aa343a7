"""A head of the tiny model seen by known cameras: its landmarks as files, and a provider that knows where it is."""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from registration.detect.provider import Face
from registration.model import gnm_npz
from registration.model.gnm import GNM
from registration.model.landmarks import schemes_beside
from registration.types import Camera, Parameters
from tests.conftest import FIXTURES

MODEL = FIXTURES / "tiny_gnm.npz"
DATA = gnm_npz.read(MODEL)
SCHEME = schemes_beside(MODEL, DATA.template_vertex_positions)["68"]
SIZE = (320, 400)  # width, height px
FOCAL = 520.0


def camera(yaw: float = 0.0, focal: float = FOCAL) -> Camera:
    """A camera 0.6 m from the head, which looks at it from `yaw` radians about +Y."""
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:3, :3] = np.array([[c, 0, -s], [0, -1, 0], [-s, 0, -c]])
    T[:3, 3] = -T[:3, :3] @ DATA.template_vertex_positions.mean(0).astype(np.float64) + [0, 0, 0.6]
    K = np.array([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1.0]])
    return Camera(width_px=SIZE[0], height_px=SIZE[1], intrinsics=K, T_cam_world=T)


def parameters(seed: int = 0, turn: float = 0.0, shift: float = 0.0) -> Parameters:
    """A random identity without expression; the head is turned about +Y (radians) and moved along +X (metres)."""
    rest = GNM(DATA, dtype=torch.float64).neutral()
    identity = torch.from_numpy(np.random.default_rng(seed).normal(size=rest.identity.shape)) * 0.5
    rotations = rest.rotations.clone()
    rotations[0, 1] = turn
    translation = rest.translation.clone()
    translation[0] = shift
    return Parameters(
        identity=identity, expression=rest.expression, rotations=rotations, translation=translation, scale=rest.scale
    )


def landmarks(view: Camera, head: Parameters) -> np.ndarray:
    """The scheme's landmarks in an image, px."""
    with torch.no_grad():
        vertices = GNM(DATA, dtype=torch.float64)(head).numpy()
    return view.project(SCHEME.points(vertices))[0]


def write_json(file: Path, points: np.ndarray) -> Path:
    rows = np.column_stack([points, np.ones(len(points)), np.full(len(points), 0.5)])
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"68": rows.tolist()}))
    return file


def picture(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """An image with the landmarks as dots over noise, red green blue."""
    image = np.random.default_rng(seed).integers(90, 110, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    for x, y in points:
        cv2.circle(image, (round(float(x)), round(float(y))), 2, (255, 255, 255), -1)
    return image


def write_image(file: Path, image: np.ndarray) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), image[..., ::-1])
    return file


class KnownFaces:
    """A provider that returns given faces for given images, and none for others; it counts its calls."""

    scheme, count, version = "68", 68, "known"

    def __init__(self, known: dict[bytes, list[np.ndarray]]) -> None:
        self.known, self.calls = known, 0

    def detect(self, image: np.ndarray) -> Sequence[Face]:
        self.calls += 1
        return [face_of(points) for points in self.known.get(image.tobytes(), [])]


def face_of(points: np.ndarray) -> Face:
    box = np.concatenate([points.min(0), points.max(0)])
    return Face(points=points, confidence=np.ones(68), spread_px=np.full(68, 0.5), presence=1.0, box=box)
