"""Captures with the faults that people's captures have, made from a good one by a few lines each."""

import json
import re
import shutil
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from registration.capture.colmap import read_cameras, read_points, write_model
from registration.capture.scan import read_scan_file
from registration.doctor.landmark_checks import MIRRORED_68
from registration.storage.mesh import write_ply
from registration.types import Camera

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Spoiled:
    """One faulty capture."""

    name: str
    kinds: tuple[str, ...]  # of the findings that are expected, written before the doctor was asked
    says: str  # pattern in what the doctor says about them
    spoil: Callable[[Path], None]
    without: tuple[str, ...] = ()  # parts that are removed first
    mended: str = "exact"  # exact, near (pixels or vertices are rounded), or person: only told


def pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def cameras(root: Path, change: Callable[[str, Camera], Camera], points: float = 1.0) -> None:
    """Change the cameras; `change` takes the image's stem and its camera."""
    sparse = root / "sparse"
    found = {name: change(Path(name).stem, camera) for name, camera in read_cameras(sparse).items()}
    xyz, colours = read_points(sparse)
    shutil.rmtree(sparse)
    write_model(sparse, found, xyz * points, colours)


def poses(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda root: cameras(root, lambda _, c: replace(c, T_cam_world=change(c.T_cam_world)))


def world(factor: float, scan: bool = False) -> Callable[[Path], None]:
    """A world in another unit: `factor` units a metre."""

    def spoil(root: Path) -> None:
        cameras(
            root,
            lambda _, c: replace(c, T_cam_world=pose(c.T_cam_world[:3, :3], factor * c.T_cam_world[:3, 3])),
            factor,
        )
        if scan:
            vertices(lambda v: factor * v)(root)

    return spoil


def vertices(change: Callable[[np.ndarray], np.ndarray], flip: bool = False) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        mesh = read_scan_file(root / "scan.ply")
        write_ply(root / "scan.ply", change(mesh.vertices), mesh.triangles[:, ::-1] if flip else mesh.triangles)

    return spoil


def landmarks(change: Callable[[np.ndarray], np.ndarray], views: Collection[str] = ()) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        for file in sorted((root / "landmarks").glob("*.json")):
            if not views or file.stem in views:
                schemes = json.loads(file.read_text())
                file.write_text(json.dumps({k: change(np.array(v, float)).tolist() for k, v in schemes.items()}))

    return spoil


def images(
    folder: str, change: Callable[[np.ndarray], np.ndarray], views: Collection[str] = ()
) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        for file in sorted((root / folder).glob("*.png")):
            if not views or file.stem in views:
                cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))

    return spoil


def normals(change: Callable[[np.ndarray, Camera], np.ndarray]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        found = {Path(name).stem: camera for name, camera in read_cameras(root / "sparse").items()}
        for file in sorted((root / "normals").glob("*.png")):
            stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1]
            changed = change(stored * (2 / 65535) - 1, found[file.stem])
            encoded = np.round((changed + 1) * (65535 / 2)).clip(0, 65535).astype(np.uint16)
            encoded[(stored == 0).all(-1)] = 0
            cv2.imwrite(str(file), encoded[..., ::-1])

    return spoil


