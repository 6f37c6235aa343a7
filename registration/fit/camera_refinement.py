"""When and from what a fit corrects its cameras: between its steps, from all views at once."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from registration.capture.colmap import read_points, write_model
from registration.capture.triangulation import triangulate
from registration.fit import camera_alignment
from registration.fit.appearance import Appearance
from registration.fit.cameras import CameraCorrections
from registration.fit.context import FitContext
from registration.fit.recipes import Stage
from registration.fit.view_weights import ViewWeights
from registration.losses import image
from registration.model.regions import head_skin
from registration.types import Capture, Targets

_EVERY = 5  # steps: by then texture and offsets have followed the last corrections
_SETTLE = 0.4  # of the last stage's steps, at its end, in which cameras stay, so that the mesh comes to rest
_LANDMARK_UPDATES = 4  # before the first stage
_MIN_CONFIDENCE = 0.5  # of a landmark
_POINTS = 500  # of the head's skin, on which shifts in the images are measured
_SUSPICIOUS = 3.0  # standard deviations of the prior


def level_sigma_px(sigma_px: float, capture: Capture, targets: Targets) -> Float[np.ndarray, "N"] | None:
    """Return the stated error of each camera in pixels of some targets; None if it is 0.

    Args:
        sigma_px: in pixels of the stored images.
        capture: of the same views.
        targets: whose images are smaller.
    """
    if not sigma_px:
        return None
    both = zip(targets.pixels.cameras, capture.views, strict=True)
    return sigma_px * np.array([camera.intrinsics[0, 0] / view.camera.intrinsics[0, 0] for camera, view in both])


class CameraRefinement:
    """The corrections of a fit's cameras, and the targets with the corrected cameras.

    Args:
        context: of the fit, with `camera_sigma_px`.
        vertices: of the initial guess; world, metres.
    """

    def __init__(self, context: FitContext, vertices: Float[Tensor, "V 3"]):
        assert context.camera_sigma_px is not None
        self._context = context
        self.pyramid: tuple[Targets, ...] = context.pyramid
        rows = np.flatnonzero(head_skin(context.data))
        points = vertices.detach().double().cpu().numpy()[rows[:: -(-len(rows) // _POINTS)]]
        self.corrections = CameraCorrections(context.pyramid[0].pixels.cameras, points, context.camera_sigma_px)

    def is_due(self, stage: Stage, step: int) -> bool:
        """Return whether cameras are corrected before a step: every few, once there is a texture."""
        last = stage.name == self._context.recipe.stages[-1].name
        return stage.texture and step > 0 and step % _EVERY == 0 and (not last or step <= (1 - _SETTLE) * stage.steps)

    def start(self, weights: ViewWeights, landmarks_used: Mapping[str, Bool[np.ndarray, "L"]]) -> None:
        """Correct the cameras by landmarks alone, before there is a mesh to compare with."""
        for _ in range(_LANDMARK_UPDATES):
            equations = self._from_landmarks(weights, landmarks_used)
            if not equations.matrix.any():
                return
            self._solve(equations, weights)

    def update(
        self,
        stage: Stage,
        vertices: Float[Tensor, "V 3"],
        appearance: Appearance,
        weights: ViewWeights,
        landmarks_used: Mapping[str, Bool[np.ndarray, "L"]],
    ) -> None:
        """Correct the cameras by images, silhouettes and landmarks.

        Args:
            stage: whose level and number of views per batch are used.
            vertices: of the mesh as it is; world, metres, without gradients.
            appearance: its texture is that of all views.
            weights: of the views.
            landmarks_used: scheme -> without outliers.
        """
        equations = self._from_landmarks(weights, landmarks_used)
        targets, context, count = self.pyramid[stage.level], self._context, self._context.view_count
        for first in range(0, count, stage.views_per_step):
            views = range(first, min(first + stage.views_per_step, count))
            batch = weights.apply(targets.select(views, context.device), views)
            with torch.no_grad():
                rendered = context.renderer(vertices, appearance.texture, batch.pixels)
                depth = context.renderer.depth(vertices, batch.pixels)
                agree = image.pixel_agreement(rendered, batch, context.separate_surfaces)
                exposed = appearance.apply_exposure(rendered, batch, views)
                found = camera_alignment.from_images(exposed, depth, batch, agree, colours=appearance.has_texture)
            rows = slice(views.start, views.stop)
            equations.matrix[rows] += found.matrix
            equations.vector[rows] += found.vector
        self._solve(equations, weights)

    def corrected(self, capture: Capture) -> Capture:
        """Return the capture of the context's views with the corrected cameras."""
        views = enumerate(capture.views)
        return replace(
            capture,
            views=tuple(replace(view, camera=self.corrections.camera(number, view.camera)) for number, view in views),
        )

    def figures(self, capture: Capture, sigma_px: float) -> dict[str, Any]:
        """Return the corrections as an entry of the manifest (docs/formats.md).

        Args:
            capture: the context's views, with the given cameras.
            sigma_px: the prior in pixels of the stored images.
        """
        views = {}
        for view, sigmas, value in zip(
            self.corrected(capture).views, self.corrections.sigmas(), self.corrections.values, strict=True
        ):
            views[view.name] = {
                "shift_px": round(float(sigmas * sigma_px), 4),
                "sigmas": round(float(sigmas), 3),
                "focal_factor": round(float(np.exp(value[6])), 7),
                "T_cam_world": view.camera.T_cam_world.tolist(),
                "intrinsics": view.camera.intrinsics.tolist(),
                "distortion": list(view.camera.distortion),
            }
        return {"sigma_px": sigma_px, "views": views, "warnings": self.warnings()}

    def write_sparse(self, capture: Capture, folder: Path) -> None:
        """Write the corrected cameras as a COLMAP model, which can replace the capture's own.

        Args:
            capture: the context's views, with the given cameras.
            folder: to be written; it must not exist.
        """
        images = capture.root / "images"
        cameras = {v.image.relative_to(images).as_posix(): v.camera for v in self.corrected(capture).views}
        write_model(folder, cameras, *read_points(capture.root / "sparse"))

    def warnings(self) -> list[str]:
        """Return a sentence for each camera whose correction the prior makes very unlikely."""
        return [
            f"The camera of view {name} is corrected by {sigmas:.1f} times the stated sigma: it may have moved."
            for name, sigmas in zip(self._context.pyramid[0].names, self.corrections.sigmas(), strict=True)
            if sigmas > _SUSPICIOUS
        ]

    def _solve(self, equations: camera_alignment.CameraEquations, weights: ViewWeights) -> None:
        self.corrections.solve(equations, weights.geometry.double().cpu().numpy())
        self.pyramid = tuple(self.corrections.apply(targets) for targets in self._context.pyramid)

    def _from_landmarks(
        self, weights: ViewWeights, landmarks_used: Mapping[str, Bool[np.ndarray, "L"]]
    ) -> camera_alignment.CameraEquations:
        finest = self.pyramid[0]
        equations = camera_alignment.CameraEquations.zeros(self._context.view_count)
        geometry = weights.geometry.double().cpu().numpy()[:, None]
        for scheme, points in self._context.triangulated.items():
            detected = finest.landmarks[scheme].double().cpu().numpy()
            detected[..., 2] = (detected[..., 2] > _MIN_CONFIDENCE) * landmarks_used[scheme] * geometry
            spread = finest.landmark_spread_px.get(scheme)
            spread_px = None if spread is None else spread.double().cpu().numpy()
            equations += camera_alignment.from_landmarks(finest.pixels.cameras, points, detected, spread_px)
        return equations


