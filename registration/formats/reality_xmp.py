"""XMP sidecars that RealityScan or RealityCapture exported: `IMAGE.xmp` beside `IMAGE.jpg`.

`Rotation` is world to camera by rows with OpenCV's axes, `Position` the camera's centre.
"""

from collections.abc import Sequence
from pathlib import Path

from registration.errors import InputError
from registration.formats.files import stored_size
from registration.formats.photographs import (
    Photographs,
    check_rotation,
    left_out,
    scan_beside,
    unique_views,
    world_to_camera,
)
from registration.formats.reality_camera import MODELS, Calibration, distortion, intrinsics
from registration.formats.source import Format, ReadOptions, SourceCapture, SourceView
from registration.formats.xml_files import Element, parse_numbers, read_xml

_XCR = "http://www.capturingreality.com/ns/xcr/1.1# "
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns# "
_MARK = b"http://www.capturingreality.com/ns/xcr/"
_HEAD_BYTES = 4096
_FIX = "export the cameras' XMP files from RealityScan again, with poses and calibration"
_COEFFICIENTS = ("DistortionCoeficients", "DistortionCoefficients")  # the first is the program's spelling


def _detect(path: Path) -> bool:
    return bool(_sidecars(path))


def _sidecars(path: Path) -> list[Path]:
    """The sidecars in a folder, or in its folder `images`."""
    for folder in (path, path / "images"):
        found = [file for file in sorted(folder.glob("*.xmp")) if _is_ours(file)] if folder.is_dir() else []
        if found:
            return found
    return []


def _is_ours(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return _MARK in stream.read(_HEAD_BYTES)
    except OSError:
        return False


def read(path: Path, options: ReadOptions) -> SourceCapture:
    """Read the sidecars in a folder.

    Raises:
        InputError: there are none, one is malformed or has no image, a lens is unknown, poses are relative, or no
            camera has a pose.
    """
    sidecars = _sidecars(path)
    if not sidecars:
        raise InputError(
            "There are no XMP sidecars", where=path, expected="a folder with IMAGE.xmp files", got="none", fix=_FIX
        )
    folder = sidecars[0].parent
    photographs = Photographs(folder)
    posed: list[tuple[Path, Element]] = []
    without: list[str] = []
    for file in sidecars:
        description = _description(file)
        if _text(description, "Rotation") is None and _text(description, "Position") is None:
            without.append(file.name)
        else:
            posed.append((file, description))
    if not posed:
        got = f"{len(without)} without Rotation and Position"
        raise InputError("No camera has a pose", where=folder, expected="poses in the XMP files", got=got, fix=_FIX)
    images = [photographs.find(file.stem, d.refuse(_FIX), file.name) for file, d in posed]
    names = unique_views(images, folder)
    views = tuple(
        _view(name, image, d, photographs.mask(image)) for name, image, (_, d) in zip(names, images, posed, strict=True)
    )
    notes = ["the files do not state the world's unit", *left_out(without, "without a pose")]
    if any(view.distortion.model == "realityscan_division" for view in views):
        notes.append("the division model was taken for distorted / (1 + k r^2): compare with undistorted images once")
    return SourceCapture(
        format=FORMAT.name,
        root=folder,
        subject=options.subject or path.resolve().name,
        expression=options.expression or "neutral",
        views=views,
        unit_m=None,
        scan=scan_beside(path),
        notes=tuple(notes),
    )


def _description(file: Path) -> Element:
    root = read_xml(file)
    found = [root] if root.name == _RDF + "Description" else list(root.descendants(_RDF + "Description"))
    ours = [d for d in found if any(name.startswith(_XCR) for name in (*d.attributes, *(c.name for c in d.children)))]
    if len(ours) != 1:
        raise root.error("one <rdf:Description> with xcr: values", f"{len(ours)}", _FIX)
    return ours[0]


def _text(description: Element, *names: str) -> str | None:
    """A value, which is an attribute or a child element; versions differ."""
    for name in names:
        if (value := description.attributes.get(_XCR + name)) is not None:
            return value
        if found := description.all(_XCR + name):
            if len(found) > 1:
                raise found[1].error(f"xcr:{name} once", f"another one in line {found[0].line}", _FIX)
            return found[0].text
    return None


def _numbers(description: Element, names: Sequence[str], count: int, default: str | None = None) -> list[float]:
    text = _text(description, *names)
    if text is None and (text := default) is None:
        raise description.error(f"xcr:{names[0]}", "none", _FIX)
    try:
        return parse_numbers(text, count, description).tolist()
    except InputError as error:
        raise description.error(f"xcr:{names[0]}: {error.expected}", error.got, _FIX) from None


def _view(name: str, image: Path, description: Element, mask: Path | None) -> SourceView:
    system = _text(description, "Coordinates") or "absolute"
    if system != "absolute":
        raise description.error('xcr:Coordinates "absolute"', system, "export absolute poses, not those of a rig")
    model = _text(description, "DistortionModel") or "perspective"
    if model not in MODELS:
        raise description.error(f"xcr:DistortionModel {', '.join(MODELS)}", model, _FIX)
    width_px, height_px = stored_size(image)
    default = "0 0 0 0 0 0" if model == "perspective" else None
    calibration = Calibration(
        focal_35mm=_numbers(description, ["FocalLength35mm"], 1)[0],
        px=_numbers(description, ["PrincipalPointU"], 1, "0")[0],
        py=_numbers(description, ["PrincipalPointV"], 1, "0")[0],
        aspect=_numbers(description, ["AspectRatio"], 1, "1")[0],
        skew=_numbers(description, ["Skew"], 1, "0")[0],
        model=model,
        coefficients=_coefficients(description, model, default),
    )
    if calibration.focal_35mm <= 0 or calibration.aspect <= 0:
        got = f"{calibration.focal_35mm} and {calibration.aspect}"
        raise description.error("xcr:FocalLength35mm and xcr:AspectRatio above 0", got, _FIX)
    R = parse_numbers(_text(description, "Rotation") or "", 9, description).reshape(3, 3)
    check_rotation(R, description.refuse(_FIX), "Rotation")
    centre = parse_numbers(_text(description, "Position") or "", 3, description)
    return SourceView(
        name=name,
        image=image,
        width_px=width_px,
        height_px=height_px,
        intrinsics=intrinsics(calibration, width_px, height_px),
        T_cam_world=world_to_camera(R, centre),
        distortion=distortion(calibration),
        mask=mask,
    )


def _coefficients(description: Element, model: str, default: str | None) -> tuple[float, ...]:
    values = _numbers(description, _COEFFICIENTS, 6, default)
    used = {"perspective": 0, "division": 1, "brown3": 3, "brown4": 4}.get(model, 6)
    unused = [*values[used:]] if model != "brown3t2" else [values[3]]
    if any(unused):
        expected = f"xcr:DistortionCoeficients k1 k2 k3 k4 t1 t2 with 0 for those that {model} does not have"
        raise description.error(expected, values, _FIX)
    return tuple(values)


FORMAT = Format(
    name="realityscan_xmp",
    title="RealityScan or RealityCapture XMP sidecars",
    files="IMAGE.xmp files with xcr: values beside the images",
    detect=_detect,
    read=read,
)
