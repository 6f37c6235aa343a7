"""The studio against Mitsuba's path tracer, the NumPy rasterizer and formulas."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from coregister.first_model.build import bootstrap
from registration.errors import InputError
from registration.frames import linear_to_srgb
from registration.geometry.rasterizer import rasterize
from registration.model import gnm_npz
from registration.model.atlas import texture_atlas
from registration.model.regions import group, vertex_classes
from registration.render import backend
from registration.render.studio.canvas import fill_texture, make_canvas
from registration.render.studio.eyes import corneas, eye_frame
from registration.render.studio.light import Sky, bake_light
from registration.render.studio.noise import SolidNoise
from registration.render.studio.rig import RigOptions, make_rig
from registration.render.studio.scene import StudioScene, StudioSurface, subdivide, surface_normals
from registration.render.studio.shoot import HIDDEN_CONFIDENCE, Quality, Sensor, distorted_pixels, render_views
from registration.render.studio.skin import SkinAppearance, depth_inside_hairline, paint_head
from registration.types import Camera
from tests.conftest import FIXTURES

TINY = gnm_npz.read(FIXTURES / "tiny_gnm.npz")
HEAD_CENTRE = np.array([0.0, 0.27, 0.03])
WHITE = np.ones((4, 4, 3), np.float32)


@pytest.fixture(autouse=True)
def llvm():
    backend.activate()


def head(data=TINY, texels=256, **settings) -> StudioSurface:
    return StudioSurface(
        vertices=data.template_vertex_positions.astype(np.float64),
        triangles=data.triangles.astype(np.int64),
        corner_uvs=texture_atlas(data),
        texture=paint_head(data, make_canvas(data, texels), SkinAppearance(**settings)),
        classes=vertex_classes(data)[1],
        transparent=corneas(data),
    )


def ball(radius=0.1, centre=(0.0, 0.0, 0.0), texture=WHITE, fineness=3) -> StudioSurface:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=fineness, radius=radius)
    return StudioSurface(
        vertices=mesh.vertices + centre,
        triangles=np.array(mesh.faces),
        corner_uvs=np.full((len(mesh.faces), 3, 2), 0.5, np.float32),
        texture=texture,
        classes=np.ones((len(mesh.vertices), 1), np.float32),
    )


def plain_camera(yaw: float, *, width=90, height=120, distance=0.8, focal=280.0, centre=HEAD_CENTRE) -> Camera:
    """Square pixels and a centred principal point, as Mitsuba's simplest camera has them."""
    z = -np.array([np.sin(yaw), 0.1, np.cos(yaw)])
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 1, 0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = [0, 0, distance] - pose[:3, :3] @ centre
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(width_px=width, height_px=height, intrinsics=K, T_cam_world=pose)


def path_traced(surface: StudioSurface, camera: Camera, sky: Sky, samples: int) -> np.ndarray:
    """The same scene by Mitsuba's `path` integrator: with separate meshes, textures, environment and camera."""
    import mitsuba as mi

    kept = np.ones(len(surface.triangles), bool) if surface.transparent is None else ~surface.transparent
    corners = surface.triangles[kept].ravel()
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(surface.texture.astype(np.float32)), "raw": True}
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": texture | {"wrap_mode": "clamp"}})
    mesh = mi.Mesh("head", len(corners), len(corners) // 3, properties, True, True)
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = mi.Float(surface.vertices[corners].astype(np.float32).ravel())
    arrays["vertex_normals"] = mi.Float(surface_normals(surface)[corners].astype(np.float32).ravel())
    uvs = surface.corner_uvs[kept].reshape(-1, 2) * (1, -1) + (0, 1)
    arrays["vertex_texcoords"] = mi.Float(uvs.astype(np.float32).ravel())
    arrays["faces"] = mi.UInt32(np.arange(len(corners), dtype=np.uint32))
    arrays.update()
    rows, columns = 64, 128
    theta = np.pi * (np.arange(rows) + 0.5)[:, None] / rows
    phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    towards = np.stack(
        np.broadcast_arrays(np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)), -1
    )
    frame = np.eye(4)
    frame[:3, :3] = camera.T_cam_world[:3, :3].T * (-1, -1, 1)  # Mitsuba's camera: x left, y up, z forward
    frame[:3, 3] = camera.centre
    scene = mi.load_dict(
        {
            "type": "scene",
            "mesh": mesh,
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky.radiance(towards).astype(np.float32))},
            "camera": {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(camera.width_px / 2 / camera.intrinsics[0, 0]))),
                "fov_axis": "x",
                "to_world": mi.ScalarTransform4f(frame),
                "near_clip": 0.01,
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width_px,
                    "height": camera.height_px,
                    "rfilter": {"type": "box"},
                },
            },
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": 8, "rr_depth": 100})
    return np.array(mi.render(scene, integrator=integrator, spp=samples, seed=1))[..., :3]