def classes(change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = root / "capture.toml"
        head, names = path.read_text().split("classes =")
        path.write_text(f"{head}classes = {json.dumps(change(json.loads(names)))}\n")

    return spoil


def toml(pattern: str, text: str) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        path = root / "capture.toml"
        path.write_text(re.sub(pattern, text, path.read_text()))

    return spoil


def all_of(*spoils: Callable[[Path], None]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        for one in spoils:
            one(root)

    return spoil


def rename(pairs: Mapping[str, str]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        for old, new in pairs.items():
            (root / old).rename(root / new)

    return spoil


def suffixed(folder: str, end: str) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        for file in sorted((root / folder).iterdir()):
            file.rename(file.with_name(f"{file.stem}{end}{file.suffix}"))

    return spoil


def _scalar_last(T: np.ndarray) -> np.ndarray:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return pose(Rotation.from_quat([y, z, w, x]).as_matrix(), T[:3, 3])


def _half(camera: Camera) -> Camera:
    return replace(camera, intrinsics=np.diag([0.5, 0.5, 1.0]) @ camera.intrinsics)


def _on_their_sides(root: Path) -> None:
    """Images as a camera held upright stores them, with an EXIF orientation; all else is upright."""
    for file in sorted((root / "images").glob("*.png")):
        with Image.open(file) as image:
            turned = image.transpose(Image.Transpose.ROTATE_90)
            exif = image.getexif()
            exif[274] = 6
        turned.save(file, exif=exif)


def _all_turned(root: Path) -> None:
    """Everything but the calibration is turned by a quarter, without a word in the files."""
    for folder in ("images", "masks", "normals", "segmentation"):
        images(folder, lambda a: cv2.rotate(a, cv2.ROTATE_90_CLOCKWISE))(root)
    height = next(iter(read_cameras(root / "sparse").values())).height_px
    landmarks(lambda p: np.column_stack([height - p[:, 1], p[:, 0], p[:, 2]]))(root)


def _no_face(root: Path) -> None:
    """What cameras behind the head see: no landmark, and labels of skin only."""
    landmarks(lambda p: np.column_stack([p[:, :2], np.minimum(p[:, 2], 0.3)]))(root)
    if not (root / "segmentation").is_dir():
        return
    names = json.loads((root / "capture.toml").read_text().split("classes =")[1])
    table = np.arange(256, dtype=np.uint8)
    for name in ("left_eye", "right_eye", "upper_lip", "lower_lip", "mouth_interior"):
        table[names.index(name)] = names.index("skin")
    images("segmentation", lambda a: table[a])(root)


def _looks_away(root: Path) -> None:
    """The first camera looks to the side."""
    turn = pose(Rotation.from_euler("y", 70, degrees=True).as_matrix(), np.zeros(3))
    first = sorted(read_cameras(root / "sparse"))[0]
    cameras(root, lambda s, c: replace(c, T_cam_world=turn @ c.T_cam_world) if s == Path(first).stem else c)


def _first(root: Path, count: int) -> list[str]:
    return [Path(name).stem for name in sorted(read_cameras(root / "sparse"))[:count]]


def _exposed(root: Path) -> None:
    def brighter(image: np.ndarray) -> np.ndarray:
        linear = (image / 255.0) ** 2.2 * 6
        return np.round(255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)

    images("images", brighter, _first(root, 2))(root)


def _celeb(root: Path) -> None:
    """CelebAMask-HQ's names."""
    names = {
        "left_eye": "l_eye",
        "right_eye": "r_eye",
        "upper_lip": "u_lip",
        "lower_lip": "l_lip",
        "ears": "l_ear",
        "mouth_interior": "mouth",
        "neck_other": "neck",
        "skin": "facial_skin",
        "background": "bg",
    }
    classes(lambda given: [names[name] for name in given])(root)


# ruff: noqa: E501
LANDMARKS, SCAN = ("landmarks",), ("scan.ply", "ground_truth.npz")
BARE = (*LANDMARKS, *SCAN, "normals", "segmentation")  # images and masks are left

SPOILED: tuple[Spoiled, ...] = (
    Spoiled(name="camera to world", kinds=("poses-inverted",), says="invert", spoil=poses(np.linalg.inv)),
    Spoiled(name="camera to world, no landmarks", kinds=("poses-inverted",), says="invert", spoil=poses(np.linalg.inv), without=LANDMARKS),
    Spoiled(name="camera to world, images and masks", kinds=("poses-inverted",), says="invert", spoil=poses(np.linalg.inv), without=BARE),
    Spoiled(name="OpenGL", kinds=("poses-opengl",), says="diag", spoil=poses(lambda T: FLIP @ T)),
    Spoiled(name="OpenGL, no landmarks", kinds=("poses-opengl",), says="diag", spoil=poses(lambda T: FLIP @ T), without=LANDMARKS),
    Spoiled(name="nerfstudio", kinds=("poses-inverted",), says="nerfstudio", spoil=poses(lambda T: np.linalg.inv(FLIP @ T))),
    Spoiled(name="nerfstudio, images and masks", kinds=("poses-inverted",), says="nerfstudio", spoil=poses(lambda T: np.linalg.inv(FLIP @ T)), without=BARE),
    Spoiled(name="nerfstudio, images and scan", kinds=("poses-inverted",), says="nerfstudio", spoil=poses(lambda T: np.linalg.inv(FLIP @ T)), without=(*LANDMARKS, "masks", "normals", "segmentation")),
    Spoiled(name="transposed", kinds=("poses-transposed",), says="transpose", spoil=poses(lambda T: pose(T[:3, :3].T, T[:3, 3]))),
    Spoiled(name="transposed, images and masks", kinds=("poses-transposed",), says="transpose", spoil=poses(lambda T: pose(T[:3, :3].T, T[:3, 3])), without=BARE),
    Spoiled(name="transposed, images and scan", kinds=("poses-transposed",), says="transpose", spoil=poses(lambda T: pose(T[:3, :3].T, T[:3, 3])), without=(*LANDMARKS, "masks", "normals", "segmentation")),
    Spoiled(name="centre for translation", kinds=("poses-centre",), says="-R t", spoil=poses(lambda T: pose(T[:3, :3], -T[:3, :3].T @ T[:3, 3]))),
    Spoiled(name="centre for translation, no landmarks", kinds=("poses-centre",), says="-R t", spoil=poses(lambda T: pose(T[:3, :3], -T[:3, :3].T @ T[:3, 3])), without=LANDMARKS),
    Spoiled(name="quaternions x y z w, no landmarks", kinds=("poses-quaternion",), says="w x y z", spoil=poses(_scalar_last), without=LANDMARKS),
    Spoiled(name="cameras in millimetres", kinds=("unit",), says="0.001", spoil=world(1000)),
    Spoiled(name="world in centimetres", kinds=("unit", "scan-unit"), says="0.01", spoil=world(100, scan=True), without=("ground_truth.npz",), mended="near"),
    Spoiled(name="world in feet, no landmarks", kinds=("unit",), says="0.3048", spoil=world(1 / 0.3048), without=(*LANDMARKS, *SCAN)),
    Spoiled(name="world in feet, images and masks", kinds=("unit",), says="0.3048", spoil=world(1 / 0.3048), without=BARE, mended="person"),
    Spoiled(name="world in decimetres, no masks", kinds=("unit",), says="0.1", spoil=world(10), without=("masks",)),
    Spoiled(name="no scale", kinds=("unit",), says="no scale", spoil=world(13.7), without=SCAN, mended="person"),
    Spoiled(name="units say mm", kinds=("unit-entry",), says='units = "m"', spoil=toml(r'units = "m"', 'units = "mm"')),
    Spoiled(name="units say mm, and so it is", kinds=("unit-entry", "unit"), says="0.001", spoil=all_of(world(1000), toml(r'units = "m"', 'units = "mm"'))),
    Spoiled(name="scan in millimetres", kinds=("scan-unit",), says="millimetres", spoil=vertices(lambda v: 1000 * v), mended="near"),
    Spoiled(name="scan in centimetres, no landmarks", kinds=("scan-unit",), says="centimetres", spoil=vertices(lambda v: 100 * v), without=LANDMARKS, mended="near"),
    Spoiled(name="scan with z up", kinds=("scan-axes",), says="turned", spoil=vertices(lambda v: v[:, [0, 2, 1]] * [1, -1, 1]), mended="near"),
    Spoiled(name="scan with z up in centimetres, no landmarks", kinds=("scan-unit",), says="centimetres.*turned", spoil=vertices(lambda v: 100 * v[:, [0, 2, 1]] * [1, -1, 1]), without=LANDMARKS, mended="near"),
    Spoiled(name="mirrored scan", kinds=("scan-mirrored",), says="mirrored", spoil=vertices(lambda v: v * [-1, 1, 1]), mended="near"),
    Spoiled(name="scan moved by 3 cm", kinds=("scan-moved",), says="mm", spoil=vertices(lambda v: v + [0.03, 0, 0]), mended="person"),
    Spoiled(name="scan moved by 4 cm, no landmarks", kinds=("scan-moved",), says="mm", spoil=vertices(lambda v: v + [0.0, 0.04, 0.0]), without=LANDMARKS, mended="person"),
    Spoiled(name="images of twice the size", kinds=("image-size",), says="multiply fx", spoil=lambda root: cameras(root, lambda _, c: c.scaled(c.width_px // 2, c.height_px // 2))),
    Spoiled(name="size in the model filled in", kinds=("image-size",), says="write 480 x 720", spoil=lambda root: cameras(root, lambda _, c: replace(c, width_px=1920, height_px=1080))),
    Spoiled(name="K of half the size", kinds=("intrinsics-scale",), says="by 2", spoil=lambda root: cameras(root, lambda _, c: _half(c))),
    Spoiled(name="K of half the size, no landmarks", kinds=("intrinsics-scale",), says="by 2", spoil=lambda root: cameras(root, lambda _, c: _half(c)), without=LANDMARKS),
    Spoiled(name="K of half the size, images and masks", kinds=("intrinsics-scale",), says="by 2", spoil=lambda root: cameras(root, lambda _, c: _half(c)), without=BARE),
    Spoiled(name="images on their sides, EXIF", kinds=("image-turned",), says="EXIF", spoil=_on_their_sides),
    Spoiled(name="all turned by a quarter", kinds=("image-turned",), says="turn the cameras", spoil=_all_turned, without=("normals",), mended="turned"),
    Spoiled(name="a camera looks away", kinds=("unseen",), says="cam", spoil=_looks_away, mended="person"),
    Spoiled(name="a camera looks away, images and masks", kinds=("unseen",), says="cam", spoil=_looks_away, without=BARE, mended="person"),
    Spoiled(name="all cameras behind the head", kinds=("face-unseen",), says="behind", spoil=_no_face, without=("segmentation",), mended="person"),
    Spoiled(name="all cameras behind the head, labels", kinds=("face-unseen",), says="behind", spoil=_no_face, without=LANDMARKS, mended="person"),
    Spoiled(name="two views overexposed", kinds=("exposure",), says="cam", spoil=_exposed, mended="person"),
    Spoiled(name="distortion that folds", kinds=("distortion",), says="fold", spoil=lambda root: cameras(root, lambda _, c: replace(c, distortion=(-9.0, 0.0, 0.0, 0.0))), mended="person"),
    Spoiled(name="landmarks outside the masks", kinds=("landmarks-outside",), says="outside", spoil=landmarks(lambda p: p + [300, 0, 0]), mended="person"),
    Spoiled(name="normalized landmarks", kinds=("landmarks-normalized",), says="normalized", spoil=landmarks(lambda p: p / [480, 720, 1]), mended="near"),
    Spoiled(name="landmarks at half resolution", kinds=("landmarks-resolution",), says="divide x and y by 0.5", spoil=landmarks(lambda p: p * [0.5, 0.5, 1])),
    Spoiled(name="landmarks of images resized to 512", kinds=("landmarks-resolution",), says="512", spoil=landmarks(lambda p: p * [512 / 480, 512 / 720, 1]), mended="near"),
    Spoiled(name="left and right landmarks exchanged", kinds=("landmarks-swapped",), says="exchange", spoil=landmarks(lambda p: p[MIRRORED_68])),
    Spoiled(name="landmarks of mirrored images", kinds=("landmarks-mirrored",), says="width minus x", spoil=landmarks(lambda p: p * [-1, 1, 1] + [480, 0, 0]), mended="near"),
    Spoiled(name="confidences in percent", kinds=("landmarks-confidence",), says="100", spoil=landmarks(lambda p: p * [1, 1, 100]), mended="near"),
    Spoiled(name="eyes exchanged in the labels", kinds=("labels-swapped",), says="left_eye", spoil=classes(lambda n: [{"left_eye": "right_eye", "right_eye": "left_eye"}.get(k, k) for k in n])),
    Spoiled(name="eyes exchanged in the labels, no landmarks", kinds=("labels-swapped",), says="left_eye", spoil=classes(lambda n: [{"left_eye": "right_eye", "right_eye": "left_eye"}.get(k, k) for k in n]), without=LANDMARKS),
    Spoiled(name="CelebAMask names", kinds=("labels-vocabulary",), says="vocabulary|name", spoil=_celeb, mended="person"),
    Spoiled(name="inverted masks", kinds=("mask-inverted",), says="invert", spoil=images("masks", lambda a: 255 - a)),
    Spoiled(name="inverted masks, images and masks", kinds=("mask-inverted",), says="invert", spoil=images("masks", lambda a: 255 - a), without=BARE),
    Spoiled(name="normals in OpenGL's axes", kinds=("normals-axes",), says="OpenGL", spoil=normals(lambda n, _: n * [1, -1, -1]), mended="near"),
    Spoiled(name="normals in the world", kinds=("normals-axes",), says="world", spoil=normals(lambda n, c: n @ c.T_cam_world[:3, :3]), mended="near"),
    Spoiled(name="folders mask and labels", kinds=("files-unread",), says="rename", spoil=rename({"masks": "mask", "segmentation": "labels"})),
    Spoiled(name="cam01_mask.png", kinds=("files-unmatched",), says="rename", spoil=suffixed("masks", "_mask")),
    Spoiled(name="images with another case", kinds=("image-names",), says="PNG", spoil=lambda root: [f.rename(f.with_suffix(".PNG")) for f in sorted((root / "images").iterdir())] and None),
    Spoiled(name="three faults at once", kinds=("unit", "poses-opengl", "mask-inverted"), says="diag", spoil=all_of(world(1000), poses(lambda T: FLIP @ T), images("masks", lambda a: 255 - a))),
)  # fmt: skip


def make(source: Path, target: Path, spoiled: Spoiled) -> Path:
    """Copy a capture without some parts, and spoil the copy."""
    shutil.copytree(source, target, copy_function=shutil.copyfile)
    remove(target, spoiled.without)
    spoiled.spoil(target)
    return target


def remove(root: Path, parts: Collection[str]) -> None:
    """Remove folders and files of a capture."""
    for part in parts:
        path = root / part
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
