"""A small synthetic capture of the tiny head with complete ground truth.

Identity, expression, joints, pose in a rotated world, offsets, texture and camera gains follow from formulas; the
images come from the renderer with many rays per pixel, the fit's from one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from registration.capture.native_writer import CaptureDescription, ViewArrays, write_capture
from registration.capture.scan import Scan
from registration.geometry.rasterizer import visible
from registration.geometry.topology import vertex_normals
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData, read
from registration.model.landmarks import read_scheme
from registration.model.regions import CLASSES, group, neck_other, vertex_classes
from registration.render import backend
from registration.render.renderer import Renderer
from registration.types import Camera, Parameters, Pixels
from tests.conftest import FIXTURES

MODEL = FIXTURES / "tiny_gnm.npz"
LABELS = ("background", *CLASSES, "neck_other")
WORLD = Rotation.from_rotvec([0.5, -0.8, 0.3])  # the world is not upright
CENTRE_WORLD = np.array([0.7, -0.3, 1.1])  # of the head in the world, m
CENTRE_MODEL = np.array([0.0, 0.29, 0.02])  # of the head in the model's frame, m
# Yaw and pitch (degrees) of the cameras around the head, distance (m) and focal length (in image widths).
RIG = (
    (-75, 5, 0.62, 2.5),
    (-45, -15, 0.70, 2.8),
    (-25, 20, 0.60, 2.4),
    (0, -5, 0.66, 2.7),
    (5, 30, 0.72, 2.9),
    (28, -12, 0.60, 2.4),
    (50, 12, 0.64, 2.6),
    (78, 0, 0.68, 2.7),
)
GAINS = np.array([1.08, 0.92, 1.05, 1.0, 0.9, 1.1, 0.96, 1.03])
WIDTH_PX, HEIGHT_PX = 160, 200
IDENTITY = np.array([0.4, -0.8, 0.7, 0.5, -0.6, 0.9])  # size, width, depth, crown, jaw, nose
EXPRESSIONS: Mapping[str, tuple[float, ...]] = {
    "neutral": (0.0, 0.0, 0.15, 0.1, 0.0, 0.0, 0.0),
    "smile": (0.8, 0.6, 0.5, 1.2, -0.6, 0.0, 0.0),  # brows up, jaw open, corners of the mouth out
}
HEAD_TURN = {"neutral": (0.0, 0.0, 0.0), "smile": (0.04, 0.10, -0.03)}  # of the joint `head`, radians


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The ground truth of a capture."""

    root: Path
    parameters: Parameters
    offsets: Float[np.ndarray, "V 3"]
    vertices: Float[np.ndarray, "V 3"]
    gains: Float[np.ndarray, "N"]


def make(
    root: Path,
    expression: str = "neutral",
    subject: str = "tiny",
    identity: Float[np.ndarray, "I"] = IDENTITY,
    cameras: Sequence[int] = range(len(RIG)),
    **tags: object,
) -> Truth:
    """Write the capture `root` of one expression of a subject, seen by some of the cameras."""
    data = read(MODEL)
    parameters, offsets = _known(data, expression, identity)
    vertices = GNM(data)(parameters, torch.as_tensor(offsets, dtype=torch.float32)).numpy()
    scheme = read_scheme(FIXTURES / "head_sparse_68.txt", vertices)
    seen_by = [_camera(*RIG[number], number) for number in cameras]
    images = _images(data, vertices, seen_by)
    views = []
    for number, camera, image in zip(cameras, seen_by, images, strict=True):
        points = scheme.points(vertices)
        is_visible = visible(points, vertices, data.triangles, camera, 2e-3)
        landmarks = np.column_stack([camera.project(points)[0], np.where(is_visible, 1.0, 0.2)])
        views.append(_view(f"cam{number}", camera, image, GAINS[number], landmarks))
    write_capture(
        root,
        views,
        CaptureDescription(subject=subject, expression=expression, classes=LABELS, tags=tags),
        scan=_scan(data, vertices),
        truth=vertices,
        bits=16,
    )
    return Truth(root=root, parameters=parameters, offsets=offsets, vertices=vertices, gains=GAINS[list(cameras)])


