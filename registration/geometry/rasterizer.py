"""Triangles on a pixel grid, in NumPy: which face a pixel shows, and which points a camera sees.

For figures and pictures, where neither gradients nor a GPU are wanted. Cameras are pinholes here: distortion is
ignored. Triangles that reach closer than `NEAR` to the camera are left out, not clipped.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.types import Camera

NEAR = 0.01  # metres
_BATCH = 1 << 21  # box cells examined together: about 200 MB of temporaries


def rasterize(
    vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"], camera: Camera
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
    """The front-most face at each pixel's centre (-1 on a miss) and the surface point's barycentrics there.

    World frame, metres; barycentrics are perspective-correct and 0 on a miss. Both sides of a triangle count.
    """
    width, height = camera.width_px, camera.height_px
    corners, depth, kept = _projected(vertices, triangles, camera)
    planes = _weight_planes(corners)
    low = np.ceil(corners.min(1) - 0.5).astype(np.int64)
    high = np.floor(corners.max(1) - 0.5).astype(np.int64)
    nearness = np.zeros(width * height)
    front = np.full(width * height, -1)
    for item, x, y in _box_cells(low, high, width, height):
        weight = _weights(planes, item, x + 0.5, y + 0.5)
        inside = np.flatnonzero(weight.min(0) >= 0)
        item, pixel = item[inside], (y * width + x)[inside]
        near = (weight[:, inside].T / depth[item]).sum(1)
        np.maximum.at(nearness, pixel, near)
        first = near == nearness[pixel]
        front[pixel[first]] = item[first]
    pixel = np.flatnonzero(front >= 0)
    item = front[pixel]
    weight = _weights(planes, item, pixel % width + 0.5, pixel // width + 0.5).T / depth[item]
    face = np.full(width * height, -1)
    barycentric = np.zeros((width * height, 3))
    face[pixel] = kept[item]
    barycentric[pixel] = weight / weight.sum(1, keepdims=True)
    return face.reshape(height, width), barycentric.reshape(height, width, 3)


def visible(
    points: Float[np.ndarray, "P 3"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
    camera: Camera,
    tolerance: float = 5e-4,
) -> Bool[np.ndarray, "P"]:
    """Whether each point falls inside the image and no triangle lies before it by more than `tolerance` (metres).

    Exact in the image plane: the ray of each point is tested, not that of a pixel nearby.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # points in the camera's own plane
        xy, z = camera.project(np.asarray(points, np.float64))
        seen = (z > NEAR) & (xy >= 0).all(1) & (xy <= (camera.width_px, camera.height_px)).all(1)
    rows = np.flatnonzero(seen)
    if not len(rows):
        return seen
    corners, depth, _ = _projected(vertices, triangles, camera)
    planes, nearest = _weight_planes(corners), depth.min(1)
    xy, z = xy[rows], z[rows]
    origin = xy.min(0)
    side = max(1e-3, float(np.sqrt(np.ptp(xy, 0).prod() / len(rows))) / 2)  # px; about four cells a point
    columns, lines = ((np.ptp(xy, 0) // side).astype(np.int64) + 1).tolist()
    cell = ((xy - origin) // side).astype(np.int64) @ (1, columns)
    order = np.argsort(cell, kind="stable")
    count = np.bincount(cell, minlength=columns * lines)
    start = np.cumsum(count) - count
    low = np.floor((corners.min(1) - origin) / side).astype(np.int64)
    high = np.floor((corners.max(1) - origin) / side).astype(np.int64)
    for item, x, y in _box_cells(low, high, columns, lines):
        here = y * columns + x
        pair, rank = _expand(count[here])
        item, point = item[pair], order[start[here[pair]] + rank]
        could = nearest[item] < z[point] - tolerance
        item, point = item[could], point[could]
        weight = _weights(planes, item, xy[point, 0], xy[point, 1])
        hit = np.flatnonzero(weight.min(0) >= 0)
        before = 1 / (weight[:, hit].T / depth[item[hit]]).sum(1) < z[point[hit]] - tolerance
        seen[rows[point[hit][before]]] = False
    return seen


def _projected(
    vertices: np.ndarray, triangles: np.ndarray, camera: Camera
) -> tuple[Float[np.ndarray, "T 3 2"], Float[np.ndarray, "T 3"], Int[np.ndarray, "T"]]:
    """Corner pixels, corner depths and face index of the triangles wholly in front of the camera and not edge-on."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy, z = camera.project(np.asarray(vertices, np.float64))
    kept = np.flatnonzero((z > NEAR)[triangles].all(1))
    corners, depth = xy[triangles[kept]], z[triangles[kept]]
    solid = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) != 0
    return corners[solid], depth[solid], kept[solid]


def _weight_planes(corners: Float[np.ndarray, "T 3 2"]) -> Float[np.ndarray, "3 T 3"]:
    """Barycentrics in the image plane as linear functions (a, b, c) of a pixel: weight k = a x + b y + c."""
    planes = np.empty((3, len(corners), 3))
    for k in range(3):
        p, q = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        planes[k] = np.stack([p[:, 1] - q[:, 1], q[:, 0] - p[:, 0], _cross(p, q)], 1)
    return planes / _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, None]


def _weights(
    planes: Float[np.ndarray, "3 T 3"], item: Int[np.ndarray, "M"], x: np.ndarray, y: np.ndarray
) -> Float[np.ndarray, "3 M"]:
    """All three are >= 0 inside, whichever way the triangle winds."""
    a, b, c = (planes[:, :, n][:, item] for n in range(3))
    return a * x + b * y + c


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]


def _box_cells(
    low: Int[np.ndarray, "T 2"], high: Int[np.ndarray, "T 2"], width: int, height: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(item, x, y) of every grid cell in the boxes low..high (inclusive), in batches."""
    low, high = np.maximum(low, 0), np.minimum(high, (width - 1, height - 1))
    size = np.maximum(high - low + 1, 0)
    filled = np.flatnonzero(size.prod(1))
    batch = np.cumsum(size[filled].prod(1)) // _BATCH
    for items in np.split(filled, np.flatnonzero(np.diff(batch)) + 1):
        row, rank = _expand(size[items].prod(1))
        item = items[row]
        yield item, low[item, 0] + rank % size[item, 0], low[item, 1] + rank // size[item, 0]


def _expand(count: Int[np.ndarray, "N"]) -> tuple[Int[np.ndarray, "S"], Int[np.ndarray, "S"]]:
    """Each index n repeated count[n] times, and 0 .. count[n] - 1 beside it."""
    index = np.repeat(np.arange(len(count)), count)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
