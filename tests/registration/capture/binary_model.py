"""COLMAP's binary files, written from the format's description alone."""

import struct
from pathlib import Path

from scipy.spatial.transform import Rotation

from registration.capture.colmap import read_cameras, read_points

FULL_OPENCV = 6  # the camera model's number


def write_binary(sparse: Path, target: Path) -> Path:
    """Write a model in binary files as COLMAP did before it had rigs and frames; images have two points each."""
    cameras = read_cameras(sparse)
    points, colours = read_points(sparse)
    lenses, images = [struct.pack("<Q", len(cameras))], [struct.pack("<Q", len(cameras))]
    for number, (name, camera) in enumerate(cameras.items(), 7):
        K, distortion = camera.intrinsics, (*camera.distortion, *[0.0] * 8)[:8]
        size = (camera.width_px, camera.height_px)
        lenses.append(struct.pack("<IiQQ", number, FULL_OPENCV, *size))
        lenses.append(struct.pack("<12d", K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion))
        x, y, z, w = Rotation.from_matrix(camera.T_cam_world[:3, :3]).as_quat()
        images.append(struct.pack("<I7dI", number, w, x, y, z, *camera.T_cam_world[:3, 3], number))
        images.append(name.encode() + b"\0" + struct.pack("<Q2dq2dq", 2, 1.5, 2.5, -1, 3.5, 4.5, 12))
    rows = [struct.pack("<Q", len(points))]
    for number, (point, colour) in enumerate(zip(points, colours, strict=True)):
        rows.append(struct.pack("<Q3d3BdQ2I", number, *point, *map(int, colour), 0.5, 1, 7, 0))
    target.mkdir()
    for file, parts in (("cameras.bin", lenses), ("images.bin", images), ("points3D.bin", rows)):
        (target / file).write_bytes(b"".join(parts))
    return target


def to_binary(root: Path) -> None:
    """Replace a capture's text model by a binary one."""
    binary = write_binary(root / "sparse", root / "binary")
    for file in (root / "sparse").iterdir():
        file.unlink()
    for file in binary.iterdir():
        file.rename(root / "sparse" / file.name)
    binary.rmdir()
