"""Metashape's XML and projects against the formulas of its manual, worked out by hand, and damaged files."""

import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from registration.errors import InputError
from registration.formats.registry import detect_format, read_source
from registration.formats.source import ReadOptions, SourceCapture
from tests.registration.formats.projecting import image, project

CALIBRATION = """<f>500</f><cx>10</cx><cy>-5</cy><b1>2</b1><b2>3</b2><k1>0.1</k1><k2>-0.05</k2><k3>0.02</k3>
<k4>0.01</k4><p1>0.001</p1><p2>-0.002</p2><p3>0.5</p3><p4>0.1</p4>"""
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
TURNED = "0 0 1 5 0 1 0 0 -1 0 0 0 0 0 0 1"  # at (5, 0, 0), looks along +x of the chunk; its x is -z
LOCAL = '<reference>LOCAL_CS["Local",UNIT["millimetre",0.001]]</reference>'
XML = """<?xml version="1.0" encoding="UTF-8"?>
<document version="1.5.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">
      <sensor id="0" label="unknown" type="{kind}">
        <resolution width="400" height="300"/>
        <calibration type="{kind}" class="initial"><resolution width="400" height="300"/><f>1</f></calibration>
        <calibration type="{kind}" class="adjusted"><resolution width="400" height="300"/>{calibration}</calibration>
        {slave}
      </sensor>
    </sensors>
    <cameras next_id="2">
      <camera id="0" sensor_id="0" label="front"><transform>{pose}</transform></camera>
      <group id="0" label="sides"><camera id="1" {second}</camera></group>
    </cameras>
    {world}
  </chunk>
</document>
"""
SECOND = f'sensor_id="0" label="side.JPG"><transform>{TURNED}</transform>'


def write(folder: Path, **parts: str) -> Path:
    values = {"kind": "frame", "calibration": CALIBRATION, "slave": "", "pose": IDENTITY, "second": SECOND, "world": ""}
    (folder / "cameras.xml").write_text(XML.format(**(values | parts)), "utf-8")
    for name in ("front.jpg", "photos/side.jpg"):
        image(folder / name, 400, 300)
    return folder


def read(folder: Path) -> SourceCapture:
    return read_source(folder, ReadOptions())


def test_a_point_projects_as_the_manual_says(tmp_path: Path) -> None:
    source = read(write(tmp_path))
    assert detect_format(tmp_path).name == "metashape" and source.unit_m is None
    front, side = source.views
    # r^2 = 0.05, radial 1.0048775625, tangential terms 0.00005 and -0.0001 times 1.02525: x' = 0.201026775,
    # y' = 0.10038523125; u = 210 + 502 x' + 3 y', v = 145 + 500 y'
    np.testing.assert_allclose(project(front, 0.2, 0.1, 1.0), [311.2165967, 195.1926156], atol=1e-5)
    np.testing.assert_allclose(project(side, 6.0, 0.1, -0.2), [311.2165967, 195.1926156], atol=1e-5)
    assert (front.width_px, front.height_px) == (400, 300)


@pytest.mark.parametrize(("kind", "u"), [("fisheye", 602.699082), ("equisolid_fisheye", 592.683432)])
def test_fisheyes_have_the_angle_as_radius(kind: str, u: float, tmp_path: Path) -> None:
    plain = "<f>500</f><cx>10</cx><cy>-5</cy>"
    front = read(write(tmp_path, kind=kind, calibration=plain)).views[0]
    np.testing.assert_allclose(project(front, 1.0, 0.0, 1.0), [u, 145.0], atol=1e-5)  # 45 degrees
    np.testing.assert_allclose(project(front, 0.0, 0.0, 1.0), [210.0, 145.0], atol=1e-9)


def test_the_chunks_transform_is_applied_and_its_unit_read(tmp_path: Path) -> None:
    # The world is the chunk twice as large, turned by 90 degrees about z, and moved by (100, 0, 0) mm.
    world = (
        "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>100 0 0</translation><scale>2</scale>"
        f"</transform>{LOCAL}"
    )
    source = read(write(tmp_path, world=world))
    assert source.unit_m == 0.001
    front, side = source.views
    expected = [311.2165967, 195.1926156]  # of the chunk's point (0.2, 0.1, 1), which is (-0.2, 0.4, 2) + (100, 0, 0)
    np.testing.assert_allclose(project(front, 99.8, 0.4, 2.0), expected, atol=1e-5)
    centre = -side.T_cam_world[:3, :3].T @ side.T_cam_world[:3, 3]
    np.testing.assert_allclose(centre, [100.0, 10.0, 0.0], atol=1e-9)


