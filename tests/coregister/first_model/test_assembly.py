"""Anatomy of the first model: eyelids, joints, jaw, tongue and teeth; and recovery of its parameters."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from coregister.anatomy import eye_sections
from coregister.first_model.population import sample_unspanned_person
from registration.frames import axis_angle_to_matrix
from registration.geometry.quads import boundary_loops, triangles_of
from registration.geometry.rasterizer import rasterize
from registration.model import regions
from registration.model.gnm import GNM
from registration.model.gnm_numpy import evaluate
from registration.types import Camera, Parameters

SIDES = ("left_eye", "right_eye")
NECK, HEAD = 0, 1


@pytest.fixture(scope="module")
def template(model):
    return model.template_vertex_positions.astype(np.float64)


@pytest.fixture(scope="module")
def expressed(model, source, head_assembly):
    """Unit name -> MakeHuman's face unit projected onto the expression basis, and the face unit; displacements."""
    basis = model.expression_basis.reshape(len(model.expression_basis), -1).astype(np.float64)
    q, _ = np.linalg.qr(basis.T)

    def nearest(name):
        unit = head_assembly.expression_displacement(source.target(f"faceunits/{name}"))
        return (q @ (q.T @ unit.ravel())).reshape(unit.shape), unit

    return nearest


def members(model, *names):
    return np.logical_and.reduce([regions.group(model, name) > 0.5 for name in names])


def above_eyes(points, centres):
    """Height of points over both eyeballs (the nearer one), metres; below zero inside."""
    offset = points[None] - centres[:, None]
    distance = np.linalg.norm(offset, axis=-1)
    angle = np.arccos(np.clip(offset[..., 2] / distance, -1, 1))
    radii = (np.array(eye_sections.LIMBUS_RADIUS), np.array(eye_sections.CORNEA_RADIUS))
    return (distance - eye_sections.radius_at(angle, *radii)).min(0)


def enclosed(points, vertices, triangles):
    """Winding number of a closed surface about points (Van Oosterom and Strackee 1983): 0 outside, +-1 inside."""
    total = np.empty(len(points))
    for k, point in enumerate(points):
        a, b, c = (vertices[triangles[:, n]] - point for n in range(3))
        x, y, z = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        solid = np.einsum("ni,ni->n", a, np.cross(b, c))
        flat = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
        total[k] = np.arctan2(solid, flat).sum() / (2 * np.pi)
    return total


def visible_eye_pixels(model, vertices):
    """Number of pixels of each eye in an image from the front."""
    pose = np.diag([1.0, -1, -1, 1])
    pose[:3, 3] = 0, 0.303, 1
    intrinsics = np.array([[2000, 0, 150], [0, 2000, 60], [0, 0, 1.0]])
    camera = Camera(width_px=300, height_px=120, intrinsics=intrinsics, T_cam_world=pose)
    face, _ = rasterize(vertices, model.triangles, camera)
    vertex = model.triangles[face[face >= 0], 0]
    return [int(members(model, side)[vertex].sum()) for side in SIDES]


def test_no_skin_vertex_lies_in_an_eyeball(model, template):
    skin = members(model, "skin")
    assert above_eyes(template[skin], model.template_joint_positions[2:].astype(np.float64)).min() > 0.1e-3


def test_eyelids_stay_outside_the_eyeballs_for_all_identities(model, template):
    lids = members(model, "skin_exterior")
    heights = []
    for k in range(10):
        for c in (-3, 3):
            centres = model.template_joint_positions[2:] + c * model.joint_identity_basis[k, 2:]
            vertices = template + c * model.vertex_identity_basis[k]
            heights.append(above_eyes(vertices[lids], centres.astype(np.float64)).min())
    print(f"lids over eyeballs at +-3 deviations: {1e3 * min(heights):.2f} mm")
    assert min(heights) > -0.4e-3


def test_eyelids_of_a_sampled_person_rest_on_the_eyeballs(source, head_assembly):
    rng = np.random.default_rng(3)
    for _ in range(3):
        person = sample_unspanned_person(source, rng)
        vertices, joints = head_assembly.assemble(person, {name: source.target(name) for name in person.weights})
        height = above_eyes(vertices[head_assembly.slices["skin"]], joints[2:])
        assert height.min() > -0.1e-3  # alignment rotates the eyes slightly
        assert (np.abs(height) < 0.4e-3).sum() > 40


