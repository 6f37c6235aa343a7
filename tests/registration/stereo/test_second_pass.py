import numpy as np
import pytest

from registration.stereo.agreement import Measured, join
from registration.stereo.second_pass import SecondPassOptions, refined_depths
from registration.stereo.views import StereoView
from tests.registration.stereo.scene import camera, egg, errors, scene


def moved(vertices: np.ndarray, by_m: float) -> np.ndarray:
    """A surface that waves around the true one."""
    centred = vertices - vertices.mean(0)
    outward = centred / np.linalg.norm(centred, axis=1, keepdims=True)
    return vertices + outward * (by_m * np.sin(centred @ [60.0, 45.0, 50.0]))[:, None]


@pytest.fixture(scope="module")
def made():
    return scene((-22, 0, 22))


def test_second_pass_finds_the_true_surface_from_one_millimetres_away(made):
    maps = refined_depths(made.views, moved(made.vertices, 1.5e-3), made.triangles)
    found = [errors(one, view.camera, seen) for one, view, seen in zip(maps, made.views, made.truth, strict=True)]
    assert found[1][0] > 0.85
    assert max(np.median(wrong) for _, wrong, _ in found) < 0.2  # a pixel is 1.4 mm wide
    assert max(np.median(angle) for _, _, angle in found) < 4
    assert all(((one.depth > 0) == (one.confidence > 0)).all() for one in maps)


def test_gains_and_offsets_of_exposure_do_not_matter(made):
    changed = [
        StereoView(image=np.clip(gain * view.image + offset, 0, 1).astype(np.float32), camera=view.camera)
        for view, gain, offset in zip(made.views, (0.6, 1.0, 0.8), (0.0, 0.0, 0.1), strict=True)
    ]
    maps = refined_depths(changed, moved(made.vertices, 1e-3), made.triangles)
    coverage, wrong, _ = errors(maps[1], made.views[1].camera, made.truth[1])
    assert coverage > 0.8
    assert np.median(wrong) < 0.2


def test_a_surface_far_from_the_true_one_gets_little_confidence(made):
    """Neither wrong depths beside a hat nor beside a head that stands elsewhere."""
    away = made.vertices + (made.vertices - made.vertices.mean(0)) * 0.15  # 13 mm outwards
    near = refined_depths(made.views, made.vertices, made.triangles)[1]
    far = refined_depths(made.views, away, made.triangles)[1]
    assert (far.confidence > 0.3).sum() < 0.02 * (near.confidence > 0.3).sum()


def test_skin_without_texture_gets_no_depth():
    flat = scene((-22, 0, 22), contrast=0.0)
    maps = refined_depths(flat.views, moved(flat.vertices, 1e-3), flat.triangles)
    assert errors(maps[1], flat.views[1].camera, flat.truth[1])[0] < 0.1


def test_wide_ranges_are_searched_from_small_images(made):
    options = SecondPassOptions(reach_m=16e-3)
    maps = refined_depths(made.views, moved(made.vertices, 4e-3), made.triangles, options)
    coverage, wrong, _ = errors(maps[1], made.views[1].camera, made.truth[1])
    assert coverage > 0.7
    assert np.median(wrong) < 0.3


def test_joined_depths_are_the_mean_of_what_views_found():
    vertices, triangles = egg()
    made = scene((-20, 20))
    noise = np.random.default_rng(1)
    measured = [
        Measured(
            camera=view.camera,
            depth=np.where(seen.weight > 0, seen.depth + noise.normal(0, 3e-4, seen.depth.shape), 0).astype(np.float32),
            sigma=np.full(seen.depth.shape, 3e-4, np.float32),
        )
        for view, seen in zip(made.views, made.truth, strict=True)
    ]
    joined = join(0, [1], measured)
    shared = (joined.agreeing > 0) & (made.truth[0].weight > 0.5)
    assert shared.mean() > 0.15
    before = np.abs(measured[0].depth - made.truth[0].depth)[shared].mean()
    after = np.abs(joined.depth - made.truth[0].depth)[shared].mean()
    assert after < 0.85 * before
    assert np.median(joined.sigma[shared]) < 3e-4


def test_a_view_that_contradicts_is_not_averaged():
    made = scene((0, 25))
    right, wrong = (
        Measured(
            camera=view.camera,
            depth=np.where(seen.weight > 0, seen.depth + off, 0).astype(np.float32),
            sigma=np.full(seen.depth.shape, 1e-4, np.float32),
        )
        for view, seen, off in zip(made.views, made.truth, (0, 2e-3), strict=True)
    )
    joined = join(0, [1], [right, wrong])
    compared = joined.compared > 0
    assert compared.any()
    assert joined.agreeing.sum() < 0.02 * compared.sum()


def test_views_that_do_not_show_the_surface_have_no_map(made):
    beside = StereoView(image=np.zeros((200, 200), np.float32), camera=camera(10).cropped(900, 0, 200, 200))
    assert refined_depths([*made.views, beside], made.vertices, made.triangles)[3] is None
