"""BlocksExchange XML of ContextCapture and iTwin Capture, which Metashape also exports.

Bentley's description: rotations are world to camera, of axes that `CameraOrientation` names; centres are positions; the
principal point counts from the centre of the upper left pixel, so half a pixel is added; focal lengths are in px, or in
millimetres of a sensor whose longer side is known; distortion is Brown's, with p1 along x.
"""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from registration.formats.photogrammetry_lenses import brown_lens
from registration.formats.photographs import (
    Photographs,
    check_rotation,
    left_out,
    scan_beside,
    unique_views,
    world_to_camera,
)
from registration.formats.source import Distortion, Format, ReadOptions, SourceCapture, SourceView
from registration.formats.xml_files import Element, read_xml
from registration.formats.xml_head import need_xml_file, xml_file

_ROOT = "BlocksExchange"
_DIRECTIONS = {"Right": (1, 0), "Left": (-1, 0), "Down": (0, 1), "Up": (0, -1)}  # in OpenCV's axes
_ORIENTATIONS = tuple(
    f"X{x}Y{y}" for x in _DIRECTIONS for y in _DIRECTIONS if (x in ("Right", "Left")) != (y in ("Right", "Left"))
)
_TO_LOCAL = "export the block in a local coordinate system"


def _detect(path: Path) -> bool:
    return xml_file(path, _ROOT) is not None


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read the photographs of a block.

    Raises:
        InputError: the file is malformed, has several blocks, is in geographic coordinates, has a fisheye or spherical
            camera, no photograph has a whole pose, or an image is missing.
    """
    file = need_xml_file(path, _ROOT)
    root = read_xml(file)
    if root.name != _ROOT:
        raise root.error(f"the element <{_ROOT}>", f"<{root.name}>")
    blocks = root.all("Block")
    if len(blocks) != 1:
        raise root.error("one <Block>", f"{len(blocks)}", "export one block")
    unit_m, notes = _system(root, blocks[0])
    photographs = Photographs(file.parent)
    unposed: list[str] = []
    found: list[tuple[Element, Element]] = []
    for group in blocks[0].need("Photogroups").all("Photogroup"):
        _check_system(blocks[0], group)
        for photo in group.all("Photo"):
            if photo.find("Pose/Rotation") is None or photo.find("Pose/Center") is None:
                unposed.append(photo.need("ImagePath").text.strip())
            else:
                found.append((group, photo))
    if not found:
        raise blocks[0].error("a photograph with <Rotation> and <Center>", f"{len(unposed)} without")
    images = [_image(photographs, photo) for _, photo in found]
    names = unique_views(images, file.parent)
    views = tuple(
        _view(name, image, group, photo, photographs)
        for name, image, (group, photo) in zip(names, images, found, strict=True)
    )
    return SourceCapture(
        format=FORMAT.name,
        root=file.parent,
        subject=options.subject or file.parent.resolve().name,
        expression=options.expression or "neutral",
        views=views,
        unit_m=unit_m,
        scan=scan_beside(file.parent),
        notes=(*notes, *left_out(unposed, "without a whole pose")),
    )


def _system(root: Element, block: Element) -> tuple[float | None, tuple[str, ...]]:
    """Metres per unit of a block's coordinate system, and notes."""
    chosen = block.find("SRSId")
    if chosen is None:
        return None, ("the block is in a local coordinate system, whose unit the file does not state",)
    systems = {e.need("Id").text.strip(): e for e in root.descendants("SRS")}
    if chosen.text.strip() not in systems:
        raise chosen.error("the <Id> of an <SRS>", chosen.text.strip())
    definition = systems[chosen.text.strip()].need("Definition")
    text = definition.text.strip()
    if text.upper().startswith(("ENU:", "LOCAL_CS")):
        return 1.0, ()
    if text.upper().startswith("LOCAL"):
        return None, ("the block is in a local coordinate system, whose unit the file does not state",)
    raise definition.error("a local coordinate system, as ENU:LATITUDE,LONGITUDE", text[:60], _TO_LOCAL)


def _check_system(block: Element, group: Element) -> None:
    own, common = group.find("SRSId"), block.find("SRSId")
    if own is not None and own.text.strip() != (common.text.strip() if common is not None else ""):
        raise own.error("one coordinate system for all photographs", own.text.strip(), _TO_LOCAL)


def _image(photographs: Photographs, photo: Element) -> Path:
    path = photo.need("ImagePath")
    return photographs.find(path.text.strip(), path.refuse(), "ImagePath")


