"""The mends of findings: what changes in a capture in memory, and in its folder on disk."""

import json
import re
import shutil
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from registration.capture import pixels
from registration.capture.class_names import meaning
from registration.capture.colmap import read_cameras, read_points, write_model
from registration.capture.headers import read_header
from registration.capture.landmark_files import ViewLandmarks, moved_spread, read_landmarks, write_landmarks
from registration.capture.native import read_capture
from registration.capture.samples import ViewSample
from registration.capture.scan import SCANS, read_scan_file, read_truth
from registration.doctor.mesh_frame import Frame
from registration.errors import InputError
from registration.storage.files import atomic_write_text
from registration.storage.image_files import decode
from registration.storage.mesh import write_ply
from registration.storage.reading import parse_toml, read_text
from registration.types import Camera, Capture, NormalsFrame, View

Points = Float[np.ndarray, "L 3"]


@dataclass(frozen=True, kw_only=True)
class _Mend:
    what: str

    def on_capture(self, capture: Capture) -> Capture:
        return capture

    def on_sample(self, sample: ViewSample, camera: Camera) -> ViewSample:
        return sample


@dataclass(frozen=True, kw_only=True)
class CameraFix(_Mend):
    """Another pose, K or size of cameras. The points of the COLMAP model are multiplied by `scale`."""

    change: Callable[[Camera], Camera]
    views: Collection[str] | None = None  # names; None: all
    scale: float = 1.0

    def on_capture(self, capture: Capture) -> Capture:
        views = (replace(v, camera=self._changed(v.name, v.camera)) for v in capture.views)
        return replace(capture, views=tuple(views))

    def on_folder(self, root: Path) -> None:
        sparse = root / "sparse"
        cameras = {name: self._changed(_stem(name), camera) for name, camera in read_cameras(sparse).items()}
        points, colours = read_points(sparse)
        shutil.rmtree(sparse)
        write_model(sparse, cameras, points * self.scale, colours)

    def _changed(self, view: str, camera: Camera) -> Camera:
        return self.change(camera) if self.views is None or view in self.views else camera


def scaled_world(factor: float, what: str) -> CameraFix:
    """The mend of cameras in another unit: translations times `factor`, metres per unit."""

    def change(camera: Camera) -> Camera:
        T = camera.T_cam_world.copy()
        T[:3, 3] *= factor
        return replace(camera, T_cam_world=T)

    return CameraFix(what=what, change=change, scale=factor)


@dataclass(frozen=True, kw_only=True)
class LandmarkFix(_Mend):
    """Another meaning of landmark files."""

    change: Callable[[Points, Camera], Points]
    schemes: Collection[str] | None = None  # None: all
    views: Collection[str] | None = None

    def on_capture(self, capture: Capture) -> Capture:
        views = []
        for view in capture.views:
            changed = self._changed(view, ViewLandmarks(points=view.landmarks, spread_px=view.landmark_spread_px))
            views.append(replace(view, landmarks=changed.points, landmark_spread_px=changed.spread_px))
        return replace(capture, views=tuple(views))

    def on_folder(self, root: Path) -> None:
        for view in read_capture(root).views:
            if view.landmarks:
                file = landmark_file(root, view)
                changed = self._changed(view, read_landmarks(file))
                write_landmarks(file, changed.points, changed.spread_px)

    def _changed(self, view: View, landmarks: ViewLandmarks) -> ViewLandmarks:
        if self.views is not None and view.name not in self.views:
            return landmarks

        def change(points: Points) -> Points:
            return self.change(points, view.camera)

        names = [name for name in landmarks.points if self.schemes is None or name in self.schemes]
        points = {name: change(landmarks.points[name]) for name in names}
        spreads = {
            name: moved_spread(change, landmarks.points[name], landmarks.spread_px[name])
            for name in names
            if name in landmarks.spread_px
        }
        return ViewLandmarks(points={**landmarks.points, **points}, spread_px={**landmarks.spread_px, **spreads})


@dataclass(frozen=True, kw_only=True)
class MaskFix(_Mend):
    """Inverted masks."""

    views: Collection[str]

    def on_sample(self, sample: ViewSample, camera: Camera) -> ViewSample:
        if sample.mask is None or sample.name not in self.views:
            return sample
        coverage = None if sample.coverage is None else 1 - sample.coverage
        return replace(sample, mask=255 - sample.mask, subject=sample.mask <= 127, coverage=coverage)

    def on_folder(self, root: Path) -> None:
        for view in read_capture(root).views:
            if view.mask is not None and view.name in self.views:
                write_png(view.mask, 255 - pixels.read_mask(view.mask, view.camera))


