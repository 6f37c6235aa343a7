"""Vertex errors and focal lengths from 600 landmarks with one pixel of noise, in one, three and eight views."""

from dataclasses import dataclass

import numpy as np

from bench.landmark_fits.heads import HeadModel
from bench.landmark_fits.pictures import FOCAL_PX, cameras_around, observe
from bench.landmark_fits.rows import Row, at_most
from registration.geometry.rigid import similarity_transform
from registration.landmark_fit.fit import fit_many
from registration.landmark_fit.options import FitOptions

VIEWS = (1, 3, 8)
POINTS = 600
_FOCALS = (0.85, 1.0, 1.18)  # of the cameras, relative to `FOCAL_PX`
FOCAL_LIMIT = 3.0  # per cent, in three views


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of one fit's face, mm: as it lies in the world, moved rigidly onto the truth, and scaled too; and of its focal
    length, per cent."""

    world: float
    rigid: float
    similarity: float
    focal_percent: float


def errors(model: HeadModel, fit, truth: np.ndarray, focal_px: float) -> Errors:  # type: ignore[no-untyped-def]
    """Mean distances of the face's vertices from where they should be."""
    fitted, true = model.posed(fit.parameters(0))[model.face], truth[model.face]
    values = [_mean_mm(fitted - true)]
    for free_scale in (False, True):
        s, R, t = similarity_transform(fitted, true, free_scale=free_scale)
        values.append(_mean_mm(s * fitted @ R.T + t - true))
    focal = 100 * abs(fit.cameras[0].intrinsics[0, 0] / focal_px - 1)
    return Errors(world=values[0], rigid=values[1], similarity=values[2], focal_percent=float(focal))


def _mean_mm(difference: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(difference, axis=1).mean())


def noise(model: HeadModel, count: int) -> list[Row]:
    """The table of one model: `count` heads for each number of views, cameras known or not."""
    rows = []
    scheme = model.face_scheme(POINTS)
    target = model.template[model.face].mean(0)
    options = FitOptions(expression_sigma=model.expression_sigma, anatomy=0, covariance=False)
    for known in (True, False):
        for views in VIEWS:
            rng = np.random.default_rng([5, views])
            truths, focals, batch = [], [], []
            for k in range(count):
                truths.append(model.vertices(model.sample(rng)))
                focals.append(FOCAL_PX * _FOCALS[k % len(_FOCALS)])
                # The nearer the camera, the shorter its lens: the face has the same size in all images.
                cameras = cameras_around(target, views, focals[-1], 0.7 * focals[-1] / FOCAL_PX)
                batch.append(observe(scheme, [truths[-1]], cameras, sigma_px=1.0, known=known, noise=rng))
            fits = list(fit_many(batch, model.data, options))
            found = [errors(model, *of) for of in zip(fits, truths, focals, strict=True)]
            name = f"{model.name}, {views} view{'s'[: views > 1]}, cameras {'known' if known else 'unknown'}"
            parts = [f"rigid {np.mean([e.rigid for e in found]):.2f} mm"]
            parts = [f"in the world {np.mean([e.world for e in found]):.2f} mm", *parts] if known else parts
            parts.append(f"with scale {np.mean([e.similarity for e in found]):.2f} mm")
            parts.append(f"{np.mean([fit.seconds for fit in fits]):.2f} s")
            rows.append(Row(what=f"{name}: face vertices", measured=", ".join(parts)))
            if not known:
                percent = np.array([e.focal_percent for e in found])
                what = f"{name}: focal length, mean and largest error"
                if views == 3:
                    row = at_most(what, float(percent.max()), FOCAL_LIMIT, "%")
                    rows.append(
                        Row(what=what, measured=f"{percent.mean():.2f}, {row.measured}", limit=row.limit, ok=row.ok)
                    )
                else:
                    rows.append(Row(what=what, measured=f"{percent.mean():.2f}, {percent.max():.2f} %"))
    return rows
