"""The studio's cameras: rows of them on a part of a sphere around the front of a head, as capture domes have them."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.errors import InputError
from registration.types import Camera

LARGEST_PX = 8192  # a side of an image
MOST_CAMERAS = 512
SPREAD_DEG = (150.0, 60.0)  # horizontally, vertically
DISTANCE_M = 1.2
FILL = 0.9  # share of the image's height that the head's takes, from the front
_LEVEL_DEG = 2.0  # the rig's middle row is this much above the head's centre
_TURN_DEG, _ROLL_DEG, _AIM_M, _DISTANCE_SHARE, _FOCAL_SHARE, _CENTRE_SHARE = 2.0, 2.0, 0.006, 0.04, 0.03, 0.02


def rig(
    count: int = 22,
    size_px: tuple[int, int] = (480, 720),
    seed: int = 0,
    distortion: bool = False,
    *,
    centre: Float[np.ndarray, "3"] | None = None,
    R_world_head: Float[np.ndarray, "3 3"] | None = None,
    head_height_m: float = 0.34,
    spread_deg: tuple[float, float] = SPREAD_DEG,
) -> tuple[Camera, ...]:
    """Cameras that look at a head from in front of it.

    Args:
        count: of cameras, row by row from below, each row from the subject's right to the left.
        size_px: width and height of every image.
        seed: of the jitter of places, aims, focal lengths, principal points and lenses.
        distortion: whether lenses have OpenCV's k1 k2 p1 p2; a few pixels at the image's corners.
        centre: the head's, world, metres; the origin if not given.
        R_world_head: how the head is turned: its +Y is up, its +Z out of the face; not at all if not given.
        head_height_m: what FILL of an image's height shows at the rig's distance.
        spread_deg: angle between the outermost cameras, horizontally and vertically.

    Raises:
        InputError: no cameras, or images of no size or beyond LARGEST_PX a side.
    """
    check(count, size_px, head_height_m=head_height_m, spread_deg=spread_deg)
    rng = np.random.default_rng([seed, count])
    centre = np.zeros(3) if centre is None else np.asarray(centre, np.float64)
    turn = np.eye(3) if R_world_head is None else np.asarray(R_world_head, np.float64)
    return tuple(
        _camera(yaw, pitch, size_px, distortion, centre, turn, head_height_m, rng)
        for yaw, pitch in _places(count, spread_deg)
    )


def check(
    count: int, size_px: tuple[int, int], *, head_height_m: float = 0.3, spread_deg: tuple[float, float] = SPREAD_DEG
) -> None:
    """Raises InputError for what `rig` cannot make."""
    if not 1 <= count <= MOST_CAMERAS:
        raise _wrong("number of cameras", f"1 to {MOST_CAMERAS}", count)
    if len(size_px) != 2 or not all(isinstance(side, int) and 1 <= side <= LARGEST_PX for side in size_px):
        raise _wrong("image size", f"width and height, whole pixels from 1 to {LARGEST_PX}", size_px)
    if not (np.isfinite(head_height_m) and head_height_m > 0):
        raise _wrong("height of the head", "a positive length in metres", head_height_m)
    if not (0 <= spread_deg[0] <= 360 and 0 <= spread_deg[1] <= 160):
        raise _wrong("spread", "up to 360 degrees horizontally, 160 vertically", spread_deg)


def _wrong(what: str, expected: str, got: object) -> InputError:
    return InputError(f"The rig cannot have this {what}", where="rig", expected=expected, got=got, fix="change it")


def _places(count: int, spread_deg: tuple[float, float]) -> list[tuple[float, float]]:
    """Yaw and pitch of the cameras, degrees: rows of nearly equal length over the spread."""
    rows = min(count, max(1, round(np.sqrt(count * spread_deg[1] / max(spread_deg[0], 1.0)))))
    pitches = np.linspace(-0.5, 0.5, rows) * spread_deg[1] if rows > 1 else np.zeros(1)
    # The middle rows see the face straight on: what does not divide goes to them.
    order = np.argsort(np.abs(np.arange(rows) - (rows - 1) / 2), kind="stable")
    lengths = np.full(rows, count // rows)
    lengths[order[: count % rows]] += 1
    places = []
    for length, pitch in zip(lengths.tolist(), pitches.tolist(), strict=True):
        yaws = np.linspace(-0.5, 0.5, length) * spread_deg[0] if length > 1 else np.zeros(1)
        places += [(yaw, pitch + _LEVEL_DEG) for yaw in yaws.tolist()]
    return places


def _camera(
    yaw: float,
    pitch: float,
    size_px: tuple[int, int],
    distortion: bool,
    centre: Float[np.ndarray, "3"],
    R_world_head: Float[np.ndarray, "3 3"],
    head_height_m: float,
    rng: np.random.Generator,
) -> Camera:
    width, height = size_px
    yaw, pitch = (np.array([yaw, pitch]) + _TURN_DEG * rng.uniform(-1, 1, 2)).tolist()
    out = Rotation.from_euler("YX", [yaw, -pitch], degrees=True).as_matrix()
    axes = np.stack([out[:, 0], -out[:, 1], -out[:, 2]])  # x right, y down, z towards the head
    axes = Rotation.from_euler("z", _ROLL_DEG * rng.uniform(-1, 1), degrees=True).as_matrix() @ axes
    distance = DISTANCE_M * (1 + _DISTANCE_SHARE * rng.uniform(-1, 1))
    pose = np.eye(4)
    pose[:3, :3] = axes @ R_world_head.T
    pose[:3, 3] = [*(_AIM_M * rng.uniform(-1, 1, 2)), distance] - pose[:3, :3] @ centre
    focal = FILL * height / head_height_m * DISTANCE_M * (1 + _FOCAL_SHARE * rng.uniform(-1, 1))
    aspect = 1 + 0.002 * rng.uniform(-1, 1)
    middle = np.array([width, height]) * (0.5 + _CENTRE_SHARE * rng.uniform(-1, 1, 2))
    pose[:2, 3] -= (middle - np.array([width, height]) / 2) / focal * distance  # the head stays in the image's middle
    intrinsics = np.array([[focal, 0, middle[0]], [0, aspect * focal, middle[1]], [0, 0, 1.0]])
    k1, k2, p1, p2 = (rng.uniform(-1, 1, 4) * _lens_limits(width, height, focal)).tolist()
    return Camera(
        width_px=width,
        height_px=height,
        intrinsics=intrinsics,
        T_cam_world=pose,
        distortion=(k1, k2, p1, p2) if distortion else (),
    )


def _lens_limits(width: int, height: int, focal_px: float) -> Float[np.ndarray, "4"]:
    """The largest k1 k2 p1 p2: 3, 1, 0.5 and 0.5 % of its place at the image's corner, whatever the lens' angle."""
    corner = np.hypot(width, height) / 2 / focal_px
    return np.array([0.03 / corner**2, 0.01 / corner**4, 0.005 / corner, 0.005 / corner])