@dataclass(frozen=True, kw_only=True)
class NormalFix(_Mend):
    """Normals in other axes: a signed permutation, then a rotation from the world if they are there."""

    matrix: Float[np.ndarray, "3 3"]  # maps stored normals to the camera's axes, or to the world's
    world: bool
    views: Collection[str] | None = None

    def on_sample(self, sample: ViewSample, camera: Camera) -> ViewSample:
        if sample.normals is None or not (self.views is None or sample.name in self.views):
            return sample
        return replace(sample, normals=sample.normals @ self._matrix(camera).T)

    def on_folder(self, root: Path) -> None:
        for view in read_capture(root).views:
            if view.normals is not None and (self.views is None or view.name in self.views):
                self._mend(view.normals, view.camera)

    def _mend(self, file: Path, camera: Camera) -> None:
        stored = pixels.read_normals(file, camera)
        if stored.dtype != np.uint16:
            raise InputError.unreadable(
                "normal map", where=file, expected="PNG", got="numbers of COLMAP", fix="convert it to PNG of 16 bits"
            )
        background = (stored == 0).all(-1)
        if self.world:
            vectors = pixels.decode_normals(stored) @ self._matrix(camera).T
            changed = np.round((np.clip(vectors, -1, 1) + 1) * (65535 / 2)).astype(np.uint16)
        else:  # exact
            order = np.abs(self.matrix).argmax(1)
            negative = self.matrix[range(3), order] < 0
            changed = stored[..., order].copy()
            changed[..., negative] = 65535 - changed[..., negative]
        changed[background] = 0
        write_png(file, np.ascontiguousarray(changed[..., ::-1]))

    def _matrix(self, camera: Camera) -> Float[np.ndarray, "3 3"]:
        matrix = camera.T_cam_world[:3, :3] @ self.matrix if self.world else self.matrix
        return matrix.astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class NormalFrameFix(_Mend):
    """What capture.toml says about the axes of the normals."""

    frame: NormalsFrame
    matrix: Float[np.ndarray, "3 3"]  # as of `NormalFix`
    world: bool

    def on_sample(self, sample: ViewSample, camera: Camera) -> ViewSample:
        return NormalFix(what=self.what, matrix=self.matrix, world=self.world).on_sample(sample, camera)

    def on_folder(self, root: Path) -> None:
        path = root / "capture.toml"
        if re.search(r"^\s*\[normals\]", text := _toml_text(path), re.MULTILINE):
            set_in_toml(root, "frame", f'"{self.frame}"')
        else:
            atomic_write_text(path, f'{text.rstrip()}\n\n[normals]\nframe = "{self.frame}"\n')


@dataclass(frozen=True, kw_only=True)
class ClassFix(_Mend):
    """Two label classes that have each other's names."""

    first: str
    second: str

    def on_capture(self, capture: Capture) -> Capture:
        return replace(capture, classes=tuple(self._other(name) for name in capture.classes))

    def on_folder(self, root: Path) -> None:
        path = root / "capture.toml"
        unreadable = partial(InputError.unreadable, "capture.toml", where=path, fix="name the classes there")
        settings = parse_toml(_toml_text(path).encode(), unreadable)
        names = settings.get("segmentation", {}).get("classes")
        if not isinstance(names, list):
            raise unreadable(expected="[segmentation] classes = [...]", got="no such list")
        set_in_toml(root, "classes", json.dumps([self._other(name) for name in names], ensure_ascii=False))

    def _other(self, name: str) -> str:
        return {self.first: self.second, self.second: self.first}.get(meaning(name) or name, name)


@dataclass(frozen=True, kw_only=True)
class ScanFix(_Mend):
    """A scan or true vertices in another unit or frame. Only vertices and faces are kept."""

    frame: Frame
    file: str  # below the capture folder

    def on_capture(self, capture: Capture) -> Capture:
        return replace(capture, ground_truth=None) if self.file == "ground_truth.npz" else replace(capture, scan=None)

    def on_folder(self, root: Path) -> None:
        path = root / self.file
        if self.file == "ground_truth.npz":
            np.savez(path, vertices=self.frame.to_world(read_truth(path).astype(np.float64)))
            return
        mesh = read_scan_file(path)
        triangles = mesh.triangles
        # A mirrored scan is inside out, unless its faces were turned too: then they are turned back.
        if self.frame.mirrored and _signed_volume(mesh.vertices, triangles) > 0:
            triangles = triangles[:, ::-1]
        path.unlink()
        write_ply(path.with_suffix(".ply"), self.frame.to_world(mesh.vertices), triangles)


