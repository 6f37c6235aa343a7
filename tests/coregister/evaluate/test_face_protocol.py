"""The face protocol: exact fits of a model's own shapes, joints, Adam, points of regions, tables."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from coregister.evaluate.face_adam import AdamSettings, adam
from coregister.evaluate.face_data import FaceReference, FaceSample, compared, compared_gnm, face_points
from coregister.evaluate.face_fit import (
    FaceFit,
    RegisteredStage,
    ScanStage,
    distance_mm,
    fit_registered,
    least_squares,
)
from coregister.evaluate.face_protocol import CODE, ProtocolSettings, SampleTasks, evaluate_sample, planned_tasks
from coregister.evaluate.face_tables import FaceTables
from coregister.evaluate.linear_fit import twist_to_matrix
from registration.errors import InputError
from registration.frames import transform_points
from registration.geometry.closest_point import barycentric_points
from registration.geometry.surface_samples import sample_surface
from registration.linear_models.gnm import from_gnm
from registration.linear_models.model import LinearModel
from tests.coregister.spectrum import heads, spectrum_model, with_identity

MOTION = twist_to_matrix(np.array([0.2, -0.5, 0.1, 0.3, -0.2, 1.0]))
SETTINGS = ProtocolSettings(
    points=400, adam=AdamSettings(steps=40, refresh=20), components=(4,), random_heads=0, draws=100
)


@pytest.fixture(scope="module")
def model():
    return spectrum_model()


@pytest.fixture(scope="module")
def reference(model):
    return FaceReference.of_model(model)


@pytest.fixture(scope="module")
def own(model, reference):
    return compared_gnm("own", model, reference, None)


def a_head(model, seed=0):
    coefficients = np.random.default_rng(seed).standard_normal((1, len(model.vertex_identity_basis)))
    return transform_points(MOTION, heads(model, coefficients)[0].astype(np.float64))


def a_sample(model, seed=0, **changes):
    head = a_head(model, seed)
    sample = FaceSample(
        name=f"s{seed}",
        subject=f"p{seed}",
        category="neutral",
        vertices=head,
        scan=head,
        scan_triangles=model.triangles.astype(np.int64),
        tags={"age": 20 + seed},
    )
    return replace(sample, **changes)


def test_both_stages_recover_a_head_of_the_model(model, own, reference):
    face, head = own.face, a_head(model)
    assert face.articulation is None
    stage = RegisteredStage(model=face, rows=face.face, target=own.target(head)[face.face])
    fit = fit_registered(stage)
    assert fit.converged and stage.cost(fit) < 1e-16
    points = face_points(a_sample(model), reference, 400, 0)
    scan = ScanStage(model=face, points=points.fit)
    shifted = fit.moved(np.r_[0.3 * np.ones(len(face.basis)), np.full(3, 0.01), np.full(3, 1e-3)])
    assert distance_mm(scan, shifted, points.measured).mean() > 0.2
    found = least_squares(scan, shifted)
    assert found.converged
    assert distance_mm(scan, found, points.measured).mean() < 0.02


def test_linearization_is_the_derivative(model, own, reference):
    face = own.face
    points = face_points(a_sample(model, 1), reference, 400, 0)
    start = RegisteredStage(model=face, rows=face.face, target=own.target(a_head(model))[face.face])
    fit = start.start().moved(np.r_[0.2 * np.ones(len(face.basis)), np.zeros(6)])
    rng = np.random.default_rng(3)
    for stage in (start, ScanStage(model=face, points=points.fit)):
        linear = stage.linearize(fit)
        for _ in range(3):
            step = 1e-6 * rng.standard_normal(len(linear.gradient))
            change = stage.cost(fit.moved(step)) - stage.cost(fit.moved(-step))
            assert change == pytest.approx(4 * linear.gradient @ step, rel=2e-2)
        assert linear.cost == pytest.approx(stage.cost(fit), rel=1e-4)


def test_fewer_components_leave_more(model, own):
    face = own.face
    stage = RegisteredStage(model=face, rows=face.face, target=own.target(a_head(model))[face.face])
    costs = [stage.cost(fit_registered(stage, face.components["identity"][:k])) for k in (0, 3, 6, 12)]
    assert costs == sorted(costs, reverse=True) and costs[0] > 4 * costs[2]
    fitted = fit_registered(stage, face.components["identity"][:3])
    assert not fitted.coefficients[3:].any()


def test_a_joint_that_deforms_the_face_is_turned(model, reference):
    data = from_gnm(model)
    height = data.template[:, 1]
    jaw = np.clip((np.median(height[reference.members["face"]]) - height) / 0.02, 0, 1)
    weights = np.stack([1 - jaw, jaw], 1).astype(np.float32)
    middle = np.stack([data.template.mean(0), data.template.mean(0) + (0, 0.01, -0.03)])
    joints = replace(
        data.joints,
        names=("head", "jaw"),
        parents=np.array([-1, 0]),
        template=middle,
        identity_basis=np.zeros((len(data.identity_basis), 2, 3)),
        expression_basis=np.zeros((len(data.expression_basis), 2, 3)),
        weights=weights,
        correctives=None,
    )
    data = replace(data, joints=joints)
    chain = LinearModel(data, torch.float64)
    rest = chain.neutral()
    rotations = rest.rotations.clone()
    rotations[1, 0] = 0.15
    turned = chain(replace(rest, rotations=rotations)).numpy()
    own = compared("jaw", data, reference, None)
    assert own.face.articulation is not None and own.face.articulation.free == (1,)
    stage = RegisteredStage(
        model=own.face, rows=own.face.face, target=transform_points(MOTION, own.target(turned)[own.face.face])
    )
    fit = fit_registered(stage)
    assert fit.converged and np.sqrt(stage.cost(fit)) < 2e-5
    fixed = compared_gnm("fixed", model, reference, None).face
    without = RegisteredStage(model=fixed, rows=fixed.face, target=stage.target)
    assert without.cost(fit_registered(without)) > 100 * stage.cost(fit)


def test_adam_approaches_the_least_squares(model, own):
    face = own.face
    head = a_head(model) + 1e-3 * np.random.default_rng(0).standard_normal((len(model.template_vertex_positions), 3))
    stage = RegisteredStage(model=face, rows=face.face, target=own.target(head)[face.face])
    best = stage.cost(fit_registered(stage))
    start = stage.start()
    fits = [adam(stage, start, AdamSettings(steps=steps)) for steps in (200, 5000)]
    costs = [stage.cost(fit) for fit in fits]
    assert stage.cost(start) > costs[0] > costs[1] >= best
    assert costs[1] < 1.0001 * best
    assert fits[1].converged and not fits[0].converged
    still = replace(face, basis=np.concatenate([face.basis, 0 * face.basis[:1]]))
    unmoved = adam(
        replace(stage, model=still), RegisteredStage(model=still, rows=stage.rows, target=stage.target).start()
    )
    assert unmoved.coefficients[-1] == 0 and stage.cost(fits[1]) == pytest.approx(costs[1])
    np.testing.assert_allclose(unmoved.coefficients[:-1], fits[1].coefficients, atol=1e-3)
    plain = adam(stage, start, AdamSettings(steps=500, rate=2e-3, whitened=False))
    assert best < stage.cost(plain) < stage.cost(start)


def test_points_on_an_eyeball_or_far_away_are_asked_of_no_model(model, reference):
    head = a_head(model)
    face = model.triangles[reference.members["face"][model.triangles].all(1)]
    points = barycentric_points(head, face, *sample_surface(head, face, 600, np.random.default_rng(0)))
    outside = np.flatnonzero(~reference.members["face"])[:300]
    cloud = np.concatenate([points, head[outside], points + (0, 0, 0.5)])
    sample = a_sample(model, scan=cloud, scan_triangles=np.zeros((0, 3), np.int64))
    found = face_points(sample, reference, 1000, 0)
    kept = np.concatenate([found.fit, found.measured])
    assert 500 < len(kept) <= 600 and len(found.fit) == len(found.measured)
    assert {tuple(p) for p in kept} <= {tuple(p) for p in points}
    assert found.members[0].all() and found.members[1:].any(1).sum() >= 2


def test_a_scan_elsewhere_is_refused(model, own, reference):
    sample = a_sample(model)
    sample = replace(sample, scan=sample.scan + 1.0)
    with pytest.raises(InputError, match="cannot be compared"):
        evaluate_sample(sample, own, reference, SETTINGS, SampleTasks())


def test_other_results_have_another_code(model, reference):
    """Whoever changes these numbers raises CODE, or comparisons mix results of both."""
    few = compared_gnm("few", with_identity(model, model.vertex_identity_basis[4:]), reference, None)
    result = evaluate_sample(a_sample(model), few, reference, SETTINGS, SampleTasks(adam=True, curve=True))
    means = {name: float(values.mean()) for name, values in result.distances_mm.items()}
    assert CODE == 2
    assert means == pytest.approx(
        {"stage1": 0.06237, "stage2": 0.06095, "adam_stage1": 0.06922, "adam_stage2": 0.06567}, rel=1e-3
    )
    assert result.curves_mm["identity"] == pytest.approx([0.06381, 0.06196], rel=1e-3)


def test_tables_of_known_distances(model, own, reference):
    samples = [a_sample(model, seed) for seed in range(4)]
    samples[3] = replace(samples[3], subject="p2", category="jaw")
    tasks = planned_tasks(samples, replace(SETTINGS, adam_samples=1))
    assert [task.adam for task in tasks] == [True, False, False, False]
    results = [
        evaluate_sample(sample, own, reference, SETTINGS, task) for sample, task in zip(samples, tasks, strict=True)
    ]
    assert max(result.distances_mm["stage1"].max() for result in results) < 1e-3
    assert set(results[0].curves_mm) == {"identity"} and set(results[3].curves_mm) == {"lower_face"}
    known = [
        replace(result, distances_mm={**result.distances_mm, "stage2": np.full(len(result.nearest), value, np.float32)})
        for result, value in zip(results, (1.0, 2.0, 3.0, 5.0), strict=True)
    ]
    tables = FaceTables("own", samples, known, reference, SETTINGS)
    rows = {(row.stage, row.kind, row.name): row for row in tables.rows()}
    whole = rows["stage2", "face", "face"]
    assert (whole.mean.mean, whole.samples, whole.subjects) == (pytest.approx(2.75), 4, 3)
    assert whole.median in (2.0, 3.0) and whole.std == pytest.approx(np.std([1, 2, 3, 5]))
    assert rows["stage2", "category", "jaw"].median == 5.0
    assert rows["stage2", "age", "20-29"].subjects == 3
    assert sum(density.share.sum() for density in tables.density()) == pytest.approx(2)
    assert np.nanmax(tables.vertex_mm()) == 5.0
    (curve, *_) = tables.curves(own.face)
    assert curve.components == (4, 12) and curve.intervals[1].mean < 1e-3 < curve.intervals[0].mean
    agreements = {item.stage: item for item in tables.agreements()}
    assert agreements["stage1"].samples == 1 and agreements["stage2"].samples == 1
    assert agreements["stage1"].ratio.mean > 1


def test_a_step_moves_coefficients_angles_and_pose():
    fit = FaceFit(coefficients=np.zeros(2), angles=np.zeros((1, 3)), T_model_world=np.eye(4))
    moved = fit.moved(np.r_[1.0, 2.0, 0.1, 0.2, 0.3, np.zeros(3), 0.5, 0, 0])
    assert moved.coefficients.tolist() == [1, 2] and moved.angles.tolist() == [[0.1, 0.2, 0.3]]
    assert moved.T_model_world[0, 3] == 0.5
