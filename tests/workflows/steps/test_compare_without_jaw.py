"""`gnmreg model compare --without-jaw`: one file, compared with its jaw joint and without it."""

from dataclasses import replace

import numpy as np
import torch

import workflows.steps.compare
from coregister.evaluate.face_adam import AdamSettings
from coregister.evaluate.face_data import FaceSample
from coregister.evaluate.face_protocol import ProtocolSettings
from registration.frames import axis_angle_to_matrix
from registration.linear_models import plain_npz
from registration.linear_models.data import LinearModelData
from registration.linear_models.gnm import from_gnm
from registration.model import gnm_npz, regions
from tests.coregister.spectrum import heads, spectrum_model
from workflows.records.face_samples import write_samples
from workflows.steps.compare import ComparisonInput, compare_models

SETTINGS = ProtocolSettings(
    points=200, adam=AdamSettings(steps=0), components=(4,), random_heads=0, draws=100, adam_samples=1
)


def with_jaw(model: LinearModelData, share: np.ndarray) -> LinearModelData:
    """The model with a further joint, the jaw, a child of the second, that has a share of each vertex."""
    joints = model.joints

    def padded(basis: np.ndarray) -> np.ndarray:
        return np.concatenate([basis, np.zeros_like(basis[:, :1])], 1)

    weights = np.concatenate([joints.weights * (1 - share)[:, None], share[:, None]], 1)
    jaw = replace(
        joints,
        names=(*joints.names, "jaw"),
        parents=np.append(joints.parents, 1),
        template=np.concatenate([joints.template, [[0, 0.27, 0.02]]]).astype(np.float32),
        identity_basis=padded(joints.identity_basis),
        expression_basis=padded(joints.expression_basis),
        weights=weights,
        correctives=None,
    )
    return replace(model, joints=jaw)


def test_a_model_is_compared_with_and_without_its_jaw(tmp_path, monkeypatch):
    monkeypatch.setattr(workflows.steps.compare, "render_comparison_page", lambda *_: "")  # seconds of rendering
    model = spectrum_model()
    gnm_npz.write(model, tmp_path / "own.npz")
    share = regions.lower_lip_and_chin(model).astype(np.float64)
    plain_npz.write(with_jaw(from_gnm(model), share), tmp_path / "other.npz")
    R = axis_angle_to_matrix(torch.tensor([0.15, 0.0, 0.0])).numpy()
    shapes = heads(model, np.random.default_rng(0).standard_normal((2, 12)))
    pivot = np.array([0, 0.27, 0.02])
    opened = shapes + share[:, None] * ((shapes - pivot) @ R.T + pivot - shapes)
    triangles = model.triangles.astype(np.int64)
    samples = tuple(
        FaceSample(
            name=f"s{k}", subject=f"p{k}", category="jaw", vertices=shape, scan=shape, scan_triangles=triangles, tags={}
        )
        for k, shape in enumerate(opened)
    )
    write_samples(samples, triangles, tmp_path / "samples.npz")
    given = ComparisonInput(
        models=(tmp_path / "own.npz", tmp_path / "other.npz"),
        samples=tmp_path / "samples.npz",
        without_jaw=(tmp_path / "other.npz",),
    )
    comparison = compare_models(given, out=tmp_path / "out", settings=SETTINGS)
    assert comparison.models == ("own", "other", "other without jaw")
    jaw, without = (comparison.row(name, "stage1").mean.mean for name in comparison.models[1:])
    assert jaw < 0.7 * without
