"""A chunk of Agisoft Metashape as its XML describes it: what exported cameras and projects share.

Metashape user manual, appendices "Camera models" and "Coordinate systems":
- The camera's axes are OpenCV's. `<transform>` of a camera is camera to chunk, 16 numbers by rows; that of the chunk
  is chunk to world, with a scale.
- u = w / 2 + cx + x' (f + B1) + y' B2 and v = h / 2 + cy + y' f; the first pixel's centre is at (0.5, 0.5), and
  affinity and skew are entries of K.
- Cameras of a rig have a `master_id`: their sensor's rotation and location are slave to master, in the chunk's unit.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.errors import InputError
from registration.formats.photogrammetry_lenses import brown_lens
from registration.formats.photographs import Photographs, check_rotation, left_out, unique_views
from registration.formats.source import Distortion, SourceView
from registration.formats.xml_files import Element

_FISHEYES = {
    "fisheye": "equidistant_brown",
    "equidistant_fisheye": "equidistant_brown",
    "equisolid_fisheye": "equisolid_brown",
}
_TO_COLMAP = "undistort the photographs in Metashape and export the cameras again, or export to COLMAP"
_EARTH_M, _EARTH_TOLERANCE_M = 6.371e6, 5e4  # from the origin of geocentric coordinates to the ground
_UNIT = re.compile(r'UNIT\["[^"]*",\s*([0-9.eE+-]+)')


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A sensor of a chunk."""

    width_px: int
    height_px: int
    intrinsics: Float[np.ndarray, "3 3"]
    distortion: Distortion
    T_master_slave: Float[np.ndarray, "4 4"]  # of a rig; chunk's unit


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """What a chunk gives."""

    views: tuple[SourceView, ...]
    unit_m: float | None
    local: bool  # whether the world is that of the exported mesh
    notes: tuple[str, ...]


def read_chunk(chunk: Element, photographs: Photographs, root: Path, paths: dict[str, str] | None = None) -> Chunk:
    """Read the cameras of a chunk.

    Args:
        chunk: the element.
        photographs: where to look for the images.
        root: the folder that names of views are relative to.
        paths: camera's id -> path of its image; None: labels name the images.

    Raises:
        InputError: an element is missing or malformed, a camera type has no lens, poses are no rotations, no camera is
            aligned, or an image is missing.
    """
    lenses = {e.attribute("id"): e for e in chunk.need("sensors").all("sensor")}
    cameras = {e.attribute("id"): e for e in chunk.need("cameras").descendants("camera")}
    component, others = _main_component(list(cameras.values()))
    world = _world(chunk, component)
    read: dict[str, Lens] = {}
    images: list[Path] = []
    found: list[tuple[Lens, Float[np.ndarray, "4 4"]]] = []
    disabled, unaligned, slaves = [], [], []
    for number, camera in cameras.items():
        label = camera.attributes.get("label", number)
        if camera.attributes.get("enabled", "true") in ("false", "0"):
            disabled.append(label)
            continue
        T_chunk_master = _camera_pose(camera, cameras)
        if T_chunk_master is None:
            unaligned.append(label)
            continue
        if camera.attributes.get("component_id", component) != component:
            continue
        sensor = camera.attribute("sensor_id")
        if sensor not in lenses:
            raise camera.error("the id of a sensor", sensor)
        lens = read[sensor] = read.get(sensor) or _lens(lenses[sensor])
        own = camera.find("transform") is not None
        slaves += [] if own else [label]
        name = (paths or {}).get(number, label)
        images.append(photographs.find(name, camera.refuse(), label))
        found.append((lens, T_chunk_master if own else T_chunk_master @ lens.T_master_slave))
    if not found:
        got = f"{len(unaligned)} without <transform>, {len(disabled)} disabled"
        raise chunk.error("at least one aligned camera", got, "align the photographs in Metashape first")
    notes = [
        *world.notes,
        *left_out(disabled, "disabled in Metashape"),
        *left_out(unaligned, "not aligned"),
        *left_out(others, "in another component, whose world is another"),
    ]
    if slaves:
        notes.append(f"{len(slaves)} cameras have their master's pose and their sensor's offset, in the chunk's unit")
    if any(
        e.attributes.get("name") == "rolling_shutter" and e.attributes.get("value") == "true"
        for e in _properties(chunk)
    ):
        notes.append("Metashape compensated a rolling shutter: that is not read, cameras are still ones")
    views = tuple(
        SourceView(
            name=name,
            image=image,
            width_px=lens.width_px,
            height_px=lens.height_px,
            intrinsics=lens.intrinsics,
            T_cam_world=world.to_camera(T_chunk_cam),
            distortion=lens.distortion,
            mask=photographs.mask(image),
        )
        for name, image, (lens, T_chunk_cam) in zip(unique_views(images, root), images, found, strict=True)
    )
    return Chunk(views=views, unit_m=world.unit_m, local=world.local, notes=tuple(notes))


