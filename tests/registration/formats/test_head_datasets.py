"""NeRSemble, Multiface, FaceScape and VHAP against their public loaders, with numbers worked out by hand."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from registration.capture.native import read_capture
from registration.errors import InputError
from registration.formats.convert import import_capture
from registration.formats.registry import detect_format, read_source
from registration.formats.source import ReadOptions, SourceCapture, VideoFrame
from tests.registration.formats.projecting import image, project, video

K = [[8000.0, 0, 1100], [0, 8000, 1604], [0, 0, 1]]  # of 2200 x 3208 px
AHEAD = np.eye(4).tolist()  # looks along z from the origin
RIGHT = [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]  # at (0.1, 0, 0)


def nersemble(folder: Path, **changed: Any) -> Path:
    """A participant of version 2 with two sequences: videos of 110 x 160 px, of which K is a twentieth."""
    participant = folder / "017"
    params = {"world_2_cam": {"222200042": AHEAD, "222200044": RIGHT}, "intrinsics": K} | changed
    (participant / "calibration").mkdir(parents=True)
    (participant / "calibration" / "camera_params.json").write_text(json.dumps(params))
    colours = {"222200042": [[1.1, 0, 0], [0.1, 1, 0], [0, 0, 0.9]], "222200044": np.eye(3).tolist()}
    (participant / "calibration" / "color_calibration.json").write_text(json.dumps(colours))
    for sequence in ("EXP-1-head", "EMO-1-shout+laugh"):
        for serial in ("222200042", "222200044"):
            video(participant / "sequences" / sequence / "images" / f"cam_{serial}.mp4", 110, 160, frames=4)
    return participant


def test_nersemble_2_scales_k_and_has_linear_colours(tmp_path: Path) -> None:
    participant = nersemble(tmp_path)
    assert detect_format(participant).name == "nersemble"
    source = read_source(participant, ReadOptions(expression="EXP-1-head", frame=2))
    assert (source.subject, source.expression, source.unit_m) == ("017", "EXP-1-head", 1.0)
    first, second = source.views
    assert isinstance(first.image, VideoFrame) and first.image.index == 2
    # 0.01 m beside the axis at 1 m: 8000 * 0.01 / 20 = 4 px from the middle 1100 / 20 = 55, 1604 / 20.05 = 80
    np.testing.assert_allclose(project(first, 0.01, 0.0, 1.0), [59.0, 80.0], atol=1e-9)
    np.testing.assert_allclose(project(second, 0.11, 0.0, 1.0), [59.0, 80.0], atol=1e-9)
    assert first.colour.matrix_space == "linear"  # corrected = M @ linear
    assert first.colour.matrix == ((1.1, 0.0, 0.0), (0.1, 1.0, 0.0), (0.0, 0.0, 0.9))


def test_the_frame_of_a_video_is_exact(tmp_path: Path) -> None:
    sequence = nersemble(tmp_path) / "sequences" / "EXP-1-head"
    for frame in (0, 3):
        source = read_source(sequence, ReadOptions(frame=frame))
        import_capture(source, tmp_path / f"capture{frame}")
        import cv2

        view = read_capture(tmp_path / f"capture{frame}").views[0]
        assert abs(cv2.imread(str(view.image)).mean() - (40 + 20 * frame)) < 4
    with pytest.raises(InputError, match="0 to 3"):
        read_source(sequence, ReadOptions(frame=4))


def test_nersemble_1_has_half_sized_images_alpha_maps_and_affine_colours(tmp_path: Path) -> None:
    participant = tmp_path / "030"
    frame = participant / "sequences" / "EXP-2-eyes" / "frame_00012"
    image(frame / "images-2x" / "cam_222200042.png", 110, 160)
    image(frame / "alpha_map" / "cam_222200042.png", 110, 160)
    (participant / "camera_params.json").write_text(json.dumps({"world_2_cam": {"222200042": AHEAD}, "intrinsics": K}))
    affine = np.array([[1, 0.2, 0, 0.01], [0, 0.9, 0, 0.02], [0, 0, 1.1, 0.03], [0, 0, 0, 1]])
    colours = participant / "annotations" / "EXP-2-eyes" / "color_correction"
    colours.mkdir(parents=True)
    np.save(colours / "222200042.npy", affine)
    source = read_source(participant, ReadOptions())
    (view,) = source.views
    assert view.mask == frame / "alpha_map" / "cam_222200042.png" and "frame 12 was read" in source.notes
    assert view.colour.matrix_space == "encoded" and view.colour.matrix is not None
    rgb = np.array([0.5, 0.4, 0.3])
    theirs = rgb @ affine[:3, :3] + affine[:3, 3]  # image @ A[:3, :3] + A[:3, 3]: (0.51, 0.48, 0.36)
    np.testing.assert_allclose(theirs, [0.51, 0.48, 0.36], atol=1e-12)
    np.testing.assert_allclose(np.array(view.colour.matrix) @ [*rgb, 1], theirs, atol=1e-12)


def test_alpha_maps_of_another_size_are_left_out_and_named(tmp_path: Path) -> None:
    sequence = nersemble(tmp_path) / "sequences" / "EXP-1-head"
    image(sequence / "alpha_maps" / "cam_222200042_000000.png", 110, 160)
    image(sequence / "alpha_maps" / "cam_222200044_000000.png", 220, 320)
    source = read_source(sequence, ReadOptions())
    assert [view.mask is not None for view in source.views] == [True, False]
    assert any("cam_222200044_000000.png; resize" in note for note in source.notes)


@pytest.mark.parametrize(
    ("changed", "part"),
    [
        ({"intrinsics": [[1, 2], [3, 4]]}, "intrinsics"),
        ({"world_2_cam": {"9": AHEAD}}, "222200042"),
        ({"world_2_cam": {"222200042": np.diag([1, 1, -1, 1]).tolist()}}, "222200042"),
        ({"world_2_cam": []}, "world_2_cam"),
        ({"width": 2200, "height": 2200}, "110 x 160"),
    ],
)
def test_damaged_nersemble_cameras_are_refused(changed: dict[str, Any], part: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(part)):
        read_source(nersemble(tmp_path, **changed) / "sequences" / "EXP-1-head", ReadOptions())


def test_several_sequences_must_be_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--expression"):
        read_source(nersemble(tmp_path), ReadOptions())


KRT = """400002
2000 0 60
0 2000 80
0 0 1
0.1 0 0.001 -0.002 0
1 0 0 0
0 1 0 0
0 0 1 1000