def test_blinking_closes_the_eyes(model, template, expressed):
    rest = visible_eye_pixels(model, template)
    assert min(rest) > 500 and abs(rest[0] - rest[1]) <= 0.02 * rest[0]
    for side, unit in enumerate(("eyeBlinkLeft", "eyeBlinkRight")):
        projected, target = expressed(unit)
        lids = members(model, "skin_exterior")
        centres = model.template_joint_positions[2:].astype(np.float64)
        deepest = above_eyes((template + projected)[lids], centres).min()
        visible_px = [visible_eye_pixels(model, template + d)[side] for d in (target, projected)]
        print(f"{unit}: {visible_px[0]} px of {rest[side]} visible, {visible_px[1]} by the basis", end="")
        print(f", lids {1e3 * deepest:.2f} mm over it")
        assert max(visible_px) < 0.05 * rest[side] and deepest > -0.2e-3
        other = visible_eye_pixels(model, template + projected)[1 - side]
        assert abs(other - rest[1 - side]) <= 0.05 * rest[1 - side]


def test_the_pupil_ranges_from_a_point_to_the_whole_iris(model, template):
    (row,) = np.flatnonzero(np.char.startswith(model.expression_names, "pupils"))
    for number, side in enumerate(SIDES):
        pupil = members(model, side, "pupils")
        iris = members(model, side, "eye_interiors") & (regions.group(model, "scleras") < 0.5)
        radius = {}
        for c in (-3, 0, 3):
            offset = template + c * model.expression_basis[row] - model.template_joint_positions[2 + number]
            radius[c] = [np.linalg.norm(offset[rows, :2], axis=1).max() for rows in (pupil, iris)]
        np.testing.assert_allclose([radius[c][1] for c in radius], radius[0][1], atol=1e-7)
        np.testing.assert_allclose([radius[c][0] / radius[c][1] for c in radius], [0, 0.5, 1], atol=1e-4)


def test_eyes_rotate_about_the_centres_of_their_eyeballs(model, template):
    for number, side in enumerate(SIDES):
        back = members(model, side, "eye_exteriors") & (template[:, 2] < model.template_joint_positions[2 + number, 2])
        distance = np.linalg.norm(template[back] - model.template_joint_positions[2 + number], axis=1)
        np.testing.assert_allclose(distance, eye_sections.SCLERA_RADIUS, atol=1e-7)


def test_the_regressor_gives_the_joints_of_every_identity(model, template):
    regressor = model.joint_regressor.astype(np.float64)
    assert regressor.min() >= 0 and (np.count_nonzero(regressor, axis=1) < 700).all()
    np.testing.assert_allclose(regressor.sum(1), 1, atol=1e-6)
    swap = [0, 1, 3, 2]
    np.testing.assert_allclose(regressor[swap][:, model.mirror_indices], regressor, atol=1e-7)
    np.testing.assert_allclose(regressor @ template, model.template_joint_positions, atol=1e-6)
    displacement = np.einsum("jv,kvd->kjd", regressor, model.vertex_identity_basis.astype(np.float64))
    error = np.linalg.norm(displacement - model.joint_identity_basis, axis=2).max()
    print(f"largest error of a joint in one component: {1e3 * error:.3f} mm")
    assert error < 0.1e-3


def test_skinning_weights(model, template):
    weights = model.skinning_weights
    np.testing.assert_allclose(weights.sum(0), 1, atol=1e-6)
    for joint, side in ((2, "left_eye"), (3, "right_eye")):
        np.testing.assert_array_equal(weights[joint], members(model, side))
    for name in ("upper_teeth_and_gums", "lower_teeth_and_gums", "tongue", "hockey_mask"):
        assert weights[HEAD, members(model, name)].min() > 0.5, name
    np.testing.assert_array_equal(weights[:2][:, model.mirror_indices], weights[:2])