@dataclass(frozen=True, kw_only=True)
class UnitEntryFix(_Mend):
    """The entry `units` of capture.toml."""

    scale: float = 1.0  # metres per unit, of cameras, scan and ground truth that are to be scaled by it

    def on_capture(self, capture: Capture) -> Capture:
        if self.scale == 1:
            return capture
        capture = scaled_world(self.scale, self.what).on_capture(capture)
        return replace(capture, scan=None, ground_truth=None)

    def on_folder(self, root: Path) -> None:
        set_in_toml(root, "units", '"m"')
        if self.scale != 1:
            scaled_world(self.scale, self.what).on_folder(root)
            frame = Frame(unit=self.scale, axes=(0, 1, 2), signs=(1, 1, 1))
            for file in (*SCANS, "ground_truth.npz"):
                if (root / file).exists():
                    ScanFix(what=self.what, frame=frame, file=file).on_folder(root)


@dataclass(frozen=True, kw_only=True)
class TurnFix(_Mend):
    """Images as their EXIF orientation says, with those of a view's other files that are turned as well."""

    orientations: Mapping[str, int]  # image, below images/ -> EXIF orientation

    def on_folder(self, root: Path) -> None:
        for name, orientation in self.orientations.items():
            image = root / "images" / name
            stored = read_header(image, "image")
            for file in [image, *self._others(root, name)]:
                header = read_header(file, "image")
                if (header.width_px, header.height_px) == (stored.width_px, stored.height_px):
                    _turn(file, orientation)

    def _others(self, root: Path, name: str) -> list[Path]:
        stem = Path(name).with_suffix("")
        folders = ("masks", "normals", "confidence", "segmentation")
        files = [root / folder / f"{stem}{suffix}" for folder in folders for suffix in (".png", ".jpg", ".jpeg")]
        return [file for file in files if file.is_file()]


@dataclass(frozen=True, kw_only=True)
class RenameFix(_Mend):
    """Files or folders under other names."""

    names: Mapping[str, str]  # path -> path, both below the capture folder

    def on_folder(self, root: Path) -> None:
        for old, new in self.names.items():
            target = root / new
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.exists() or target.samefile(root / old):  # a file system may ignore case
                (root / old).rename(target)


def _signed_volume(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> float:
    """Positive for faces that point away from the middle of a mesh; holes do little harm."""
    a, b, c = (vertices[triangles[:, k]] - np.nanmedian(vertices, axis=0) for k in range(3))
    return float(np.nansum(a * np.cross(b, c)))


def landmark_file(root: Path, view: View) -> Path:
    """The landmark file of a view."""
    relative = view.image.relative_to(root / "images")
    first = root / "landmarks" / relative.with_suffix(".json")
    return first if first.exists() else root / "landmarks" / f"{relative.as_posix()}.json"


_TURNS = {3: cv2.ROTATE_180, 6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}


def _turn(file: Path, orientation: int) -> None:
    refuse = partial(InputError, "The image cannot be decoded", where=file, fix="copy or write the file again")
    stored = decode(file, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION, refuse)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 100] if file.suffix.lower() in (".jpg", ".jpeg") else []
    if not cv2.imwrite(str(file), cv2.rotate(stored, _TURNS[orientation]), quality):
        raise OSError(f"{file} cannot be written")


def write_png(file: Path, image: np.ndarray) -> None:
    """Write pixels as a PNG; a file with another suffix is replaced by one with this."""
    target = file.with_suffix(".png")
    if not cv2.imwrite(str(target), image):
        raise OSError(f"{target} cannot be written")
    if target != file:
        file.unlink()


def set_in_toml(root: Path, key: str, value: str) -> None:
    """Replace a value in capture.toml, or add it as the first line. Raises InputError if the file cannot be read."""
    path = root / "capture.toml"
    text = _toml_text(path)
    entry = re.compile(rf"^(\s*\"?{key}\"?\s*=\s*)(\[.*?\]|\"[^\"\n]*\"|'[^'\n]*'|[^\n#]+)", re.MULTILINE | re.DOTALL)
    changed, count = entry.subn(lambda match: match[1] + value, text, count=1)
    atomic_write_text(path, changed if count else f"{key} = {value}\n{text}")


def _toml_text(path: Path) -> str:
    return read_text(path, partial(InputError.unreadable, "capture.toml", where=path, fix="write it again"))


def _stem(image: str) -> str:
    return str(Path(image).with_suffix(""))