def test_a_georeferenced_chunk_keeps_its_frame_in_metres(tmp_path: Path) -> None:
    world = (
        "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>4e6 2e6 5e6</translation><scale>0.5</scale>"
        '</transform><reference>GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]</reference>'
    )
    (tmp_path / "model.ply").write_text("ply\n")
    source = read(write(tmp_path, world=world))
    assert source.unit_m == 1.0 and source.scan is None
    assert any("georeferenced" in note for note in source.notes)
    assert any("model.ply was left out" in note for note in source.notes)
    side = source.views[1]
    np.testing.assert_allclose(-side.T_cam_world[:3, :3].T @ side.T_cam_world[:3, 3], [2.5, 0, 0], atol=1e-12)


def test_cameras_of_other_components_and_their_transforms_do_not_count(tmp_path: Path) -> None:
    """As Metashape 2 writes georeferenced chunks: a transform for each component, labels that are paths."""
    write(tmp_path)
    text = (tmp_path / "cameras.xml").read_text("utf-8")
    ground = "<translation>-2499366.429888 -4256836.520906 4029217.965003</translation><scale>12.5</scale>"
    components = (
        "<components><component id='3'><transform><scale>9</scale></transform></component><component id='7'>"
        f"<transform><rotation>1 0 0 0 1 0 0 0 1</rotation>{ground}</transform></component></components>"
    )
    text = text.replace("<cameras", components + "<cameras").replace(
        'sensor_id="0" label="front"', 'sensor_id="0" component_id="7" label="D:\\shoot\\front.jpg"'
    )
    third = f'<camera id="2" sensor_id="0" component_id="7" label="/home/a/photos/side.jpg"><transform>{TURNED}'
    text = text.replace('sensor_id="0" label="side.JPG"', 'sensor_id="0" component_id="3" label="lost"')
    (tmp_path / "cameras.xml").write_text(
        text.replace("</cameras>", third + "</transform></camera></cameras>"), "utf-8"
    )
    source = read(tmp_path)
    assert [view.name for view in source.views] == ["front", "side"] and source.unit_m == 1.0
    assert any("georeferenced (geocentric)" in note for note in source.notes)
    assert any("another component, whose world is another: lost" in note for note in source.notes)
    side = source.views[1]
    np.testing.assert_allclose(-side.T_cam_world[:3, :3].T @ side.T_cam_world[:3, 3], [62.5, 0, 0], atol=1e-9)


def test_a_slave_has_its_masters_pose_and_its_sensors_offset(tmp_path: Path) -> None:
    slave = "<rotation>1 0 0 0 1 0 0 0 1</rotation><location>0.1 0 0</location>"
    source = read(write(tmp_path, slave=slave, second='sensor_id="0" master_id="0" label="side">'))
    assert any("1 cameras have their master's pose" in note for note in source.notes)
    front, side = source.views
    centres = [-view.T_cam_world[:3, :3].T @ view.T_cam_world[:3, 3] for view in (front, side)]
    np.testing.assert_allclose(centres, [[0, 0, 0], [0.1, 0, 0]], atol=1e-12)  # the master's own pose has no offset


def test_cameras_that_do_not_count_are_named(tmp_path: Path) -> None:
    source = read(write(tmp_path, second='sensor_id="0" label="side">'))
    assert [view.name for view in source.views] == ["front"]
    assert any("1 cameras were left out, not aligned: side" in note for note in source.notes)
    source = read(write(tmp_path, second=SECOND.replace('label="side.JPG"', 'label="side.JPG" enabled="false"')))
    assert any("disabled in Metashape: side.JPG" in note for note in source.notes)


def test_a_rolling_shutter_is_named(tmp_path: Path) -> None:
    assert not any("rolling" in note for note in read(write(tmp_path)).notes)
    source = read(write(tmp_path, slave='<property name="rolling_shutter" value="true"/>'))
    assert any("rolling shutter" in note for note in source.notes)


def test_masks_are_found_and_are_no_photographs(tmp_path: Path) -> None:
    write(tmp_path)
    image(tmp_path / "front_mask.png", 400, 300)
    image(tmp_path / "photos" / "masks" / "side.png", 400, 300)
    source = read(tmp_path)
    assert [view.mask.name for view in source.views if view.mask] == ["front_mask.png", "side.png"]
    assert [view.image.name for view in source.views if isinstance(view.image, Path)] == ["front.jpg", "side.jpg"]