def test_the_head_rotates_while_the_neck_boundary_is_fixed(model, template):
    skin = model.quads[members(model, "skin")[model.quads[:, 0]]]
    (boundary,) = boundary_loops(skin)
    neutral = {"identity": np.zeros(len(model.identity_names)), "expression": np.zeros(len(model.expression_names))}
    for axis in range(3):
        rotations = np.zeros((4, 3))
        rotations[HEAD, axis] = np.radians(30)
        posed = evaluate(model, **neutral, rotations=rotations, translation=np.zeros(3))
        assert np.linalg.norm(posed - template, axis=1)[boundary].max() < 0.5e-3
        assert np.linalg.norm(posed - template, axis=1).max() > 0.05
    rotations = np.zeros((4, 3))
    rotations[NECK, 1] = np.radians(30)  # the root rotates everything, including eyes and teeth
    posed = evaluate(model, **neutral, rotations=rotations, translation=np.zeros(3))
    joint = model.template_joint_positions[NECK].astype(np.float64)
    rotation = axis_angle_to_matrix(torch.tensor(rotations[NECK])).numpy()
    np.testing.assert_allclose(posed, (template - joint) @ rotation.T + joint, atol=1e-6)


@pytest.mark.parametrize("unit", ["jawOpen", "mouthSmileLeft", "mouthPucker", "browInnerUp", "eyeSquintRight"])
def test_the_expression_basis_spans_the_face_units(model, expressed, unit):
    projected, target = expressed(unit)
    exterior = members(model, "skin_exterior")
    residual = np.linalg.norm(projected - target, axis=1)[exterior]
    print(f"{unit}: {1e3 * np.linalg.norm(target, axis=1).max():.1f} mm, residual {1e3 * residual.max():.2f} mm")
    assert residual.max() < 3.5e-3 and np.sqrt((residual**2).mean()) < 0.3e-3


def test_the_lower_teeth_move_rigidly_with_the_jaw(model, template, expressed):
    displacement, _ = expressed("jawOpen")
    assert np.abs(displacement[members(model, "upper_teeth_and_gums")]).max() < 1e-6
    rows = members(model, "lower_teeth_and_gums")
    centred = template[rows] - template[rows].mean(0)
    linear = np.linalg.lstsq(centred, displacement[rows] - displacement[rows].mean(0), rcond=None)[0]
    np.testing.assert_allclose(linear, -linear.T, atol=1e-4)  # an infinitesimal rotation: w x p
    np.testing.assert_allclose(centred @ linear, displacement[rows] - displacement[rows].mean(0), atol=1e-5)
    assert displacement[rows, 1].mean() < -0.01 and abs(linear[1, 2]) > 0.2


def test_teeth_and_tongue_lie_in_the_mouth(model, template):
    """The oral lining, closed by a triangle fan over its boundary at the lips."""
    lining = model.quads[members(model, "mouth_sock")[model.quads].any(1)]
    (boundary,) = boundary_loops(lining)
    vertices = np.concatenate([template, template[boundary].mean(0, keepdims=True)])
    fan = np.stack([np.roll(boundary, -1), boundary, np.full(len(boundary), len(template))], 1)
    closed = np.concatenate([triangles_of(lining), fan])
    for name in ("tongue", "upper_teeth_and_gums", "lower_teeth_and_gums"):
        winding = enclosed(template[members(model, name)][::3], vertices, closed)
        np.testing.assert_allclose(winding, -1, atol=0.05, err_msg=name)  # the oral lining faces into the mouth
    assert abs(enclosed(template[members(model, "left_eye")][:1], vertices, closed)[0]) < 0.05


def test_the_tongue_at_rest_does_not_intersect_the_teeth(model, template):
    tongue = template[members(model, "tongue")]
    for name in ("upper_teeth_and_gums", "lower_teeth_and_gums"):
        quads = model.quads[members(model, name, "teeth")[model.quads[:, 0]]]
        inside = np.abs(enclosed(tongue, template, triangles_of(quads))) > 0.5
        print(f"{name}: {inside.mean():.3f} of the tongue's vertices in a tooth")
        assert inside.mean() < 0.02


def test_tongue_components_displace_only_the_tongue(model):
    rows = np.char.startswith(model.expression_names, "tongue")
    assert rows.sum() >= 3 and model.expression_names[rows][0] == "tongue_mean"
    assert not model.expression_basis[rows][:, ~members(model, "tongue")].any()