def _properties(chunk: Element) -> Iterator[Element]:
    return chunk.need("sensors").descendants("property")


@dataclass(frozen=True, kw_only=True)
class _World:
    """From the chunk's frame to the world that is read."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    scale: float
    unit_m: float | None
    local: bool
    notes: tuple[str, ...] = ()

    def to_camera(self, T_chunk_cam: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """The camera's pose, world to camera, without scale."""
        T_world_cam = np.eye(4)
        T_world_cam[:3, :3] = self.rotation @ T_chunk_cam[:3, :3]
        T_world_cam[:3, 3] = self.scale * self.rotation @ T_chunk_cam[:3, 3] + self.translation
        return np.linalg.inv(T_world_cam)


def _world(chunk: Element, component: str | None) -> _World:
    """The transform of the cameras' component, or else the chunk's; of a georeferenced chunk only its scale."""
    own = [e for e in chunk.descendants("component") if e.attributes.get("id") == component]
    transform = (own[0].find("transform") if own else None) or chunk.find("transform")
    reference = chunk.find("reference")
    system = reference.text.strip() if reference is not None else ""
    if transform is None or transform.find("scale") is None:
        note = "the chunk has no scale: its unit is arbitrary, unless --unit says what it is"
        return _World(rotation=np.eye(3), translation=np.zeros(3), scale=1.0, unit_m=None, local=True, notes=(note,))
    scale = transform.value("scale")
    if scale <= 0:
        raise transform.error("a scale above 0", scale)
    translation = np.zeros(3) if (e := transform.find("translation")) is None else e.numbers(3)
    geocentric = abs(float(np.linalg.norm(translation)) - _EARTH_M) < _EARTH_TOLERANCE_M
    if geocentric or (system and not system.upper().startswith("LOCAL_CS")):
        note = (
            f"the chunk is georeferenced ({system[:40] or 'geocentric'}): its own frame times its scale is used, in m"
        )
        return _World(rotation=np.eye(3), translation=np.zeros(3), scale=scale, unit_m=1.0, local=False, notes=(note,))
    found = _UNIT.search(system)
    rotation = np.eye(3) if (e := transform.find("rotation")) is None else e.numbers(9).reshape(3, 3)
    check_rotation(rotation, transform.refuse(), "rotation")
    unit = float(found[1]) if found else 1.0
    return _World(rotation=rotation, translation=translation, scale=scale, unit_m=unit, local=True)


def _main_component(cameras: Sequence[Element]) -> tuple[str | None, list[str]]:
    """The component with most aligned cameras, None without components; labels of the aligned cameras in others."""
    aligned = [c for c in cameras if c.find("transform") is not None and "component_id" in c.attributes]
    members: dict[str, list[str]] = {}
    for camera in aligned:
        members.setdefault(camera.attributes["component_id"], []).append(camera.attributes.get("label", "?"))
    if not members:
        return None, []
    main = max(members, key=lambda name: len(members[name]))
    return main, [label for name, labels in members.items() if name != main for label in labels]


