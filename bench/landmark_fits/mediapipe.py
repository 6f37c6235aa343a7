"""MediaPipe's 478 points in three dimensions, beside the models fitted to the same points in two: one frontal picture.

MediaPipe's face landmarker predicts a depth with each point, on the scale of its x, as under weak perspective. The same
net runs here; its points are the mean of the same passes. The truth are the first model's places of the points (shipped
map `face478`) on the true mesh. Points of the irises and of the oval, which slides along the silhouette, do not count.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from bench.landmark_fits.heads import HeadModel
from bench.landmark_fits.rows import Row
from coregister.synthetic.capture import Studio
from coregister.synthetic.subject import synthesize_capture
from registration.detect.crops import Crop
from registration.detect.face478 import SCHEME, Face478Provider
from registration.detect.face478_points import FACE_OVAL
from registration.geometry.closest_point import ClosestPointQuery
from registration.geometry.rigid import similarity_transform
from registration.landmark_fit.fit import fit_many
from registration.landmark_fit.observations import Observations
from registration.landmark_fit.options import FitOptions

EXPRESSIONS = ("neutral", "smile", "jaw_open", "pucker", "anger", "wink_left")
ROWS = np.setdiff1d(np.arange(468), FACE_OVAL)
NET = "MediaPipe's points"


class DepthProvider(Face478Provider):
    """The landmarker, which keeps the depth that its net predicts."""

    def __init__(self) -> None:
        self.passes: list[Float[np.ndarray, "478 3"]] = []

    def _predict(self, image: UInt8[np.ndarray, "H W 3"], crop: Crop) -> tuple[Float[np.ndarray, "478 3"], float]:
        points, presence = super()._predict(image, crop)
        self.passes.append(points)
        return points, presence


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One rendered picture with its truth."""

    image: UInt8[np.ndarray, "H W 3"]
    truth: Float[np.ndarray, "V 3"]  # metres, capture world
    net_px: Float[np.ndarray, "478 3"]  # x right, y down, z away from the camera
    observations: dict[str, Observations]  # by the name of the model


def shoot(models: list[HeadModel], seed: int, folder: Path) -> Shot | None:
    """Render a person and detect the points; None if no face was detected."""
    root = folder / f"{seed}"
    studio = Studio(cameras=1, size_px=(512, 640), seed=seed, hair=seed % 2 == 1)
    synthesize_capture(root, seed=seed, expression=EXPRESSIONS[seed % len(EXPRESSIONS)], studio=studio)
    image = np.asarray(Image.open(next((root / "images").iterdir())).convert("RGB"))
    provider = DepthProvider()
    faces = provider.detect(image)
    if not faces:
        return None
    face = faces[0]
    observations = {
        model.name: Observations.of_image(
            model.schemes[SCHEME], face.points, (image.shape[1], image.shape[0]), sigma_px=face.spread_px
        )
        for model in models
    }
    return Shot(
        image=image,
        truth=np.load(root / "ground_truth.npz")["vertices"].astype(np.float64),
        net_px=np.mean(provider.passes[1:], 0),  # the first pass only centres the crop
        observations=observations,
    )


def mediapipe(models: list[HeadModel], count: int, out: Path | None) -> tuple[list[Row], list[str]]:
    """Errors of the points after a similarity, and of their distance from the true surface, mm.

    Args:
        models: to fit; the first has the topology of the truth.
        count: pictures.
        out: where the picture `mediapipe.png` goes; None: nowhere.
    """
    first = models[0]
    with tempfile.TemporaryDirectory() as folder:
        shots = [shot for seed in range(count) if (shot := shoot(models, seed, Path(folder))) is not None]
    placed: dict[str, list[np.ndarray]] = {NET: [shot.net_px for shot in shots]}
    seconds = {}
    for model in models:
        options = FitOptions(covariance=False)
        fits = list(fit_many((shot.observations[model.name] for shot in shots), model.data, options))
        placed[model.name] = [model.schemes[SCHEME].points(model.posed(fit.parameters(0))) for fit in fits]
        seconds[model.name] = np.mean([fit.seconds for fit in fits])
    truths = [first.schemes[SCHEME].points(shot.truth) for shot in shots]
    aligned = {name: [_aligned(p, t) for p, t in zip(points, truths, strict=True)] for name, points in placed.items()}
    rows = []
    for name, points in aligned.items():
        errors = [1e3 * np.linalg.norm((p - t)[ROWS], axis=1) for p, t in zip(points, truths, strict=True)]
        depth = [1e3 * np.abs((p - t)[ROWS, 2]) for p, t in zip(points, truths, strict=True)]
        surface = [
            1e3 * ClosestPointQuery(shot.truth, first.outer_triangles).closest(p[ROWS])[0]
            for p, shot in zip(points, shots, strict=True)
        ]
        means = [np.mean(values) for values in errors]
        text = f"{np.mean(means):.2f} / {np.median(means):.2f} / {np.std(means):.2f}; {np.mean(surface):.2f}; "
        text += f"{np.mean(depth):.2f} mm" + (f"; {seconds[name]:.2f} s" if name in seconds else "")
        rows.append(Row(what=f"{name}: points (mean / median / std), surface, depth", measured=text))
    if out is not None and shots:
        _draw(shots, aligned, truths, out)
    return rows, [f"{len(shots)} of {count} faces detected; {len(ROWS)} points; after rotation, translation and scale"]


def _aligned(points: Float[np.ndarray, "478 3"], truth: Float[np.ndarray, "478 3"]) -> Float[np.ndarray, "478 3"]:
    """The points moved by the best similarity onto the truth."""
    s, R, t = similarity_transform(points[ROWS], truth[ROWS], free_scale=True)
    return s * points @ R.T + t


def _draw(shots: list[Shot], aligned: dict[str, list[np.ndarray]], truths: list[np.ndarray], out: Path) -> None:
    """Draw three faces: the picture, and the points from the side over the truth."""
    from matplotlib.figure import Figure

    some = range(min(3, len(shots)))
    figure = Figure(figsize=(3.2 * (1 + len(aligned)), 3.6 * len(some)), layout="constrained")
    axes = figure.subplots(len(some), 1 + len(aligned), squeeze=False)
    for k in some:
        axes[k, 0].imshow(shots[k].image)
        axes[k, 0].axis("off")
        for ax, (name, points) in zip(axes[k, 1:], aligned.items(), strict=True):
            error = 1e3 * np.linalg.norm((points[k] - truths[k])[ROWS], axis=1).mean()
            ax.scatter(1e3 * truths[k][ROWS, 2], 1e3 * truths[k][ROWS, 1], s=4, c="0.6", label="truth")
            ax.scatter(1e3 * points[k][ROWS, 2], 1e3 * points[k][ROWS, 1], s=3, c="tab:red", label="estimated")
            ax.set(aspect="equal", title=f"{name}: {error:.1f} mm", xlabel="forward, mm")
    axes[0, 1].set_ylabel("up, mm")
    axes[0, 1].legend(loc="lower left", fontsize=7)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "mediapipe.png", dpi=110)
