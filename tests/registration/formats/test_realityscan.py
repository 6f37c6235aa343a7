"""RealityScan's CSV and XMP files: directions and pixels worked out by hand, and damaged files."""

import re
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from registration.formats.reality_csv import rotation
from registration.formats.registry import detect_format, read_source
from registration.formats.source import ReadOptions, SourceCapture
from tests.registration.formats.projecting import image, project

HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
# 400 x 300 px: f = 18 / 36 * 400 = 200 px, the principal point at (200 + 4, 150 - 8)
ROW = "east.jpg,1,2,3,90,90,0,18,0.01,-0.02,0,0,0,0,0,0"
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" xcr:Coordinates="absolute"
 xcr:DistortionModel="perspective" xcr:FocalLength35mm="18" xcr:Skew="0" xcr:AspectRatio="1"
 xcr:PrincipalPointU="0.01" xcr:PrincipalPointV="-0.02">
<xcr:Rotation>0 -1 0 0 0 -1 1 0 0</xcr:Rotation><xcr:Position>1 2 3</xcr:Position>
<xcr:DistortionCoeficients>0 0 0 0 0 0</xcr:DistortionCoeficients>
</rdf:Description></rdf:RDF></x:xmpmeta>"""


def csv(folder: Path, *lines: str) -> SourceCapture:
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n", "utf-8")
    image(folder / "east.jpg", 400, 300)
    return read_source(folder, ReadOptions(), name="realityscan_csv")


def xmp(folder: Path, *replaced: tuple[str, str]) -> SourceCapture:
    text = XMP
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "east.xmp").write_text(text, "utf-8")
    image(folder / "east.jpg", 400, 300)
    return read_source(folder, ReadOptions(), name="realityscan_xmp")


def test_a_camera_that_looks_east(tmp_path: Path) -> None:
    """Heading 90 degrees from north (y), pitch 90 up from straight down: along +x; south is right, z is up."""
    view = csv(tmp_path, HEADER, ROW).views[0]
    assert detect_format(tmp_path).name == "realityscan_csv"
    np.testing.assert_allclose(project(view, 11, 2, 3), [204, 142], atol=1e-9)
    np.testing.assert_allclose(project(view, 11, 1, 3), [224, 142], atol=1e-9)  # 1 m south at 10 m: 20 px to the right
    np.testing.assert_allclose(project(view, 11, 2, 4), [204, 122], atol=1e-9)  # 1 m higher


def test_angles_of_zero_look_down_with_north_on_top() -> None:
    np.testing.assert_allclose(rotation((0, 0, 0)), [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-15)
    np.testing.assert_allclose(rotation((90, 0, 0))[1], [-1, 0, 0], atol=1e-15)  # turned clockwise: east on top
    np.testing.assert_allclose(rotation((0, 0, 90))[2], [-1, 0, 0], atol=1e-15)  # rolled to the left


def test_the_sidecar_is_the_same_camera_as_the_row(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir(), (tmp_path / "b").mkdir()
    row, sidecar = csv(tmp_path / "a", HEADER, ROW).views[0], xmp(tmp_path / "b").views[0]
    assert detect_format(tmp_path / "b").name == "realityscan_xmp"
    np.testing.assert_allclose(sidecar.T_cam_world, row.T_cam_world, atol=1e-12)
    np.testing.assert_allclose(sidecar.intrinsics, row.intrinsics, atol=1e-12)


def test_the_documented_pose_looks_where_its_third_row_says(tmp_path: Path) -> None:
    """The pose of "RealityCapture XMP camera math": R Position + t = 0, rows are the camera's axes."""
    rows = (
        "-0.600806990019897 0.799386597570746 -0.00346819369376912 -0.210825371930633 -0.162635135620312 "
        "-0.963899618846316 -0.771092486861039 -0.578386445454965 0.266243303052733"
    )
    centre = np.array([2111.44219951044, 1607.86624656544, 2302.25896526736])
    view = xmp(tmp_path, ("0 -1 0 0 0 -1 1 0 0", rows), ("1 2 3<", " ".join(map(str, centre)) + "<")).views[0]
    ahead = centre + 5 * np.array([-0.771092486861039, -0.578386445454965, 0.266243303052733])
    np.testing.assert_allclose(project(view, *ahead), [204, 142], atol=1e-6)