400004
2000 0 60
0 2000 80
0 0 1
0 0 0 0 0
0 0 -1 0
0 1 0 0
1 0 0 900

"""


def multiface(folder: Path, krt: str = KRT) -> Path:
    entity = folder / "m--20180227--0000--6795937--GHS"
    for segment in ("E001_Neutral_Eyes_Open", "E002_Swallow"):
        for camera in ("400002", "400004"):
            for frame in ("000102", "000105"):
                image(entity / "images" / segment / camera / f"{frame}.png", 120, 160)
    (entity / "KRT").write_text(krt)
    (entity / "tracked_mesh").mkdir()
    return entity


def test_multiface_is_in_millimetres_with_five_distortion_values(tmp_path: Path) -> None:
    entity = multiface(tmp_path)
    assert detect_format(entity).name == "multiface"
    source = read_source(entity / "images" / "E002_Swallow", ReadOptions(frame=105))
    assert (source.subject, source.expression, source.unit_m) == ("6795937", "E002_Swallow", 0.001)
    first, second = source.views
    assert first.image == entity / "images" / "E002_Swallow" / "400002" / "000105.png"
    # (50, 20, 0) mm at 1 m: x = 0.05, y = 0.02, r^2 = 0.0029, radial 1.00029. By OpenCV's formula
    # x' = 0.0500145 + 2 * 0.001 * 0.001 - 0.002 * 0.0079 and y' = 0.0200058 + 0.001 * 0.0037 - 2 * 0.002 * 0.001
    np.testing.assert_allclose(project(first, 50, 20, 0), [60 + 2000 * 0.0500007, 80 + 2000 * 0.0200055], atol=1e-6)
    # the second camera looks along +x from (-900, 0, 0); its x is -z
    np.testing.assert_allclose(project(second, 100, 10, 0), [60, 80 + 2000 * 0.01], atol=1e-9)
    assert any("tracked_mesh" in note for note in source.notes)


def test_multiface_colours_are_the_datasets_balance_of_linear_light(tmp_path: Path) -> None:
    colour = read_source(multiface(tmp_path), ReadOptions(expression="E002_Swallow")).views[0].colour
    assert colour.encoding == "linear" and colour.matrix is not None
    rgb = np.array([0.2, 0.3, 0.1])
    # gammaCorrect before its root: (1 / (1 - 3/255)) * 0.95 * (img * scale / 1.1 - 3/255)
    theirs = 0.95 / (1 - 3 / 255) * (rgb * [1.4, 1.1, 1.6] / 1.1 - 3 / 255)
    np.testing.assert_allclose(np.array(colour.matrix) @ [*rgb, 1], theirs, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("0 2000 80\n", "", "line 4"),
        ("0.1 0 0.001 -0.002 0\n", "0.1 0 0.001 -0.002\n", "5 finite numbers of distortion in line 5"),
        ("0 0 1 1000", "0 0 2 1000", "400002, line 1"),
        ("1 0 0 900", "1 0 0 nan", "line 17"),
        ("400004", "400002", "line 10"),
        ("1 0 0 900\n\n", "", "7 for 400004"),
    ],
)
def test_damaged_krt_files_are_refused_with_the_line(old: str, new: str, part: str, tmp_path: Path) -> None:
    assert old in KRT
    with pytest.raises(InputError, match=re.escape(part)):
        read_source(multiface(tmp_path, KRT.replace(old, new, 1)), ReadOptions(expression="E002_Swallow"))


def facescape(folder: Path, **changed: Any) -> Path:
    expression = folder / "212" / "4_anger"
    params: dict[str, Any] = {}
    for number in (0, 1):
        params |= {
            f"{number}_K": [[200, 0, 59.5], [0, 200, 79.5], [0, 0, 1]],
            f"{number}_Rt": [[1, 0, 0, -float(number)], [0, 1, 0, 0], [0, 0, 1, 5]],
            f"{number}_distortion": [0.1, 0, 0.001, -0.002, 0],
            f"{number}_width": 120,
            f"{number}_height": 160,
            f"{number}_valid": number == 0,
        }
        image(expression / f"{number}.jpg", 120, 160)
    (expression / "params.json").write_text(json.dumps({k: v for k, v in (params | changed).items() if v is not None}))
    return expression


def test_facescape_has_opencvs_pixels_and_a_table_of_scales(tmp_path: Path) -> None:
    expression = facescape(tmp_path)
    assert detect_format(expression).name == "facescape"
    (tmp_path / "212" / "4_anger.ply").write_text("ply\n")
    source = read_source(expression, ReadOptions())
    assert (source.subject, source.expression, source.unit_m) == ("212", "anger", None)
    assert source.scan == expression.parent / "4_anger.ply"
    assert [view.name for view in source.views] == ["0"] and any("invalid: 1" in note for note in source.notes)
    # cv2.projectPoints counts from the centre of the first pixel; half a pixel more counts from its corner
    np.testing.assert_allclose(project(source.views[0], 0.25, 0.1, 0.0), _opencv(0.25, 0.1, 0.0), atol=1e-9)
    (tmp_path / "Rt_scale_dict.json").write_text(json.dumps({"212": {"4": [83.5, np.eye(4)[:3].tolist()]}}))
    assert read_source(expression, ReadOptions()).unit_m == pytest.approx(0.0835)


def _opencv(*point: float) -> np.ndarray:
    import cv2

    intrinsics = np.array([[200, 0, 59.5], [0, 200, 79.5], [0, 0, 1.0]])
    lens = np.array([0.1, 0, 0.001, -0.002, 0])
    return cv2.projectPoints(np.array([point]), np.zeros(3), np.array([0, 0, 5.0]), intrinsics, lens)[0][0, 0] + 0.5


@pytest.mark.parametrize(
    ("changed", "part"),
    [
        ({"0_Rt": None}, "0_Rt"),
        ({"0_distortion": [0.1, 0]}, "0_distortion"),
        ({"0_width": 0.5}, "0_width"),
        ({"0_valid": False}, "valid"),
        ({"0_valid": 0}, "valid"),
        ({"0_Rt": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 5]]}, "rotation"),
    ],
)
def test_damaged_facescape_cameras_are_refused(changed: dict[str, Any], part: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=part):
        read_source(facescape(tmp_path, **changed), ReadOptions())


def vhap(folder: Path, **changed: Any) -> Path:
    frames = [
        {
            "timestep_index": step,
            "camera_index": camera,
            "camera_id": f"22220004{camera}",
            "cx": 55.0,
            "cy": 70.0,
            "fl_x": 400.0,
            "fl_y": 400.0,
            "w": 110,
            "h": 160,
            "transform_matrix": [[1, 0, 0, 0.1 * camera], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]],
            "file_path": f"images/{step:05d}_{camera:02d}.png",
            "fg_mask_path": f"fg_masks/{step:05d}_{camera:02d}.png",
        }
        | changed
        for step in (0, 1)
        for camera in (0, 1)
    ]
    for frame in frames:
        image(folder / frame["file_path"], 110, 160), image(folder / frame["fg_mask_path"], 110, 160)
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def test_vhaps_principal_point_counts_from_below(tmp_path: Path) -> None:
    """Its projection: y_ndc = (2 fy / h) y / -z + 2 cy / h - 1 upwards: a point on the axis is cy above the bottom."""
    source: SourceCapture = read_source(vhap(tmp_path / "074_EMO-1_v16"), ReadOptions(frame=1))
    assert detect_format(tmp_path / "074_EMO-1_v16").name == "vhap"
    assert (source.subject, source.expression, source.unit_m) == ("074", "EMO-1", 1.0)
    first, second = source.views
    assert first.mask is not None and first.mask.name == "00001_00.png"
    np.testing.assert_allclose(project(first, 0, 0, 0), [55, 90], atol=1e-9)  # from (0, 0, 1) along -z
    np.testing.assert_allclose(project(first, 0, 0.1, 0), [55, 50], atol=1e-9)  # y is up
    np.testing.assert_allclose(project(second, 0, 0, 0), [15, 90], atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "part"),
    [
        ({"camera_id": "1"}, "each camera once"),
        ({"fl_x": -1.0}, "above 0"),
        ({"transform_matrix": [[1, 0, 0, 0]]}, "frames[0]: transform_matrix"),
        ({"timestep_index": 5, "camera_id": "x"}, "each camera once"),
    ],
)
def test_damaged_vhap_exports_are_refused(changed: dict[str, Any], part: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(part)):
        read_source(vhap(tmp_path, **changed), ReadOptions())
    with pytest.raises(InputError):
        read_source(vhap(tmp_path / "other"), ReadOptions(frame=7))