def area_2d(xy: np.ndarray) -> float:
    """Twice the area inside a polygon."""
    following = np.roll(xy, -1, 0)
    return float((xy[:, 0] * following[:, 1] - xy[:, 1] * following[:, 0]).sum())


def rms_255(view, reference: np.ndarray) -> float:
    """Over pixels that the surface covers wholly."""
    inside = view.mask > 0.999
    assert inside.mean() > 0.15
    difference = linear_to_srgb(view.rgb)[inside] - linear_to_srgb(reference)[inside]
    print(f"rms {255 * np.sqrt((difference**2).mean()):.3f} / 255")
    return float(255 * np.sqrt((difference**2).mean()))


@pytest.mark.parametrize("yaw", [0.2, -1.1])
def test_images_equal_full_path_tracing(yaw):
    surface, sky, camera = head(), Sky(), plain_camera(yaw)
    [view] = render_views(
        [surface], [camera], sky=sky, quality=Quality(pixel_samples=6, light_rays=512, subdivisions=2)
    )
    reference = path_traced(surface, camera, sky, 512)
    assert rms_255(view, reference) < 5
    # The image is not constant: a constant would pass with any light.
    dimmer = path_traced(surface, camera, replace(sky, towards=(-1.0, -0.5, 0.1)), 64)
    assert rms_255(view, dimmer) > 10


@pytest.mark.slow
def test_images_of_eyes_under_corneas_equal_full_path_tracing():
    try:
        data = gnm_npz.read(bootstrap())
    except InputError as error:
        pytest.skip(f"{error.what}: {error.got}")
    surface, sky = head(data, 1024), Sky()
    assert surface.transparent.sum() > 100
    for camera in (plain_camera(0.3), plain_camera(0.1, focal=1500.0, centre=np.array([0.03, 0.305, 0.1]))):
        [view] = render_views([surface], [camera], sky=sky, quality=Quality(pixel_samples=6))
        difference = rms_255(view, path_traced(surface, camera, sky, 256))
        print(f"{difference:.2f} of 255")
        assert difference < 5


def test_light_on_a_ball_equals_its_formula():
    """Nothing shades a ball: its irradiance over pi is brightness (1 + 2/3 contrast cos)."""
    sky = Sky(brightness=0.7, contrast=0.6, towards=(0.0, 2.0, 1.0), tint=(1.0, 0.8, 0.5))
    scene = StudioScene([ball()])
    light = bake_light(scene, sky, rays=256, seed=3)
    towards = np.array([0, 2, 1]) / np.sqrt(5)
    expected = 0.7 * (1 + 2 / 3 * 0.6 * (scene.normals @ towards))[:, None] * [1, 0.8, 0.5]
    assert np.abs(light - expected).max() < 0.01


def test_light_is_reflected_between_surfaces():
    """Inside a closed shell of albedo a no sky is visible; near a grey ball, light of its colour arrives."""
    alone = bake_light(StudioScene([ball()]), Sky(contrast=0.0, brightness=1.0))
    red = np.broadcast_to(np.array([0.9, 0.0, 0.0], np.float32), (4, 4, 3))
    scene = StudioScene([ball(), ball(0.5, (0.0, 0.0, -0.61), red)])
    light = bake_light(scene, Sky(contrast=0.0, brightness=1.0))[: len(alone)]
    near = scene.vertices[: len(alone), 2] < -0.09
    assert light[near, 1].mean() < 0.2 < 0.6 < light[near, 0].mean()
    assert np.abs(light[scene.vertices[: len(alone), 2] > 0.099] - 1).max() < 0.01


