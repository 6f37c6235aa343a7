import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coregister.anatomy.tongue_fit import KeyPointFit
from coregister.anatomy.tongue_keypoints import REQUIRED, TONGUE_POINTS, TongueRecording, read_recording
from coregister.anatomy.tongue_poses import draw_controls
from coregister.anatomy.tongue_rig import TongueRig
from registration.anatomy.tongue_structure import find_tongue
from registration.errors import InputError
from registration.model import gnm_npz
from tests.conftest import SHARED, needs_shared

T = 6


def still(noise=0.0, names=REQUIRED):
    """Points that stand still but for noise, in millimetres from the upper incisors."""
    rng = np.random.default_rng(3)
    place = {"upper_incisors": (0, 0, 0), "tongue_tip": (0, -4, -12), "tongue_blade": (0, 1, -25)}
    place |= {"tongue_dorsum": (0, 3, -40), "nasion": (0, 60, 5), "left_mastoid": (60, 30, -80)}
    place |= {"right_mastoid": (-60, 30, -80), "lower_incisors": (0, -8, -2)}
    return {name: np.array(place[name], float) + rng.normal(0, noise, (T, 3)) for name in names}


def write_npz(file, points, time=None):
    names = np.array(list(points))
    np.savez(
        file,
        names=names,
        time_s=np.arange(T) / 100 if time is None else time,
        points_mm=np.stack([*points.values()], 1),
    )
    return file


def write_csv(file, points):
    rows = [f"{t / 100},{n},{','.join(map(str, points[n][t]))}" for t in range(T) for n in points]
    file.write_text("time_s,point,x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n")
    return file


def test_csv_and_npz_are_the_same_recording(tmp_path):
    points = still(noise=1.0)
    one, two = (read_recording(w(tmp_path / f"r.{s}", points)) for w, s in ((write_npz, "npz"), (write_csv, "csv")))
    assert np.array_equal(one.time_s, two.time_s)
    for name in REQUIRED:
        assert np.allclose(one.points[name], points[name] - points["upper_incisors"], atol=1e-9)
        assert np.allclose(two.points[name], one.points[name], atol=1e-9)


def test_head_motion_is_taken_out_by_three_points_of_the_skull(tmp_path):
    points = still(names=(*REQUIRED, "nasion", "left_mastoid", "right_mastoid"))
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.1, (T, 3)))
    turns = Rotation.from_quat(np.r_[[[0, 0, 0, 1]] * 4, turns[4:].as_quat()])
    moved = {name: turns.apply(place) + np.arange(T)[:, None] for name, place in points.items()}
    read = read_recording(write_npz(tmp_path / "moved.npz", moved))
    for name in REQUIRED:
        assert np.abs(read.points[name] - points[name]).max() < 1e-9


def test_times_without_a_needed_point_are_incomplete(tmp_path):
    points = still()
    points["tongue_tip"][2] = np.nan
    read = read_recording(write_csv(tmp_path / "gap.csv", points))
    assert read.complete.tolist() == [True, True, False, True, True, True]


def drop(name):
    return lambda points: points.pop(name)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (drop("upper_incisors"), "'upper_incisors'"),
        (drop("tongue_tip"), "without tongue_tip"),
        (lambda points: points.update(ear=points["tongue_tip"]), "ear"),
        (lambda points: points.update({name: 1e-3 * place for name, place in points.items()}), "millimetres"),
        (lambda points: points["tongue_tip"].fill(np.nan), "tongue_tip at 0"),
        (lambda points: points["tongue_tip"].fill(1e9), "1e+09"),
    ],
)
@pytest.mark.parametrize("write", (write_npz, write_csv))
def test_recordings_that_cannot_be_used_are_refused(tmp_path, change, text, write):
    points = still()
    change(points)
    with pytest.raises(InputError) as error:
        read_recording(write(tmp_path / f"bad.{write.__name__[-3:]}", points))
    assert text in str(error.value)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "the header"),
        ("time_s,point,x_mm,y_mm,z_mm\n0,tongue_tip,1,2\n", "5 values in line 2"),
        ("time_s,point,x_mm,y_mm,z_mm\n0,tongue_tip,1,2,x\n", "line 2"),
        ("time_s,point,x_mm,y_mm,z_mm\n0,tongue_tip,1,2,3\n0,tongue_tip,1,2,3\n", "again in line 3"),
        ("time_s,point,x_mm,y_mm,z_mm\nnan,tongue_tip,1,2,3\n", "a time in line 2"),
    ],
)
def test_damaged_tables_are_refused_with_the_line(tmp_path, content, text):
    (tmp_path / "bad.csv").write_text(content)
    with pytest.raises(InputError) as error:
        read_recording(tmp_path / "bad.csv")
    assert text in str(error.value)
    with pytest.raises(InputError, match="cannot be read"):
        read_recording(tmp_path / "bad.txt")


