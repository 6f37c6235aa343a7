"""`gnmreg model landmarks`: the map from a detector's landmarks to points on a head model."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.detect.map_checks import draw_map
from registration.detect.map_make import MadeMap, make_map, refuse_failed
from registration.detect.map_renders import RenderSettings
from registration.detect.providers import load_provider
from registration.errors import InputError
from registration.export.arkit import arkit_shapes
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import scheme_file, write_scheme_file
from registration.progress import Progress
from registration.storage.files import check_output_file

_BOTH = ("Left", "Right")
EXPRESSIONS: Mapping[str, Mapping[str, float]] = {  # of the rendered heads: weights of ARKit's shapes
    "jaw open": {"jawOpen": 0.9},
    "mouth ajar": {"jawOpen": 0.35},
    "smile": {f"mouthSmile{side}": 0.9 for side in _BOTH},
    "smile with teeth": {"jawOpen": 0.25}
    | {f"mouth{move}{side}": 0.7 for move in ("Smile", "UpperUp") for side in _BOTH},
    "closed lids": {f"eyeBlink{side}": 1.0 for side in _BOTH},
    "squint": {f"eyeSquint{side}": 1.0 for side in _BOTH},
    "wide eyes": {f"eyeWide{side}": 1.0 for side in _BOTH} | {"browInnerUp": 0.6},
    "brows up": {"browInnerUp": 0.9} | {f"browOuterUp{side}": 0.9 for side in _BOTH},
    "brows down": {f"browDown{side}": 0.9 for side in _BOTH},
    "pucker": {"mouthPucker": 0.8},
    "funnel": {"mouthFunnel": 0.8},
    "frown": {f"mouthFrown{side}": 0.9 for side in _BOTH},
    "look left": {"eyeLookOutLeft": 0.7, "eyeLookInRight": 0.7},
    "look right": {"eyeLookInLeft": 0.7, "eyeLookOutRight": 0.7},
    "look down": {f"eyeLookDown{side}": 0.7 for side in _BOTH},
    "shout": {"jawOpen": 0.8} | {f"{move}{side}": 0.6 for move in ("browDown", "eyeSquint") for side in _BOTH},
}


def expressions(data: GNMData) -> dict[str, Float[np.ndarray, "V 3"]]:
    """Return the displacements, metres, of the expressions whose every shape the model's basis can make.

    Raises:
        InputError: the model lacks the edges of lids or lips, by which the shapes are defined.
    """
    shapes = arkit_shapes(data, data.template_vertex_positions.astype(np.float64)).displacements
    return {
        name: np.sum([weight * shapes[shape] for shape, weight in weights.items()], axis=0)
        for name, weights in EXPRESSIONS.items()
        if all(shape in shapes for shape in weights)
    }


def make_landmark_map(
    model: Path, provider: str, out: Path | None, settings: RenderSettings, picture: Path | None, progress: Progress
) -> tuple[Path, list[str]]:
    """Make the map of a detector's landmarks on a model and write it.

    Args:
        model: a GNM NPZ file.
        provider: name or import path of the landmark provider.
        out: the file to write; None: `head_sparse_SCHEME.txt` beside the model.
        settings: number of heads, seed.
        picture: PNG file for a picture of the map; None: none is drawn.
        progress: receives the steps.

    Returns:
        The file, and lines that tell what was measured.

    Raises:
        InputError: before rendering: the model or the provider cannot be used, or a file exists. After it: the detector
            finds no faces, or the map fails its checks; nothing is written then but the picture.
    """
    settings.check()
    detector = load_provider(provider)
    data = gnm_npz.read(model)
    target = out or scheme_file(model, detector.scheme)
    _require_new(target)
    check_output_file(target)
    if picture is not None:
        check_output_file(picture)
    progress.message("solving the expressions of the rendered heads")
    try:
        performed = expressions(data)
    except InputError as error:  # a model without the anatomy that the shapes need still has a neutral face
        progress.message(f"heads are rendered without expressions: {error}")
        performed = {}
    made = make_map(data, detector, performed, settings, progress)
    if picture is not None:
        draw_map(data, made.scheme, picture)
    refuse_failed(made)
    return write_scheme_file(made.scheme, target), _lines(made)


def _require_new(target: Path) -> None:
    if target.exists():
        raise InputError(
            "The landmark map exists already",
            where=target,
            expected="a path that does not exist",
            got="a file",
            fix="remove it, or name another file with --out",
        )


def _lines(made: MadeMap) -> list[str]:
    lines = [f"faces found in {made.found:.1%} of the pictures"]
    lines += [f"{'ok' if check.passed else 'FAILED'}: {check.name}: {check.detail}" for check in made.checks]
    parts = ", ".join(f"{name} {value:.1f}" for name, value in made.regions_mm.items())
    return [*lines, f"spread of held-out people, mm along each axis: {parts}"]