def test_normals_equal_those_of_the_mesh():
    """At pixel centres, within one degree of angle-weighted normals at the faces of the NumPy rasterizer."""
    surface = head()
    cameras = make_rig(RigOptions(cameras=3, size_px=(150, 200), seed=5, spread_deg=(80, 30)), centre=HEAD_CENTRE)
    corners = surface.vertices[surface.triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(surface.vertices)
    angles = trimesh.Trimesh(surface.vertices, surface.triangles, process=False).face_angles
    unit = area / np.linalg.norm(area, axis=1, keepdims=True)
    np.add.at(normals, surface.triangles.ravel(), (angles[..., None] * unit[:, None]).reshape(-1, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for view in render_views([surface], cameras, quality=Quality(pixel_samples=1, light_rays=16)):
        face, weights = rasterize(surface.vertices, surface.triangles, view.camera)
        hit = view.normals.any(-1)
        assert (hit == (face >= 0)).mean() > 0.999 and (hit == (view.labels > 0)).all()
        both = hit & (face >= 0)
        expected = (weights[both][..., None] * normals[surface.triangles[face[both]]]).sum(1)
        behind = (
            np.einsum(
                "pi,pi->p", area[face[both]], surface.vertices[surface.triangles[face[both], 0]] - view.camera.centre
            )
            > 0
        )
        expected = np.where(behind[:, None], -expected, expected) @ view.camera.T_cam_world[:3, :3].T
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        cosine = (expected * view.normals[both]).sum(1)
        assert np.degrees(np.arccos(np.clip(np.quantile(cosine, 0.01), -1, 1))) < 1
        assert np.abs(np.linalg.norm(view.normals[both], axis=1) - 1).max() < 1e-5
        labels = surface.classes[surface.triangles[face[both]]]
        labels = 1 + (weights[both][..., None] * labels).sum(1).argmax(1)
        assert (labels == view.labels[both]).mean() > 0.99


def test_the_mask_is_coverage_through_the_lens():
    """A ball's silhouette is a cone: its coverage is known, and its outline bends as OpenCV says."""
    camera = replace(
        make_rig(RigOptions(cameras=1, size_px=(200, 200)), head_height_m=0.24)[0], distortion=(0.6, -2.0, 0.02, -0.01)
    )
    [view] = render_views([ball(fineness=6)], [camera], quality=Quality(pixel_samples=4, light_rays=4, subdivisions=0))
    to_ball = -camera.centre
    distance = np.linalg.norm(to_ball)
    axis = to_ball / distance
    side = np.cross(axis, [0.0, 1, 0])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)[:, None]
    radius = np.tan(np.arcsin(0.1 / distance))
    outline = camera.centre + axis + radius * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    xy = distorted_pixels(camera, outline)
    expected = 0.5 * abs(area_2d(xy))
    assert view.mask.sum() == pytest.approx(expected, rel=1e-3)
    straight = 0.5 * abs(area_2d(camera.project(outline)[0]))
    assert abs(straight / expected - 1) > 0.005


def test_transparent_faces_appear_only_in_masks_and_labels():
    inner, outer = ball(0.08, texture=np.full((4, 4, 3), 0.5, np.float32)), ball(0.1)
    inner = replace(inner, classes=np.tile([1.0, 0.0], (len(inner.vertices), 1)).astype(np.float32))
    outer = replace(
        outer,
        classes=np.tile([0.0, 1.0], (len(outer.vertices), 1)).astype(np.float32),
        transparent=np.ones(len(outer.triangles), bool),
    )
    camera = plain_camera(0.0, centre=np.zeros(3))
    quality = Quality(pixel_samples=2, light_rays=64)
    [alone], [both] = (render_views(surfaces, [camera], quality=quality) for surfaces in ([inner], [inner, outer]))
    np.testing.assert_allclose(both.rgb, alone.rgb, atol=1e-6)
    assert set(np.unique(both.labels)) == {0, 2} and both.mask.sum() > 1.4 * alone.mask.sum()


def test_landmarks_are_hidden_behind_the_head_and_outside_the_image():
    camera = plain_camera(0.0, centre=np.zeros(3))
    points = np.array([[0.0, 0, 0.1], [0.0, 0, -0.1], [0.0, 0.3, 0.0], [0.05, 0.0, 0.2]])
    [view] = render_views([ball()], [camera], landmarks={"four": points}, quality=Quality(light_rays=4))
    np.testing.assert_allclose(view.landmarks["four"][:, 2], [1, HIDDEN_CONFIDENCE, HIDDEN_CONFIDENCE, 1])
    np.testing.assert_allclose(view.landmarks["four"][:, :2], camera.project(points)[0], atol=1e-9)


def test_equal_seeds_give_equal_images():
    surface = head()
    cameras = make_rig(RigOptions(cameras=2, size_px=(60, 80), spread_deg=(40, 0)), centre=HEAD_CENTRE)
    sensor = Sensor(shot_noise=0.02, read_noise=0.005, exposure_spread=0.1, colour_spread=0.05)

    def rendered_views(seed):
        return render_views([surface], cameras, sensor=sensor, quality=Quality(light_rays=64), seed=seed)

    first, again, other = rendered_views(1), rendered_views(1), rendered_views(2)
    for a, b, c in zip(first, again, other, strict=True):
        for name in ("rgb", "mask", "normals", "labels"):
            assert (getattr(a, name) == getattr(b, name)).all()
        assert (a.rgb != c.rgb).mean() > 0.5 and (a.labels == c.labels).all()
    first, again, other = (make_rig(RigOptions(cameras=5, seed=seed))[0].T_cam_world for seed in (1, 1, 2))
    assert (first == again).all() and (first != other).any()


def test_noise_and_gains_equal_the_sensor_settings():
    camera = plain_camera(0.0, centre=np.zeros(3))
    quality = Quality(pixel_samples=1, light_rays=4)

    def background(count, **settings):
        views = render_views(
            [ball(0.02)], [camera] * count, sensor=Sensor(**settings), background=(0.25, 0.25, 0.25), quality=quality
        )
        return np.stack([view.rgb[:30].reshape(-1, 3) for view in views])  # above the ball

    noisy = background(1, shot_noise=0.04, read_noise=0.01)
    assert noisy.std() == pytest.approx(np.sqrt(0.04**2 * 0.25 + 0.01**2), rel=0.03)
    gains = background(40, exposure_spread=0.1, colour_spread=0.03).mean(1) / 0.25
    assert gains.mean(1).std() == pytest.approx(0.1, rel=0.4)
    assert (gains / gains.mean(1, keepdims=True)).std() == pytest.approx(0.03 * np.sqrt(2 / 3), rel=0.4)


def test_subdivision_preserves_shape_and_attributes():
    surface = head()
    fine = subdivide(surface)
    assert len(fine.triangles) == 4 * len(surface.triangles) and len(fine.transparent) == len(fine.triangles)

    def area(s):
        a, b, c = s.vertices[s.triangles].transpose(1, 0, 2)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    np.testing.assert_allclose(area(fine).reshape(4, -1).sum(0), area(surface), rtol=1e-9, atol=1e-15)
    rng = np.random.default_rng(0)
    values = rng.random((len(surface.vertices), 3))
    uv_surface = subdivide(replace(surface, vertices=values))
    uvs = subdivide(replace(surface, corner_uvs=values[surface.triangles][..., :2]))
    np.testing.assert_allclose(uvs.corner_uvs, uv_surface.vertices[uv_surface.triangles][..., :2], atol=1e-12)


def test_noise_is_a_function_of_space():
    points = np.random.default_rng(1).random((5000, 3)) * 0.2
    noise = SolidNoise(points).smooth(0.02, 7, octaves=2)
    assert 0.8 < noise.std() < 1.2 and abs(noise.mean()) < 0.1
    np.testing.assert_array_equal(SolidNoise(points[::-1]).smooth(0.02, 7, octaves=2)[::-1], noise)
    near = SolidNoise(points + 1e-5).smooth(0.02, 7, octaves=2)
    assert np.abs(near - noise).max() < 0.02 and np.abs(SolidNoise(points).smooth(0.02, 8) - noise).mean() > 0.5
    distance, number = SolidNoise(points).dots(0.01, 1)
    assert 0.2 < distance.mean() / 0.01 < 0.6 and 0 <= number.min() and number.max() < 1
    assert np.abs(SolidNoise(points + 1e-4).dots(0.01, 1)[0] - distance).max() < 2e-4


def test_the_texture_has_no_seams():
    """Faces on both sides of a seam of the texture map have equal colours along it."""
    texture = paint_head(TINY, make_canvas(TINY, 1024), SkinAppearance(freckles=0.0, stubble=0.0))
    surface = replace(head(), texture=cv2.blur(texture, (5, 5)))
    scene = StudioScene([surface])
    from registration.geometry.topology import edges

    mesh_edges = edges(TINY.triangles)
    uvs = surface.corner_uvs.reshape(-1, 2)
    inner = mesh_edges.faces[:, 1] >= 0
    ends = mesh_edges.corners[inner]
    cut = np.abs(uvs[ends[:, 0]] - uvs[ends[:, 1]]).max((1, 2)) > 0.02
    assert cut.sum() > 10

    def colours(corner):  # slightly inside the face, at the midpoint of the edge
        face = corner[:, 0] // 3
        uv = 0.49 * uvs[corner[:, 0]] + 0.49 * uvs[corner[:, 1]] + 0.02 * uvs.reshape(-1, 3, 2)[face].mean(1)
        size = surface.texture.shape[0]
        x, y = (uv * (1, -1) + (0, 1)).T * size
        return surface.texture[y.astype(int), x.astype(int)]

    first, second = colours(ends[cut, 0]), colours(ends[cut, 1])
    skin = group(TINY, "skin")[mesh_edges.vertices[inner][cut]].min(1) > 0.5
    assert np.abs(first - second)[skin].mean() < 0.15 * first[skin].std(0).max() + 0.02
    assert scene.vertex_albedo().shape == TINY.template_vertex_positions.shape


def test_facial_features_are_painted_at_their_vertices():
    """Iris, pupil, brows and lips have their colours at their vertices; the two eyes look alike."""
    surface = head(texels=512)
    albedo = StudioScene([surface]).vertex_albedo()
    frame = eye_frame(TINY, "left_eye")
    points = TINY.template_vertex_positions.astype(np.float64)
    _, radius, _ = frame.cylindrical(points)
    eye = group(TINY, "left_eye") > 0.5
    front = eye & (points[:, 2] > frame.centre[2])
    assert albedo[front & (radius < 0.5 * frame.pupil_radius)].max() < 0.1
    assert albedo[front & (radius > 1.5 * frame.iris_radius)].min() > 0.3
    cheek = albedo[group(TINY, "left_cheek_region") > 0.5].mean(0)
    lip = albedo[group(TINY, "lower_lip") > 0.5].mean(0)
    assert lip[1] / lip[0] < 0.8 * cheek[1] / cheek[0]
    dark = paint_head(TINY, make_canvas(TINY, 256), SkinAppearance(melanin=2.0))
    assert dark.mean() < 0.6 * surface.texture.mean() and dark.min() >= 0 and surface.texture.max() <= 1


def test_the_hairline_does_not_cover_face_and_ears():
    depth_m = depth_inside_hairline(TINY)
    points = TINY.template_vertex_positions
    assert (depth_m[(group(TINY, "hockey_mask") > 0.5) | (group(TINY, "ears") > 0.5)] < 0).all()
    assert depth_m[points[:, 1].argmax()] > 0.02 and (depth_m[points[:, 1] < 0.2] < 0).all()


def test_sampled_appearances_differ_and_are_plausible():
    looks = [SkinAppearance.sample(seed) for seed in range(30)]
    assert looks[3] == SkinAppearance.sample(3) and len({look.melanin for look in looks}) == 30
    for look in looks:
        assert 0.2 < look.melanin < 2.2 and 0 <= look.freckles <= 1 and 0 <= look.stubble <= 1
        assert all(0 < value < 0.5 for value in (*look.hair, *look.iris))


def test_the_canvas_covers_every_face_and_fills_the_remaining_texels():
    page = make_canvas(TINY, 256)
    points = page.interpolate(TINY.template_vertex_positions)
    assert np.isfinite(points).all() and (page.weights.sum(1) == pytest.approx(1, abs=1e-5))
    texture = fill_texture(256, page.texel, points)
    assert (texture.reshape(-1, 3)[page.texel] == points).all()
    assert {tuple(row) for row in texture.reshape(-1, 3).tolist()} == {tuple(row) for row in points.tolist()}