def figures(refinement: CameraRefinement | None, capture: Capture, sigma_px: float) -> dict[str, Any]:
    """Return the entry `cameras` of the manifest (`CameraRefinement.figures`); nothing without corrections."""
    return {} if refinement is None else {"cameras": refinement.figures(capture, sigma_px)}


def located(
    refinement: CameraRefinement | None,
    capture: Capture,
    landmarks: Mapping[str, Float[np.ndarray, "L 3"]],
    origin: Float[np.ndarray, "3"],
) -> dict[str, Float[np.ndarray, "L 3"]]:
    """Return where the corrected cameras, if there are any, locate landmarks.

    Args:
        refinement: None: the landmarks stay.
        capture: with the given cameras.
        landmarks: scheme -> points as the given cameras locate them; capture's world, metres.
        origin: of the fit's world, in which they are returned.
    """
    if refinement is not None:
        corrected = refinement.corrected(capture)
        landmarks = {scheme: triangulate(corrected, scheme)[0] for scheme in landmarks}
    return {scheme: points - origin for scheme, points in landmarks.items()}


def writer(refinement: CameraRefinement | None, capture: Capture) -> Callable[[Path], None] | None:
    """Return what writes the corrected cameras into a folder (`CameraRefinement.write_sparse`); None without them."""
    return None if refinement is None else partial(refinement.write_sparse, capture)