@pytest.fixture(scope="module")
def fit():
    data = gnm_npz.read(SHARED / "data" / "gnm" / "gnm_head_reconstructed.npz")
    return KeyPointFit(data=data, rig=TongueRig(structure=find_tongue(data)))


def in_mouth(fit, gap, rng):
    """A pose that penetrates nothing."""
    mouth = fit.mouth(gap)
    while True:
        tongue = fit.rig.pose(draw_controls(rng, 0.8))
        if max(mouth.excess_mm(mouth.carried + tongue - fit.rig.structure.rest).values()) <= 0.2:
            return tongue


@needs_shared
def test_points_of_known_poses_are_recovered(fit):
    rng = np.random.default_rng(1)
    gaps = np.array([0.0, 0.01, 0.016])
    posed = [fit.rig.structure.rest, *(in_mouth(fit, gap, rng) for gap in gaps[1:])]
    true = [fit.points_of(tongue, gap) for tongue, gap in zip(posed, gaps, strict=True)]
    points = {name: np.array([moment[name] for moment in true]) for name in TONGUE_POINTS[:3]}
    points["upper_incisors"] = np.zeros((3, 3))
    points["lower_incisors"] = np.stack([0 * gaps, -3 - 1e3 * gaps, 0 * gaps], 1)
    fitted = fit.fit(TongueRecording(time_s=np.arange(3.0), points=points), most=3)
    assert fitted.residual_mm.max() < 0.5 and not fitted.limited.any()
    for displacement, moment, gap in zip(fitted.displacements, true, gaps, strict=True):
        found = fit.points_of(fit.rig.structure.rest + displacement, gap)
        assert max(np.linalg.norm(found[name] - moment[name]) for name in TONGUE_POINTS[:3]) < 0.5


@needs_shared
def test_points_in_the_palate_leave_the_tongue_before_it(fit):
    rest = fit.points_of(fit.rig.structure.rest)
    points = {name: rest[name][None] + (0, 8, 0) for name in TONGUE_POINTS[:3]} | {"upper_incisors": np.zeros((1, 3))}
    fitted = fit.fit(TongueRecording(time_s=np.zeros(1), points=points), most=1)
    mouth = fit.mouth(0.0)
    forced = fit.rig.structure.rest + (0, 8e-3, 0)
    assert max(mouth.excess_mm(forced).values()) > 2
    assert max(mouth.excess_mm(mouth.carried + fitted.displacements[0]).values()) <= 0.2
    assert fitted.residual_mm[0] > 1


def test_points_are_smoothed_in_time_where_they_were_measured():
    time, rng = np.arange(200) / 200, np.random.default_rng(0)
    true = np.stack([3 * np.sin(2 * np.pi * 4 * time), 0 * time, -20 + time], 1)
    noisy = true + rng.normal(0, 1, true.shape)
    noisy[50] = np.nan
    recording = TongueRecording(time_s=time, points={"tongue_tip": noisy})
    smooth = recording.smoothed(np.arange(200), 0.01).points["tongue_tip"]
    assert np.isnan(smooth[50]).all() and np.isfinite(np.delete(smooth, 50, 0)).all()
    assert np.sqrt(np.nanmean((smooth - true) ** 2)) < 0.5
    # Alone in time, and equal to its neighbours, a point stays.
    apart = TongueRecording(time_s=time * 1000, points={"tongue_tip": noisy}).smoothed(np.array([7]), 0.01)
    assert np.array_equal(apart.points["tongue_tip"], noisy[[7]]) and apart.time_s.tolist() == [35.0]
    level = TongueRecording(time_s=time, points={"tongue_tip": np.ones((200, 3))}).smoothed(np.array([0, 9]), 0.01)
    assert np.abs(level.points["tongue_tip"] - 1).max() < 1e-12


@needs_shared
@pytest.mark.slow
def test_a_tongue_folded_on_itself_is_held_back_by_the_limits(fit):
    points = still()
    points["tongue_tip"] = points["tongue_dorsum"] + (0, 20, 0)
    folded = fit.fit(TongueRecording(time_s=np.arange(T) / 100, points=points), most=1)
    assert folded.limited.all() and folded.residual_mm[0] > 1
    assert fit.rig.least_radius(folded.controls[0]) >= 8e-3
    assert abs(fit.rig.volume_ratio(fit.rig.structure.rest + folded.displacements[0]) - 1) <= 0.1
