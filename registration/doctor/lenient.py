"""Read captures whose description is faulty in a known way, so that the checks can say what else is wrong."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from registration.capture import native
from registration.capture.headers import read_header
from registration.capture.image_names import image_file, nearest_image
from registration.capture.settings import UNITS_M, CaptureSettings
from registration.capture.text import listed
from registration.capture.triangulation import triangulate
from registration.doctor.findings import Finding
from registration.doctor.fixes import CameraFix, RenameFix, TurnFix, UnitEntryFix
from registration.doctor.rig_checks import LandmarkWitness
from registration.doctor.size_checks import EYE_DISTANCE_M, eye_distance
from registration.errors import InputError
from registration.storage.image_files import FORMATS
from registration.types import Camera, Capture

_RESIZED = 0.02  # relative difference of two sizes
_CENTRED = 0.12  # of the image's side: distance of a principal point from the middle
_EXIF_ORIENTATION = 274
_TURNED = (6, 8)  # EXIF's orientations of images that lie on their sides
_SURE, _APART = 0.85, 0.3  # share of landmarks that agree with cameras that are turned one way, and less the other way


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What could be read of a capture."""

    capture: Capture | None  # as it would be with the mends; None: the checks cannot go on
    findings: list[Finding]


def read_leniently(root: Path) -> Reading:
    """Read a native capture folder; a fault becomes a finding and, where its mend is known, is mended in memory."""
    findings: list[Finding] = []
    try:
        return Reading(capture=native.read_capture(root), findings=findings)
    except InputError as error:
        first = error
    if not root.is_dir():
        return Reading(capture=None, findings=[Finding.of_error(first, "capture")])
    settings = _settings(root, findings)
    try:
        cameras = native.read_calibration(root)
    except InputError as error:
        return Reading(capture=None, findings=[*findings, Finding.of_error(error, "calibration")])
    cameras = _named_images(root, cameras, findings)
    if settings is None or any(finding.kind == "image-names" for finding in findings):
        return Reading(capture=None, findings=findings)
    cameras = _sizes(root, settings, cameras, findings)
    if any(finding.kind == "image-turned" and not isinstance(finding.fix, CameraFix) for finding in findings):
        return Reading(capture=None, findings=findings)
    try:
        capture = native.assemble(root, settings, cameras)
    except InputError as error:
        return Reading(capture=None, findings=[*findings, Finding.of_error(error, "file")])
    if settings.units != "m":
        findings.insert(0, unit := _unit_entry(capture, settings))
        capture = unit.fix.on_capture(capture) if unit.fix is not None else capture
    return Reading(capture=capture, findings=findings)


def _settings(root: Path, findings: list[Finding]) -> CaptureSettings | None:
    try:
        return native.read_leniently(root)
    except InputError as error:
        findings.append(Finding.of_error(error, "settings"))
        return None


def _unit_entry(capture: Capture, settings: CaptureSettings) -> Finding:
    """Another unit in capture.toml. Landmarks tell whether the world is in it, or in metres all the same."""
    factor = UNITS_M.get(settings.units.lower())
    distance = eye_distance(triangulate(capture, "68")[0])
    metres = distance is not None and EYE_DISTANCE_M[0] <= distance <= EYE_DISTANCE_M[1]
    fix: UnitEntryFix | None = None
    if distance is not None or factor == 1:  # a world in another unit is found by the landmarks
        fix = UnitEntryFix(what='wrote units = "m" into capture.toml')
    elif factor is not None:
        what = f"scaled cameras, scan and ground truth by {factor:g}, as the unit says"
        fix = UnitEntryFix(what=what, scale=factor)
    size = "nothing tells the size" if distance is None else f"outer eye corners {distance:.3g} apart"
    by = f"scale the COLMAP model, the scan and the ground truth by {factor:g}, and " if factor not in (None, 1) else ""
    return Finding(
        kind="unit-entry",
        severity="error",
        where=str(capture.root / "capture.toml"),
        believed="The units are not metres",
        expected='units = "m", and a world in metres',
        evidence=f"{settings.units or 'no units'}; {size}{', as in metres' if metres else ''}",
        mend=f'{"" if metres else by}write units = "m"; see docs/formats.md',
        fix=fix,
    )