def test_brown_has_t1_along_x_and_k4(tmp_path: Path) -> None:
    coefficients = "0.1 -0.05 0.02 0.01 0.001 -0.002"
    view = xmp(tmp_path, ("perspective", "brown4t2"), ("0 0 0 0 0 0", coefficients)).views[0]
    # of x = 0.2, y = 0.1: r^2 = 0.05, radial 1.0048775625, tangential 0.00005 and -0.0001
    expected = [204 + 200 * (0.2 * 1.0048775625 + 0.00005), 142 + 200 * (0.1 * 1.0048775625 - 0.0001)]
    local = np.array([0.2, 0.1, 1.0])
    point = view.T_cam_world[:3, :3].T @ (local - view.T_cam_world[:3, 3])
    np.testing.assert_allclose(project(view, *point), expected, atol=1e-9)


def test_division_distorts_image_coordinates(tmp_path: Path) -> None:
    """Undistorted = distorted / (1 + k r^2), in units of the longer side, from the middle of the image."""
    source = xmp(tmp_path, ("perspective", "division"), ("0 0 0 0 0 0", "-0.25 0 0 0 0 0"))
    assert any("division model" in note for note in source.notes)
    view = source.views[0]
    distorted = np.array([0.3, 0.2])  # r^2 = 0.13, 1 + k r^2 = 0.9675
    undistorted = distorted / 0.9675
    plane = (undistorted - [0.01, -0.02]) / 0.5
    point = view.T_cam_world[:3, :3].T @ ([*plane, 1.0] - view.T_cam_world[:3, 3])
    np.testing.assert_allclose(project(view, *point), [200 + 400 * 0.3, 150 + 400 * 0.2], atol=1e-9)


def test_names_of_version_2_and_cameras_without_photographs(tmp_path: Path) -> None:
    header = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
    source = csv(tmp_path, "#cameras 2", header, ROW, ROW.replace("east", "west"))
    assert [view.name for view in source.views] == ["east"] and source.unit_m is None
    assert any("west.jpg" in note for note in source.notes)
    np.testing.assert_allclose(project(source.views[0], 11, 2, 3), [204, 142], atol=1e-9)


@pytest.mark.parametrize(
    ("lines", "part"),
    [
        ((HEADER,), "none"),
        ((HEADER, ROW, ROW + ",1"), "17 in line 3"),
        ((HEADER, ROW.replace(",18,", ",wide,")), "line 2: f"),
        ((HEADER, ROW.replace(",18,", ",-18,")), "above 0"),
        ((HEADER, ROW.replace("0.01", "212")), "line 2: px"),
        ((HEADER, ROW.replace("east", "nobody")), "nobody.jpg"),
        (("#name,x,y,alt", "east.jpg,1,2,3"), "without heading, pitch, roll, f"),
        (("#cameras 3", HEADER, ROW), "cut off"),
    ],
)
def test_damaged_rows_are_refused_with_the_line(lines: tuple[str, ...], part: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(part)):
        csv(tmp_path, *lines)


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("absolute", "relative", "of a rig"),
        ("perspective", "rationalP2D1", "rationalP2D1"),
        ("0 -1 0 0 0 -1 1 0 0", "0 -1 0 0 0 -1 1 0", "9 numbers"),
        ("0 -1 0 0 0 -1 1 0 0", "0 1 0 0 0 -1 1 0 0", "determinant -1"),
        ('xcr:FocalLength35mm="18"', "", "FocalLength35mm"),
        ("0 0 0 0 0 0", "0.1 0 0 0 0 0", "perspective does not have"),
        ("<xcr:Rotation>0 -1 0 0 0 -1 1 0 0</xcr:Rotation><xcr:Position>1 2 3</xcr:Position>", "", "has a pose"),
        ("<xcr:Position>1 2 3</xcr:Position>", "", "3 numbers"),
        ("</rdf:RDF>", "", "line 7"),
    ],
)
def test_damaged_sidecars_are_refused(old: str, new: str, part: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(part)):
        xmp(tmp_path, (old, new))