def _view(name: str, image: Path, group: Element, photo: Element, photographs: Photographs) -> SourceView:
    size = group.need("ImageDimensions")
    width_px, height_px = (size.need(side).pixels(size.need(side).text) for side in ("Width", "Height"))
    axes = _axes(group)
    R = axes.T @ _rotation(photo.need("Pose/Rotation"))
    mask = photo.find("MaskPath")
    centre = photo.need("Pose/Center")
    return SourceView(
        name=name,
        image=image,
        width_px=width_px,
        height_px=height_px,
        intrinsics=_intrinsics(group, width_px, height_px, axes),
        T_cam_world=world_to_camera(R, np.array([centre.value(axis) for axis in "xyz"])),
        distortion=_distortion(group),
        mask=photographs.mask(image) if mask is None else _mask(photographs, mask),
    )


def _mask(photographs: Photographs, element: Element) -> Path:
    if (path := photographs.find_mask(element.text.strip())) is None:
        raise element.error("an existing mask", element.text.strip())
    return path


def _axes(group: Element) -> Float[np.ndarray, "3 3"]:
    """Rows: the camera's axes in OpenCV's. A third axis makes them right-handed."""
    element = group.find("CameraOrientation")
    name = element.text.strip() if element is not None else "XRightYDown"
    if name not in _ORIENTATIONS:
        raise (element or group).error(f"one of {', '.join(_ORIENTATIONS)}", name)
    x, _, y = name.removeprefix("X").partition("Y")
    rows = np.array([(*_DIRECTIONS[x], 0), (*_DIRECTIONS[y], 0)], np.float64)
    return np.vstack([rows, np.cross(*rows)])


def _rotation(element: Element) -> Float[np.ndarray, "3 3"]:
    """The rotation from world to the camera's axes."""
    if element.find("M_00") is not None:
        R = np.array([[element.value(f"M_{i}{j}") for j in range(3)] for i in range(3)])
        check_rotation(R, element.refuse(), "Rotation")
        return R
    if element.find("Omega") is not None:
        omega, phi, kappa = (element.value(angle) for angle in ("Omega", "Phi", "Kappa"))
        return Rotation.from_euler("XYZ", (omega, phi, kappa), degrees=True).as_matrix().T
    got = ", ".join(child.name for child in element.children) or "nothing"
    raise element.error("M_00 to M_22, or Omega, Phi and Kappa", got, "export rotations as matrices")


def _intrinsics(
    group: Element, width_px: int, height_px: int, axes: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    kind = group.find("CameraModelType")
    if kind is not None and kind.text.strip() != "Perspective":
        raise kind.error("Perspective", kind.text.strip(), "undistort the photographs, or export to COLMAP")
    px_per_mm = _px_per_mm(group, max(width_px, height_px))
    if group.find("FocalLengthPixels") is not None:
        f = group.value("FocalLengthPixels")
    elif px_per_mm is not None:
        f = group.value("FocalLength") * px_per_mm
    else:
        raise group.error("FocalLengthPixels, or FocalLength with SensorSize or PixelSize", "neither")
    aspect = group.value("AspectRatio", 1.0)
    if not (f > 0 and aspect > 0 and math.isfinite(f * aspect)):
        raise group.error("a focal length and an aspect ratio above 0", f"{f}, {aspect}")
    cx, cy = width_px / 2, height_px / 2
    point = group.find("PrincipalPoint")
    if point is not None and point.find("x") is not None:
        cx, cy = point.value("x") + 0.5, point.value("y") + 0.5
    elif point is not None:
        if px_per_mm is None:
            raise point.error("SensorSize or PixelSize with xmm and ymm", "neither")
        offset = axes[:2, :2].T @ [point.value("xmm"), point.value("ymm")]
        cx, cy = cx + offset[0] * px_per_mm, cy + offset[1] * px_per_mm
    return np.array([[f, group.value("Skew", 0.0), cx], [0, f * aspect, cy], [0, 0, 1]])


def _px_per_mm(group: Element, longer_px: int) -> float | None:
    for name, divide in (("PixelSize", False), ("SensorSize", True)):
        if (element := group.find(name)) is not None:
            if (value := element.number()) <= 0:
                raise element.error("a size above 0 mm", value)
            return longer_px / value if divide else 1 / value
    return None


def _distortion(group: Element) -> Distortion:
    element = group.find("Distortion")
    if element is None:
        return Distortion(model="none")
    k = [element.value(f"K{i}", 0.0) for i in range(1, 4)]
    p = [element.value(f"P{i}", 0.0) for i in range(1, 3)]
    direct = element.find("Direct")
    if direct is not None and direct.text.strip().lower() == "false":
        raise direct.error(
            "coefficients from undistorted to distorted points", "inverse ones", "undistort the photographs"
        )
    return brown_lens(k, p)


FORMAT = Format(
    name="blocks_exchange",
    title="BlocksExchange XML",
    files=f"an XML file with <{_ROOT}>",
    detect=_detect,
    read=read,
)