def _named_images(root: Path, cameras: Mapping[str, Camera], findings: list[Finding]) -> dict[str, Camera]:
    """The cameras whose images are there; others are findings."""
    kept, names = {}, {}
    missing: list[InputError] = []
    for name, camera in cameras.items():
        try:
            path = root / "images" / image_file(root, name)
            read_header(path, "image")
            kept[name] = camera
        except InputError as error:
            near = nearest_image(root / "images", name) if "\0" not in name else None
            if near is None or (root / "images" / name).exists():
                findings.append(Finding.of_error(error, "image-missing"))
            else:
                names[f"images/{near}"] = f"images/{name}"
                missing.append(error)
    if missing:
        plain = not any("\\" in new or ".." in new or new.startswith("images//") for new in names.values())
        unique = len(set(names)) == len(missing) and plain
        fix = RenameFix(what=f"renamed {len(names)} images as the COLMAP model names them", names=names)
        found = Finding.of_error(missing[0], "image-names", fix if unique else None)
        findings.append(replace(found, evidence=f"{found.evidence}; {len(missing)} images"))
    return kept


def _sizes(
    root: Path, settings: CaptureSettings, cameras: dict[str, Camera], findings: list[Finding]
) -> dict[str, Camera]:
    """The cameras for the images as they are stored; each group of images of another size is a finding."""
    groups: dict[tuple[int, int, int, int], list[str]] = {}
    for name, camera in cameras.items():
        header = read_header(root / "images" / image_file(root, name), "image")
        if (header.width_px, header.height_px) != (camera.width_px, camera.height_px):
            key = (camera.width_px, camera.height_px, header.width_px, header.height_px)
            groups.setdefault(key, []).append(name)
    for (width, height, stored_width, stored_height), names in groups.items():
        turned = (stored_width, stored_height) == (height, width)
        if turned:
            finding = _turned(root, settings, cameras, names)
        else:
            finding = _resized(root, cameras, names, (stored_width, stored_height))
        findings.append(finding)
        if isinstance(finding.fix, CameraFix):
            cameras = {**cameras, **{name: finding.fix.change(cameras[name]) for name in names}}
        elif not turned:  # left out
            cameras = {name: camera for name, camera in cameras.items() if name not in names}
    return cameras


def _resized(root: Path, cameras: Mapping[str, Camera], names: list[str], size: tuple[int, int]) -> Finding:
    """Images of another size: K is that of the size that the model says, or of the images' own."""
    camera = cameras[names[0]]
    given, point = np.array([camera.width_px, camera.height_px]), camera.intrinsics[:2, 2]
    of_model, of_images = (float(np.abs(point / side - 0.5).max()) for side in (given, np.array(size)))
    scale = size[0] / given[0]
    resized = abs(scale - 1) > _RESIZED and abs(size[1] - scale * given[1]) <= max(1.0, scale)  # else it is cropped
    fix, mend = None, "store the image at the size of the calibrated image, or rescale the camera in the COLMAP model"
    if of_images <= _CENTRED < of_model:
        mend = f"write {size[0]} x {size[1]} px into the COLMAP model: K is for images of this size"
        fix = CameraFix(
            what=f"wrote the size of the images into {len(names)} cameras; K was right",
            change=lambda camera: replace(camera, width_px=size[0], height_px=size[1]),
            views=_stems(names),
        )
    elif of_model <= _CENTRED and resized:
        mend = f"multiply fx, fy, cx and cy by {scale:.4g}, and write {size[0]} x {size[1]} px"
        fix = CameraFix(
            what=f"scaled {len(names)} cameras to the size of their images",
            change=lambda camera: camera.scaled(*size),
            views=_stems(names),
        )
    return Finding(
        kind="image-size",
        severity="error",
        where=str(root / "images" / names[0]),
        believed="The image's size is not the camera's",
        expected=f"{given[0]} x {given[1]} px, as the COLMAP model says",
        evidence=f"{size[0]} x {size[1]} px; the principal point is {point[0]:.0f}, {point[1]:.0f}"
        + _in_all(names, cameras),
        mend=mend,
        fix=fix,
    )


