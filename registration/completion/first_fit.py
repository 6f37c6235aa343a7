"""The model fitted to what a capture shows so far: where the head is, before masks, labels and depths are made."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from registration.capture.triangulation import spreads_m, triangulate
from registration.fit.context import FitContext
from registration.fit.initialization import MIN_LANDMARKS
from registration.fit.landmark_start import seen_landmarks
from registration.fit.problem import FitProblem
from registration.fit.recipes import Recipe, expression_recipe, in_model
from registration.fit.start import initial_guess
from registration.fit.variables import InitialGuess, Variables, initial_guess_from
from registration.model.atlas import texture_atlas
from registration.model.gnm import GNM
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import LandmarkScheme
from registration.model.regions import head_skin
from registration.targets.classes import class_map
from registration.targets.pyramid import build_pyramid
from registration.types import Camera, Capture, HeadPose, Registration

_HEAD_PX = 128  # height of the head in the images that are fitted
_RADIUS = 1.05  # of the head's sphere, relative to its farthest vertex


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedHead:
    """A head in the world, metres: the model's parameters, and its vertices."""

    guess: InitialGuess  # where a further fit starts
    vertices: Float[np.ndarray, "V 3"]
    centre: Float[np.ndarray, "3"]  # of a sphere around the head without the neck
    radius_m: float


class HeadFitter:
    """Fits the model, without free offsets, to a capture as far as it is complete.

    Args:
        data: the head model.
        schemes: its landmark schemes.
        neutral: of the subject, if the capture shows an expression; its identity, size and offsets are kept.
        seed: of the views' order.
        device: of the fit.
    """

    def __init__(
        self,
        data: GNMData,
        schemes: Mapping[str, LandmarkScheme],
        *,
        neutral: Registration | None,
        seed: int,
        device: torch.device,
    ):
        self.data, self.schemes, self._neutral, self._seed = data, schemes, neutral, seed
        self._model = GNM(data, device=device)
        recipe = in_model()
        first = replace(recipe.stages[0], level=0)
        recipe = replace(recipe, name="completion", finest_head_px=_HEAD_PX, levels=1, stages=(first,))
        self._recipe: Recipe = recipe if neutral is None else expression_recipe(recipe)

    def start(self, capture: Capture, head: HeadPose | None) -> FittedHead:
        """Return the head as an initial guess has it: from landmarks in closed form, else from masks.

        Args:
            capture: with cameras in the world of the result.
            head: the pose that the capture brings, if any.

        Raises:
            InputError: neither landmarks nor masks say where the head is.
        """
        return self._head(initial_guess(self._context(capture, None), head))

    def fit(self, capture: Capture, start: FittedHead) -> FittedHead:
        """Return the head after the model's parameters were fitted to all channels of the capture.

        Args:
            capture: with cameras in the world of the result.
            start: where the fit begins.
        """
        problem = FitProblem(self._context(capture, start), start.guess)
        trace = problem.run(self._recipe.stages)
        if trace.failure:
            return start
        parameters, _ = problem.variables.parameters()
        offsets = (
            np.zeros_like(self.data.template_vertex_positions) if start.guess.offsets is None else start.guess.offsets
        )
        detached = type(parameters)(**{name: value.detach() for name, value in vars(parameters).items()})
        guess = initial_guess_from(detached, offsets, self._model, self.data)
        return self._head(
            replace(
                guess, offsets=start.guess.offsets, landmarks_used=start.guess.landmarks_used, notes=start.guess.notes
            )
        )

    def head_rows(self, head: FittedHead, capture: Capture) -> dict[str, int]:
        """Return the height of the head without its neck in each view, px of the stored image."""
        points = head.vertices[head_skin(self.data)]
        return {view.name: _rows(points, view.camera) for view in capture.views}

    def _head(self, guess: InitialGuess) -> FittedHead:
        variables = Variables(self._model, self.data, guess)
        with torch.no_grad():
            vertices = variables.vertices(variables.skin_offsets()).double().cpu().numpy()
        skin = vertices[head_skin(self.data)]
        centre = (skin.min(0) + skin.max(0)) / 2
        radius = _RADIUS * float(np.linalg.norm(skin - centre, axis=1).max())
        return FittedHead(guess=guess, vertices=vertices, centre=centre, radius_m=radius)

    def _context(self, capture: Capture, start: FittedHead | None) -> FitContext:
        shared = {name for view in capture.views for name in view.landmarks} & set(self.schemes)
        triangulated = {name: triangulate(capture, name)[0] for name in sorted(shared)}
        located = any(np.isfinite(points).all(1).sum() >= MIN_LANDMARKS for points in triangulated.values())
        classes = class_map(capture.classes)
        pyramid = (
            ()
            if start is None and located
            else build_pyramid(
                capture,
                classes,
                finest_head_px=self._recipe.finest_head_px,
                levels=self._recipe.levels,
                head_rows=None if start is None else self.head_rows(start, capture),
            )
        )
        return FitContext(
            data=self.data,
            model=self._model,
            pyramid=pyramid,
            classes=classes,
            schemes=self.schemes,
            corner_uvs=texture_atlas(self.data),
            recipe=self._recipe,
            seed=self._seed,
            neutral=self._neutral,
            triangulated=triangulated,
            triangulated_spread_m=spreads_m(capture, triangulated),
            seen_landmarks=seen_landmarks(capture, self.schemes),
        )


def _rows(points: Float[np.ndarray, "P 3"], camera: Camera) -> int:
    pixels, depth = camera.project(points)
    rows = pixels[depth > 0, 1].clip(0, camera.height_px)
    return max(1, int(np.ptp(rows))) if len(rows) else camera.height_px
