"""The studio's cameras: rows on a part of a sphere in front of a head, as in a capture dome."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.types import Camera

MAX_SIDE_PX = 8192  # of an image
MAX_CAMERAS = 512
SPREAD_DEG = (150.0, 60.0)  # horizontally, vertically
DISTANCE_M = 1.2
HEAD_FRACTION = 0.9  # ratio of the head's height to the image's, from the front
_ELEVATION_DEG = 2.0  # of the rig's middle row above the head's centre
# Half ranges of the cameras' uniform jitter; the last three relative.
_DIRECTION_DEG, _ROLL_DEG, _TARGET_M, _DISTANCE, _FOCAL, _PRINCIPAL_POINT = 2.0, 2.0, 0.006, 0.04, 0.03, 0.02


@dataclass(frozen=True, kw_only=True)
class RigOptions:
    """The cameras of a rig.

    Attributes:
        cameras: number of cameras, row by row from below, each row from the subject's right to the left.
        size_px: width and height of every image.
        seed: of the jitter of positions, directions, focal lengths, principal points and lenses.
        distortion: whether lenses have OpenCV's k1 k2 p1 p2: a few pixels at the image's corners.
        spread_deg: angle between the outermost cameras, horizontally and vertically.
    """

    cameras: int = 22
    size_px: tuple[int, int] = (480, 720)
    seed: int = 0
    distortion: bool = False
    spread_deg: tuple[float, float] = SPREAD_DEG

    def check(self) -> None:
        """Check the ranges.

        Raises:
            InputError: a value is out of range.
        """
        if not 1 <= self.cameras <= MAX_CAMERAS:
            raise _input_error("number of cameras", f"1 to {MAX_CAMERAS}", self.cameras)
        size = self.size_px
        if len(size) != 2 or not all(isinstance(side, int) and 1 <= side <= MAX_SIDE_PX for side in size):
            raise _input_error("image size", f"width and height, whole pixels from 1 to {MAX_SIDE_PX}", size)
        if not (0 <= self.spread_deg[0] <= 360 and 0 <= self.spread_deg[1] <= 160):
            raise _input_error("spread", "up to 360 degrees horizontally, 160 vertically", self.spread_deg)


def make_rig(
    options: RigOptions = RigOptions(),  # noqa: B008  frozen
    *,
    centre: Float[np.ndarray, "3"] | None = None,
    R_world_head: Float[np.ndarray, "3 3"] | None = None,
    head_height_m: float = 0.34,
) -> tuple[Camera, ...]:
    """Return cameras that look at a head from in front of it.

    Args:
        options: number, images and arrangement of the cameras.
        centre: of the head, world, metres; the origin if None.
        R_world_head: orientation of the head, whose +Y is up and +Z out of the face; the world's axes if None.
        head_height_m: height of the head, which fills `HEAD_FRACTION` of an image's height at the rig's distance.

    Raises:
        InputError: an option is out of range.
    """
    options.check()
    if not (np.isfinite(head_height_m) and head_height_m > 0):
        raise _input_error("height of the head", "a positive length in metres", head_height_m)
    rng = np.random.default_rng([options.seed, options.cameras])
    centre = np.zeros(3) if centre is None else np.asarray(centre, np.float64)
    rotation = np.eye(3) if R_world_head is None else np.asarray(R_world_head, np.float64)
    directions = _directions_deg(options.cameras, options.spread_deg)
    return tuple(_camera(options, yaw, pitch, centre, rotation, head_height_m, rng) for yaw, pitch in directions)


def _input_error(what: str, expected: str, got: object) -> InputError:
    return InputError(
        f"The rig's {what} is out of range", where="rig", expected=expected, got=got, fix="change this option"
    )


def _directions_deg(count: int, spread_deg: tuple[float, float]) -> list[tuple[float, float]]:
    """Return yaw and pitch of the cameras, degrees: rows of nearly equal length over the spread."""
    rows = min(count, max(1, round(np.sqrt(count * spread_deg[1] / max(spread_deg[0], 1.0)))))
    pitches = np.linspace(-0.5, 0.5, rows) * spread_deg[1] if rows > 1 else np.zeros(1)
    # The middle rows, which see the face frontally, get the remaining cameras.
    order = np.argsort(np.abs(np.arange(rows) - (rows - 1) / 2), kind="stable")
    lengths = np.full(rows, count // rows)
    lengths[order[: count % rows]] += 1
    directions = []
    for length, pitch in zip(lengths.tolist(), pitches.tolist(), strict=True):
        yaws = np.linspace(-0.5, 0.5, length) * spread_deg[0] if length > 1 else np.zeros(1)
        directions += [(yaw, pitch + _ELEVATION_DEG) for yaw in yaws.tolist()]
    return directions


def _camera(
    options: RigOptions,
    yaw: float,
    pitch: float,
    centre: Float[np.ndarray, "3"],
    R_world_head: Float[np.ndarray, "3 3"],
    head_height_m: float,
    rng: np.random.Generator,
) -> Camera:
    width, height = options.size_px
    yaw, pitch = (np.array([yaw, pitch]) + _DIRECTION_DEG * rng.uniform(-1, 1, 2)).tolist()
    outward = Rotation.from_euler("YX", [yaw, -pitch], degrees=True).as_matrix()
    axes = np.stack([outward[:, 0], -outward[:, 1], -outward[:, 2]])  # x right, y down, z towards the head
    axes = Rotation.from_euler("z", _ROLL_DEG * rng.uniform(-1, 1), degrees=True).as_matrix() @ axes
    distance = DISTANCE_M * (1 + _DISTANCE * rng.uniform(-1, 1))
    T_cam_world = np.eye(4)
    T_cam_world[:3, :3] = axes @ R_world_head.T
    T_cam_world[:3, 3] = [*(_TARGET_M * rng.uniform(-1, 1, 2)), distance] - T_cam_world[:3, :3] @ centre
    focal = HEAD_FRACTION * height / head_height_m * DISTANCE_M * (1 + _FOCAL * rng.uniform(-1, 1))
    aspect = 1 + 0.002 * rng.uniform(-1, 1)
    principal = np.array([width, height]) * (0.5 + _PRINCIPAL_POINT * rng.uniform(-1, 1, 2))
    # The head stays in the centre of the image.
    T_cam_world[:2, 3] -= (principal - np.array([width, height]) / 2) / focal * distance
    intrinsics = np.array([[focal, 0, principal[0]], [0, aspect * focal, principal[1]], [0, 0, 1.0]])
    k1, k2, p1, p2 = (rng.uniform(-1, 1, 4) * _lens_limits(width, height, focal)).tolist()
    return Camera(
        width_px=width,
        height_px=height,
        intrinsics=intrinsics,
        T_cam_world=T_cam_world,
        distortion=(k1, k2, p1, p2) if options.distortion else (),
    )


def _lens_limits(width: int, height: int, focal_px: float) -> Float[np.ndarray, "4"]:
    """Return the largest k1 k2 p1 p2: shifts of 3, 1, 0.5 and 0.5 % at the image's corner, for any focal length."""
    corner = np.hypot(width, height) / 2 / focal_px
    return np.array([0.03 / corner**2, 0.01 / corner**4, 0.005 / corner, 0.005 / corner])