def test_identity_displacements_are_linear_and_symmetric(source, head_assembly):
    nose, ears = source.target("nose/nose-hump-incr"), source.target("head/head-oval")
    separate = [np.concatenate(head_assembly.identity_displacement(d)) for d in (nose, ears)]
    combined = np.concatenate(head_assembly.identity_displacement(nose + 2 * ears))
    np.testing.assert_allclose(combined, separate[0] + 2 * separate[1], atol=1e-9)
    vertices, joints = head_assembly.identity_displacement(ears)
    symmetric = vertices[head_assembly.mirror] * (-1, 1, 1)
    np.testing.assert_allclose(symmetric, vertices, atol=0.3e-3)  # MakeHuman's targets are not exactly symmetric
    np.testing.assert_allclose(joints[[0, 1, 3, 2]] * (-1, 1, 1), joints, atol=0.3e-3)


def test_alignment_undoes_a_rigid_motion(head_assembly):
    rotation = axis_angle_to_matrix(torch.tensor([0.1, -0.3, 0.2], dtype=torch.float64)).numpy()
    transformed = head_assembly.template @ rotation.T + (0.1, 0.2, -0.3)
    vertices, joints = head_assembly.align(transformed, head_assembly.joints @ rotation.T + (0.1, 0.2, -0.3))
    np.testing.assert_allclose(vertices, head_assembly.template, atol=1e-12)
    np.testing.assert_allclose(joints, head_assembly.joints, atol=1e-12)


def test_ten_parameter_vectors_are_recovered_from_their_vertices(model):
    gnm = GNM(model, dtype=torch.float64)
    rng = np.random.default_rng(11)
    basis = torch.cat([gnm.identity_basis, gnm.expression_basis])
    true = torch.from_numpy(rng.normal(size=(10, len(basis))))
    rest = gnm.neutral(10)
    count = len(gnm.identity_basis)
    vertices = gnm(
        Parameters(
            identity=true[:, :count],
            expression=true[:, count:],
            rotations=rest.rotations,
            translation=rest.translation,
            scale=rest.scale,
        )
    )
    estimated = torch.linalg.lstsq(basis.T, (vertices.flatten(1) - gnm.template).T).solution.T
    worst = (estimated - true).abs().max().item()
    print(f"largest error of a coefficient: {worst:.1e}")
    assert worst < 1e-4


def thinned(model, step):
    """The model of every `step`-th vertex, with almost no triangles."""
    per_vertex = ("vertex_identity_basis", "expression_basis", "skinning_weights", "joint_regressor", "vertex_groups")
    kept = {name: getattr(model, name)[:, ::step] for name in per_vertex}
    template = model.template_vertex_positions[::step]
    correctives = np.zeros((36, 3 * len(template)), np.float16)
    order = np.arange(len(template))
    faces = {"triangles": order[None, :3], "quads": order[None, :4]}
    uvs = {"triangle_uvs": model.triangle_uvs[:1], "quad_uvs": model.quad_uvs[:1]}
    rest = {"template_vertex_positions": template, "pose_correctives_regressor": correctives, "mirror_indices": order}
    return replace(model, **kept, **faces, **uvs, **rest)


def test_gauss_newton_recovers_the_parameters_of_a_rotated_head(model):
    """Rotations and translation in addition to identity and expression."""
    gnm = GNM(thinned(model, 3), dtype=torch.float64)
    sizes = [len(gnm.identity_basis), len(gnm.expression_basis), 12, 3]

    def posed(x):
        identity, expression, rotations, translation = x.split(sizes)
        return gnm(
            Parameters(
                identity=identity,
                expression=expression,
                rotations=rotations.unflatten(0, (4, 3)),
                translation=translation,
                scale=x.new_ones(()),
            )
        )

    deviations = np.repeat([1, 0.5, 0.15, 0.15], sizes)
    true = torch.from_numpy(np.random.default_rng(12).normal(size=sum(sizes)) * deviations)
    target, x = posed(true), torch.zeros_like(true)
    for _ in range(6):
        jacobian = torch.func.jacfwd(posed)(x).flatten(0, 1)
        x = x + torch.linalg.lstsq(jacobian, (target - posed(x)).flatten()[:, None]).solution[:, 0]
    worst = (x - true).abs().max().item()
    print(f"largest error of a parameter: {worst:.1e}")
    assert worst < 1e-4