BAD = {
    "no XML": (("<document", "<<document"), "well-formed XML"),
    "a document type": (("<document", "<!DOCTYPE a [<!ENTITY b 'c'>]><document"), "document type"),
    "no calibration": (("<f>500</f>", ""), "an element <f>"),
    "text for a number": (("<f>500</f>", "<f>wide</f>"), "line 8"),
    "an old version": (("<f>500</f>", "<fx>500</fx><fy>501</fy>"), "PhotoScan 1.1"),
    "Fourier corrections": (("<f>500</f>", "<f>500</f><corrections>1 2</corrections>"), "<corrections>"),
    "a spherical camera": (('type="frame" class="adjusted"', 'type="spherical" class="adjusted"'), "spherical"),
    "another size": (
        ('class="adjusted"><resolution width="400"', 'class="adjusted"><resolution width="800"'),
        "400 x 300",
    ),
    "too few numbers": ((IDENTITY, "1 0 0 0"), "line 14"),
    "columns for rows": ((IDENTITY, "1 0 0 0 0 1 0 0 0 0 1 0 5 0 0 1"), "by rows"),
    "a scaled rotation": ((IDENTITY, "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"), "rotation matrix"),
    "a mirrored rotation": ((IDENTITY, "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"), "determinant -1"),
    "no such sensor": (('id="0" sensor_id="0"', 'id="0" sensor_id="7"'), "line 14"),
    "no such photograph": (('label="front"', 'label="other"'), "other"),
    "two chunks": (("</chunk>", '</chunk><chunk label="b" enabled="true"/>'), "Chunk 1, b"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_are_refused_with_the_place(name: str, tmp_path: Path) -> None:
    (old, new), part = BAD[name]
    file = write(tmp_path) / "cameras.xml"
    text = file.read_text("utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(InputError, match=re.escape(part)):
        read_source(tmp_path, ReadOptions(), name="metashape")


def project_folder(folder: Path) -> Path:
    """A project of two frames, whose photographs lie beside it."""
    write(folder)
    xml = (folder / "cameras.xml").read_text("utf-8")
    (folder / "cameras.xml").unlink()
    frames = '<frames><frame id="0" path="0/frame.zip"/><frame id="3" path="3/frame.zip"/></frames></chunk>'
    chunk = xml[xml.index("<chunk") : xml.index("</document>")].replace("</chunk>", frames)
    image(folder / "later" / "front.jpg", 400, 300)
    shutil.copy(folder / "later" / "front.jpg", folder / "later" / "side.jpg")
    files = folder / "scan.files"
    members = {
        "project.zip": '<document version="1.2.0"><chunks><chunk id="2" path="2/chunk.zip"/></chunks></document>',
        "2/chunk.zip": chunk,
        "2/0/frame.zip": frame("../../../../front.jpg", "../../../../photos/side.jpg"),
        "2/3/frame.zip": frame("../../../../later/front.jpg", "..\\..\\..\\..\\later\\side.jpg"),
    }
    for name, content in members.items():
        (files / name).parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(files / name, "w") as archive:
            archive.writestr("doc.xml", content)
    (folder / "scan.psx").write_text('<document version="1.2.0" path="{projectname}.files/project.zip"/>', "utf-8")
    return folder


def frame(*paths: str) -> str:
    photos = "".join(f'<camera camera_id="{i}"><photo path="{path}"/></camera>' for i, path in enumerate(paths))
    return f'<frame version="1.2.0"><cameras>{photos}</cameras></frame>'


def test_a_project_says_where_its_photographs_are(tmp_path: Path) -> None:
    folder = project_folder(tmp_path)
    assert detect_format(folder).name == "metashape_project"
    first, later = (read_source(folder, ReadOptions(frame=number)) for number in (0, 3))
    assert [view.image for view in first.views] == [folder / "front.jpg", folder / "photos" / "side.jpg"]
    assert [view.image for view in later.views] == [folder / "later" / "front.jpg", folder / "later" / "side.jpg"]
    np.testing.assert_allclose(project(later.views[0], 0.2, 0.1, 1.0), [311.2165967, 195.1926156], atol=1e-5)


def test_damaged_projects_are_refused(tmp_path: Path) -> None:
    folder = project_folder(tmp_path)
    with pytest.raises(InputError, match="--frame"):
        read_source(folder, ReadOptions())
    with pytest.raises(InputError, match="frames 0, 3"):
        read_source(folder, ReadOptions(frame=1))
    (folder / "scan.files" / "2" / "chunk.zip").write_bytes(b"PK\x03\x04 no more")
    with pytest.raises(InputError, match="chunk.zip"):
        read_source(folder, ReadOptions(frame=0))
    (folder / "scan.psx").write_text('<document path="../elsewhere/project.zip"/>', "utf-8")
    with pytest.raises(InputError, match="inside the project"):
        read_source(folder, ReadOptions(frame=0))
