"""BlocksExchange XML against the sample in Bentley's description, and damaged files."""

import re
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from registration.formats.registry import detect_format, read_source
from registration.formats.source import ReadOptions, SourceCapture
from tests.registration.formats.projecting import image, project

# The numbers are those of the sample "Paris 2012"; its images are 9420 x 14430 px, here a twelfth of an image suffices
# because sizes are compared only when it is imported.
MATRIX = (
    "<M_00>-0.9999982912233401</M_00><M_01>-0.001636319085375301</M_01><M_02>-0.0008602425863163225</M_02>"
    "<M_10>-0.001631068695467463</M_10><M_11>0.9999802528616577</M_11><M_12>-0.00606906089589293</M_12>"
    "<M_20>0.0008701565192966738</M_20><M_21>-0.006067647409696231</M_21><M_22>-0.9999812130648239</M_22>"
)
ANGLES = "<Omega>179.6523471469934</Omega><Phi>0.04985630236313049</Phi><Kappa>179.9065465708369</Kappa>"
PIXELS = "<FocalLengthPixels>13991.05582</FocalLengthPixels>"
SENSOR = "<SensorSize>103.896</SensorSize><FocalLength>100.735601903992</FocalLength>"
POINT_PX = "<x>4683.755692</x><y>7223.0141002</y>"
POINT_MM = "<xmm>-0.1853590176</xmm><ymm>0.06130152144</ymm>"
XML = """<?xml version="1.0" encoding="utf-8"?>
<BlocksExchange version="2.1">
{systems}
<Block>{system}<Photogroups><Photogroup><ImageDimensions><Width>9420</Width><Height>14430</Height></ImageDimensions>
{focal}{orientation}<PrincipalPoint>{point}</PrincipalPoint>
<Distortion><K1>-0.001</K1><K2>0.0056</K2><K3>-0.0098</K3><P1>0.001</P1><P2>-0.002</P2></Distortion>
<Photo><Id>146</Id><ImagePath>D:\\data\\071_2810.jpg</ImagePath><Pose><Rotation>{rotation}</Rotation>
<Center><x>10</x><y>20</y><z>30</z></Center></Pose></Photo>
</Photogroup></Photogroups></Block></BlocksExchange>
"""


def read(folder: Path, **parts: str) -> SourceCapture:
    values = {"systems": "", "system": "", "focal": PIXELS, "orientation": "", "point": POINT_PX, "rotation": MATRIX}
    (folder / "block.xml").write_text(XML.format(**(values | parts)), "utf-8")
    image(folder / "071_2810.jpg", 8, 8)
    return read_source(folder, ReadOptions(), name="blocks_exchange")


def test_the_samples_alternatives_are_one_camera(tmp_path: Path) -> None:
    pixels = read(tmp_path)
    assert detect_format(tmp_path).name == "blocks_exchange" and pixels.unit_m is None
    other = read(tmp_path, focal=SENSOR, point=POINT_MM, rotation=ANGLES)
    a, b = pixels.views[0], other.views[0]
    # the description's own alternatives agree to its digits if the first pixel's centre is the origin: + 0.5 px
    np.testing.assert_allclose(b.intrinsics, a.intrinsics, atol=1e-3)
    np.testing.assert_allclose(a.intrinsics[:2, 2], [4684.255692, 7223.5141002], atol=1e-9)
    np.testing.assert_allclose(b.T_cam_world[:3, :3], a.T_cam_world[:3, :3], atol=1e-6)
    np.testing.assert_allclose(-a.T_cam_world[:3, :3].T @ a.T_cam_world[:3, 3], [10, 20, 30], atol=1e-9)


def test_a_point_projects_with_browns_model(tmp_path: Path) -> None:
    """Of x = 0.2, y = 0.1: r^2 = 0.05, radial 0.999962775, tangential 0.001 * 0.13 - 0.004 * 0.02 = 0.00005 and
    -0.002 * 0.07 + 0.002 * 0.02 = -0.0001."""
    view = read(tmp_path, rotation=_matrix(np.eye(3))).views[0]
    expected = [
        4684.255692 + 13991.05582 * (0.2 * 0.999962775 + 0.00005),
        7223.5141002 + 13991.05582 * (0.1 * 0.999962775 - 0.0001),
    ]
    np.testing.assert_allclose(project(view, 10.2, 20.1, 31), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("XRightYDown", [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ("XRightYUp", [[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
        ("XLeftYDown", [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]),
        ("XDownYLeft", [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        ("XUpYRight", [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    ],
)
def test_axes_of_the_camera_are_as_named(name: str, rows: list[list[int]], tmp_path: Path) -> None:
    """The same camera written with other axes: its rotation's rows are those axes in OpenCV's."""
    orientation = f"<CameraOrientation>{name}</CameraOrientation>"
    view = read(tmp_path, orientation=orientation, rotation=_matrix(np.array(rows, float))).views[0]
    np.testing.assert_allclose(view.T_cam_world[:3, :3], np.eye(3), atol=1e-12)


def _matrix(R: np.ndarray) -> str:
    return "".join(f"<M_{i}{j}>{R[i, j]}</M_{i}{j}>" for i in range(3) for j in range(3))


def test_a_local_east_north_up_system_is_in_metres(tmp_path: Path) -> None:
    systems = "<SpatialReferenceSystems><SRS><Id>2</Id><Definition>ENU:39.97,-83.0</Definition></SRS>"
    systems += "</SpatialReferenceSystems>"
    assert read(tmp_path, systems=systems, system="<SRSId>2</SRSId>").unit_m == 1.0
    with pytest.raises(InputError, match="local coordinate system"):
        read(tmp_path, systems=systems.replace("ENU:39.97,-83.0", "EPSG:4326"), system="<SRSId>2</SRSId>")
    with pytest.raises(InputError, match="<Id> of an <SRS>"):
        read(tmp_path, systems=systems, system="<SRSId>5</SRSId>")


@pytest.mark.parametrize(
    ("parts", "where"),
    [
        ({"focal": "<CameraModelType>Fisheye</CameraModelType>"}, "Fisheye"),
        ({"focal": ""}, "FocalLengthPixels"),
        ({"focal": PIXELS.replace("13991", "-13991")}, "above 0"),
        ({"point": POINT_MM}, "SensorSize or PixelSize"),
        ({"orientation": "<CameraOrientation>XRightYLeft</CameraOrientation>"}, "XRightYLeft"),
        ({"rotation": MATRIX.replace("<M_22>-0.9", "<M_22>0.9")}, "rotation matrix"),
        ({"rotation": MATRIX.replace("<M_22>", "<M_22>x")}, "line 7"),
        ({"rotation": "<Heading>1</Heading>"}, "Heading"),
        ({"system": "</Block><Block>"}, "one <Block>"),
    ],
)
def test_damaged_files_are_refused_with_the_place(parts: dict[str, str], where: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(where)):
        read(tmp_path, **parts)