def _camera_pose(camera: Element, cameras: dict[str, Element]) -> Float[np.ndarray, "4 4"] | None:
    """The pose of a camera, or of its master, camera to chunk; None if it is not aligned."""
    transform = camera.find("transform")
    if transform is None:
        master = cameras.get(camera.attributes.get("master_id", ""))
        if master is None or master is camera:
            return None
        transform = master.find("transform")
        if transform is None:
            return None
    T = transform.numbers(16).reshape(4, 4)
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise transform.error("0 0 0 1 as the last row: 16 numbers by rows", T[3].tolist())
    check_rotation(T[:3, :3], transform.refuse(), "transform")
    return T


def _lens(sensor: Element) -> Lens:
    resolution = sensor.need("resolution")
    width_px = resolution.pixels(resolution.attribute("width"))
    height_px = resolution.pixels(resolution.attribute("height"))
    found = sensor.all("calibration")
    if not found:
        raise sensor.error("a <calibration>", "none", "export the cameras after the alignment")
    adjusted = [e for e in found if e.attributes.get("class") == "adjusted"]
    calibration = (adjusted or found)[-1]
    kind = calibration.attributes.get("type", sensor.attributes.get("type", "frame"))
    K, distortion = _intrinsics(calibration, kind, width_px, height_px)
    return Lens(
        width_px=width_px,
        height_px=height_px,
        intrinsics=K,
        distortion=distortion,
        T_master_slave=_slave(sensor),
    )


def _intrinsics(
    calibration: Element, kind: str, width_px: int, height_px: int
) -> tuple[Float[np.ndarray, "3 3"], Distortion]:
    if kind != "frame" and kind not in _FISHEYES:
        raise calibration.error(f"a camera of type frame, {', '.join(_FISHEYES)}", kind, _TO_COLMAP)
    if calibration.find("f") is None and calibration.find("fx") is not None:
        got = "fx and fy, of PhotoScan 1.1 or older, whose other coefficients mean something else"
        raise calibration.error("a focal length f", got, "open the project in a newer version and export it again")
    if calibration.find("corrections") is not None:
        raise calibration.error("no additional corrections", "<corrections>", _TO_COLMAP)
    size = calibration.find("resolution")
    if size is not None:
        stated = (size.pixels(size.attribute("width")), size.pixels(size.attribute("height")))
        if stated != (width_px, height_px):
            raise size.error(f"the sensor's resolution {width_px} x {height_px}", f"{stated[0]} x {stated[1]}")
    f = calibration.value("f")
    if f <= 0:
        raise calibration.error("a focal length above 0 px", f)
    b1, b2 = calibration.value("b1", 0.0), calibration.value("b2", 0.0)
    cx, cy = width_px / 2 + calibration.value("cx", 0.0), height_px / 2 + calibration.value("cy", 0.0)
    k = [calibration.value(f"k{i}", 0.0) for i in range(1, 5)]
    p = [calibration.value(f"p{i}", 0.0) for i in range(1, 5)]
    K = np.array([[f + b1, b2, cx], [0, f, cy], [0, 0, 1]])
    if kind in _FISHEYES:
        return K, Distortion(model=_FISHEYES[kind], coefficients=(*k, *p))
    return K, brown_lens(k, p)


def _slave(sensor: Element) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    if (rotation := sensor.find("rotation")) is not None:
        T[:3, :3] = rotation.numbers(9).reshape(3, 3)
        check_rotation(T[:3, :3], rotation.refuse(), "rotation")
    if (location := sensor.find("location")) is not None:
        T[:3, 3] = location.numbers(3)
    return T


def only_chunk(chunks: Sequence[Element], error: InputError) -> Element:
    """Return the enabled chunk. Raises `error` if there is none, and another InputError if there are several."""
    enabled = [chunk for chunk in chunks if chunk.attributes.get("enabled", "true") in ("true", "1")]
    if not enabled:
        raise error
    if len(enabled) > 1:
        labels = ", ".join(chunk.attributes.get("label", "?") for chunk in enabled)
        raise enabled[1].error("one enabled chunk", labels, "disable the other chunks, or export the cameras of one")
    return enabled[0]