def _turned(root: Path, settings: CaptureSettings, cameras: Mapping[str, Camera], names: list[str]) -> Finding:
    """Images on their sides: as EXIF says, or with their landmarks, which then tell the way."""
    orientations = {name: _orientation(root / "images" / image_file(root, name)) for name in names}
    fix: CameraFix | TurnFix | None = _turned_cameras(root, settings, cameras, names)
    mend = "turn the cameras of the COLMAP model as the images, or store the images upright"
    if fix is not None:
        mend = "turn the cameras as the images: exchange fx and fy, cx and cy, and turn the rotation by 90 degrees"
    elif all(orientation in _TURNED for orientation in orientations.values()):
        mend = "store the images turned as their EXIF orientation says, as the calibration saw them"
        fix = TurnFix(what=f"turned {len(names)} images as their EXIF orientation says", orientations=orientations)
    camera = cameras[names[0]]
    return Finding(
        kind="image-turned",
        severity="error",
        where=str(root / "images" / names[0]),
        believed="The image lies on its side",
        expected=f"{camera.width_px} x {camera.height_px} px, as the COLMAP model says",
        evidence=f"{camera.height_px} x {camera.width_px} px; EXIF orientation {orientations[names[0]] or 'none'}"
        + _in_all(names, cameras),
        mend=mend,
        fix=fix,
    )


def _turned_cameras(
    root: Path, settings: CaptureSettings, cameras: Mapping[str, Camera], names: list[str]
) -> CameraFix | None:
    """Cameras turned so that the landmarks agree: these are in pixels of the images as stored."""
    agreements, fixes = [], []
    for quarter in (1, -1):
        turned = {name: turned_camera(cameras[name], quarter) if name in names else cameras[name] for name in cameras}
        try:
            capture = native.assemble(root, settings, turned)
        except InputError:
            return None
        if (witness := LandmarkWitness.of(capture)) is None:
            return None
        agreements.append(witness([view.camera for view in capture.views]))
        fixes.append(
            CameraFix(
                what=f"turned {len(names)} cameras as their images",
                change=lambda camera, quarter=quarter: turned_camera(camera, quarter),  # type: ignore[misc]
                views=_stems(names),
            )
        )
    best = int(np.argmax(agreements))
    return fixes[best] if agreements[best] >= _SURE and agreements[best] > min(agreements) + _APART else None


def turned_camera(camera: Camera, quarter: int) -> Camera:
    """The camera of an image that was turned by a quarter: 1 clockwise, -1 counterclockwise."""
    K, turn = camera.intrinsics, np.eye(4)
    turn[:2, :2] = [[0, -quarter], [quarter, 0]]
    cx, cy = (camera.height_px - K[1, 2], K[0, 2]) if quarter == 1 else (K[1, 2], camera.width_px - K[0, 2])
    k1, k2, p1, p2, *rest = camera.distortion or (0.0,) * 4
    return replace(
        camera,
        width_px=camera.height_px,
        height_px=camera.width_px,
        intrinsics=np.array([[K[1, 1], 0, cx], [0, K[0, 0], cy], [0, 0, 1.0]]),
        T_cam_world=turn @ camera.T_cam_world,
        distortion=(k1, k2, quarter * p2, -quarter * p1, *rest) if camera.distortion else (),
    )


def _orientation(path: Path) -> int:
    """The EXIF orientation of an image; 0 if it has none."""
    try:
        with Image.open(path, formats=FORMATS) as image:
            return int(image.getexif().get(_EXIF_ORIENTATION, 0))
    except Exception:  # a damaged file makes Pillow raise nearly anything
        return 0


def _stems(names: list[str]) -> list[str]:
    return [str(Path(name).with_suffix("")) for name in names]


def _in_all(names: list[str], cameras: Mapping[str, Camera]) -> str:
    return f"; {len(names)} of {len(cameras)} views: {listed(names, 3)}"
