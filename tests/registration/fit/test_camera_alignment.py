"""What images, silhouettes and landmarks say about wrong cameras, on a known mesh with a known texture."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from jaxtyping import Float

from registration.fit import camera_alignment
from registration.fit.cameras import CameraCorrections, CameraEquations
from registration.inputs import RegistrationInputs, read_inputs
from registration.losses.image import pixel_agreement
from registration.model.atlas import texture_atlas
from registration.model.regions import vertex_classes
from registration.options import RegisterOptions
from registration.render import backend
from registration.render.renderer import Renderer
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Targets
from tests.registration.register import synthetic

RMS_PX = 0.8


class Scene:
    """A capture, its true mesh and its texture."""

    def __init__(self, inputs: RegistrationInputs, truth: synthetic.Truth):
        device, classes = backend.activate("llvm"), class_map(inputs.capture.classes)
        self.inputs = inputs
        self.targets = build_pyramid(inputs.capture, classes, finest_head_px=128, levels=1)[0].select(
            range(len(inputs.capture.views)), device
        )
        self.surfaces = [classes.names.index(name) for name in ("left_eye", "right_eye")]
        self.vertices = torch.as_tensor(truth.vertices, dtype=torch.float32)
        weights = vertex_classes(inputs.data)[1] @ classes.from_model
        self.renderer = Renderer(inputs.data.triangles, texture_atlas(inputs.data), weights)
        self.targets = replace(self.targets, rgb=self.targets.rgb / self._gains(truth))
        total, density = self.renderer.unwrap(
            self.vertices, self.targets.rgb, self.targets.rgb_weight, self.targets.pixels, 256
        )
        self.texture = total / density.clamp_min(1e-3)[..., None]

    def _gains(self, truth: synthetic.Truth) -> Float[torch.Tensor, "P 1"]:
        return torch.as_tensor(truth.gains, dtype=torch.float32)[self.targets.pixels.view.long()][:, None]

    def wrong(self) -> tuple[np.ndarray, Targets]:
        """Errors of the cameras of about `RMS_PX`, without a common motion, and the targets with these cameras."""
        points, rng = self.vertices.double().numpy(), np.random.default_rng(3)
        cameras = self.targets.pixels.cameras
        errors = CameraCorrections(cameras, points, np.full(len(cameras), RMS_PX))
        errors.values = rng.standard_normal((len(cameras), 7)) * errors.std
        stiff = np.eye(7) * 1e6 / errors.std[:, :, None] ** 2
        errors.solve(CameraEquations(matrix=stiff, vector=np.zeros((len(cameras), 7))), np.ones(len(cameras)))
        return errors.values, errors.apply(self.targets)

    def equations(self, targets: Targets, *, colours: bool) -> camera_alignment.CameraEquations:
        with torch.no_grad():
            rendered = self.renderer(self.vertices, self.texture, targets.pixels)
        depth = self.renderer.depth(self.vertices, targets.pixels)
        agree = pixel_agreement(rendered, targets, self.surfaces)
        return camera_alignment.from_images(rendered, depth, targets, agree, colours=colours)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    truth = synthetic.make(tmp_path_factory.mktemp("cameras") / "neutral")
    return Scene(read_inputs(truth.root, synthetic.MODEL, RegisterOptions()), truth)


def errors_px(scene: Scene, targets: Targets) -> Float[np.ndarray, "N"]:
    """The rms error of each camera of some targets."""
    points = scene.vertices.double().numpy()
    both = zip(scene.targets.pixels.cameras, targets.pixels.cameras, strict=True)
    return np.array([np.sqrt(np.square(a.project(points)[0] - b.project(points)[0]).sum(1).mean()) for a, b in both])


def refined(scene: Scene, targets: Targets, source: str) -> Targets:
    """The targets after five steps without a gauge to hold: the mesh does not follow."""
    cameras = targets.pixels.cameras
    corrections = CameraCorrections(cameras, scene.vertices.double().numpy(), np.full(len(cameras), RMS_PX))
    current = targets
    for _ in range(5):
        if source == "landmarks":
            detected = targets.landmarks["68"].double().numpy()
            detected[..., 2] = detected[..., 2] > 0.5
            points = scene.inputs.schemes["68"].points(scene.vertices.double().numpy())
            equations = camera_alignment.from_landmarks(current.pixels.cameras, points, detected)
        else:
            equations = scene.equations(current, colours=source == "colours")
        corrections.solve(equations, np.ones(len(cameras)))
        current = corrections.apply(targets)
    return current


def test_exact_cameras_stay(scene: Scene) -> None:
    assert errors_px(scene, refined(scene, scene.targets, "colours")).max() < 0.06


@pytest.mark.parametrize(("source", "limit_px"), [("colours", 0.06), ("normals", 0.06), ("landmarks", 0.2)])
def test_wrong_cameras_are_corrected(scene: Scene, source: str, limit_px: float) -> None:
    _, targets = scene.wrong()
    before, after = errors_px(scene, targets), errors_px(scene, refined(scene, targets, source))
    assert before.max() > 1 and np.sqrt(np.square(before).mean()) > 0.5
    assert after.max() < limit_px