def _known(
    data: GNMData, expression: str, identity: Float[np.ndarray, "I"]
) -> tuple[Parameters, Float[np.ndarray, "V 3"]]:
    """The parameters, and smooth offsets of a millimetre or two on the skin."""
    rotations = np.zeros((len(data.joint_names), 3))
    rotations[0] = WORLD.as_rotvec()
    rotations[1] = HEAD_TURN[expression]
    root_joint = data.template_joint_positions[0]
    parameters = Parameters(
        identity=torch.tensor(identity, dtype=torch.float32),
        expression=torch.tensor(EXPRESSIONS[expression]),
        rotations=torch.tensor(rotations, dtype=torch.float32),
        translation=torch.tensor(
            CENTRE_WORLD - root_joint - WORLD.apply(CENTRE_MODEL - root_joint), dtype=torch.float32
        ),
        scale=torch.tensor(1.0),
    )
    template = data.template_vertex_positions.astype(np.float64)
    normals = vertex_normals(torch.as_tensor(template), torch.as_tensor(data.triangles.astype(np.int64))).numpy()
    x, y, z = (template / 0.012).T  # waves of 75 mm
    height = 0.7e-3 * (np.sin(x + 0.5) + np.sin(y - 0.4 * x) + np.cos(0.8 * z + 0.3 * y))
    return parameters, height[:, None] * normals * (group(data, "skin") > 0.5)[:, None]


def _camera(yaw: float, pitch: float, distance_m: float, focal: float, number: int) -> Camera:
    """A camera that looks at the centre of the head; its principal point is not the image's centre."""
    out = Rotation.from_euler("YX", [yaw, -pitch], degrees=True).as_matrix()
    axes = np.stack([out[:, 0], -out[:, 1], -out[:, 2]])  # x right, y down, z towards the head
    pose = np.eye(4)
    pose[:3, :3] = axes @ WORLD.as_matrix().T
    pose[:3, 3] = [0.01, -0.012, distance_m]
    pose[:3, 3] -= pose[:3, :3] @ CENTRE_WORLD
    intrinsics = np.array(
        [
            [focal * WIDTH_PX, 0, WIDTH_PX * (0.47 + 0.01 * number)],
            [0, 1.01 * focal * WIDTH_PX, HEIGHT_PX * (0.53 - 0.01 * number)],
            [0, 0, 1],
        ]
    )
    return Camera(width_px=WIDTH_PX, height_px=HEIGHT_PX, intrinsics=intrinsics, T_cam_world=pose)


def _images(data: GNMData, vertices: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(N, H, W, 3 + 3 + 1 + K): RGB, world normals, mask, classes (those of LABELS but the background)."""
    backend.activate("llvm")
    classes = np.concatenate([vertex_classes(data)[1], neck_other(data)[:, None].astype(np.float32)], 1)
    classes[:, 0] *= 1 - classes[:, -1]
    renderer = Renderer(data.triangles, texture_atlas(data), classes, pixel_samples=16)
    pixels = Pixels.full(cameras)
    image = renderer(torch.tensor(vertices), _texture(), pixels)
    flat = torch.cat([image.rgb, image.normals, image.mask[:, None], image.classes], -1)
    return pixels.image(flat).numpy()


def _texture(size: int = 512) -> torch.Tensor:
    """Skin-coloured noise at two scales, in the atlas: seams are visible."""
    rng = np.random.default_rng(7)

    def noise(sigma: float) -> np.ndarray:
        field = np.stack([gaussian_filter(rng.standard_normal((size, size)), sigma) for _ in range(3)], -1)
        return field / field.std()

    texture = np.array([0.45, 0.33, 0.27]) * (1 + 0.2 * noise(12.0) + 0.15 * noise(4.0))
    return torch.tensor(texture.clip(0.02, 0.85), dtype=torch.float32)


def _view(name: str, camera: Camera, image: np.ndarray, gain: float, landmarks: np.ndarray) -> ViewArrays:
    rgb, world, mask, classes = np.split(image, [3, 6, 7], -1)
    mask = mask[..., 0]
    normals = world @ camera.T_cam_world[:3, :3].T
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = np.where(length > 0.1, normals / np.maximum(length, 0.1), 0)
    labels = np.where(mask > 0.5, 1 + classes.argmax(-1), 0).astype(np.uint8)
    return ViewArrays(
        name=name,
        camera=camera,
        rgb=gain * rgb,
        mask=mask,
        normals=normals,
        labels=labels,
        landmarks={"68": landmarks},
    )


def _scan(data: GNMData, vertices: np.ndarray) -> Scan:
    """The outer skin and the eyes, subdivided once: the surface of the ground truth."""
    import trimesh

    outer = group(data, "skin_exterior") + group(data, "left_eye") + group(data, "right_eye") > 0.5
    skin_triangles = data.triangles[outer[data.triangles].all(1)]
    mesh = trimesh.Trimesh(vertices, skin_triangles, process=False).subdivide()
    mesh.remove_unreferenced_vertices()
    return Scan(vertices=np.array(mesh.vertices, np.float64), triangles=np.array(mesh.faces, np.int64))
