"""Renders docs/anatomy/cranium.jpg: `python -m docs.pictures.cranium MODEL.npz`.

A head that made no part of the auxiliary model: the truth, what is hidden, and the cranium by four fills.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from bench.support.cranium_measures import MODEL, CraniumMeasure, fills
from coregister.anatomy.cranium_model import under_hair
from coregister.synthetic.neutral_heads import neutral_heads
from docs.pictures.model import QUALITY, Shot, captioned, draw
from registration.cranium import auxiliary_model
from registration.cranium.complete import CraniumCompletion
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

PICTURE = Path(__file__).parents[1] / "anatomy" / "cranium.jpg"
HEAD, SEED = 4, 1  # of the people of `bench.anatomy_checks.cranium`
SKIN, HIDDEN = np.array([226.0, 178.0, 150.0]), np.array([70.0, 74.0, 84.0])  # sRGB


def picture(data: GNMData, model: auxiliary_model.CraniumModel) -> np.ndarray:
    """Return the truth, the hidden skin and the fills, from the side and from behind."""
    head = neutral_heads(HEAD + 1, SEED)[HEAD].astype(np.float64)
    hair = under_hair(data)
    confidence = np.where(hair, 0.0, 0.9)
    completed = CraniumCompletion(data, model)(head, confidence)
    assert completed is not None
    measure = CraniumMeasure.of(data, completed)
    filled = {name: fill(head, confidence) for name, fill in fills(data, model).items()}
    captions = {name: f"{name}: {measure(vertices, head).cranium_mm:.1f} mm" for name, vertices in filled.items()}
    shown = [("truth", head, hair & False), ("hidden", head, hair)]
    shown += [(captions[name], vertices, hair & False) for name, vertices in filled.items()]
    triangles = data.triangles[regions.skin(data)[data.triangles].all(1)]
    columns = []
    for caption, vertices, dark in shown:
        colours = np.where(dark[:, None], HIDDEN, SKIN)
        centre = tuple((vertices[hair].min(0) + vertices[hair].max(0)) / 2 - (0, 0.03, 0))
        shots = [
            Shot(target=centre, direction=direction, width=0.27, size=(250, 270))
            for direction in ((1.0, 0.0, 0.15), (0.5, 0.25, -1.0))
        ]
        views = np.concatenate([draw(vertices, triangles, colours, shot) for shot in shots])
        columns.append(captioned(views, caption))
    assert MODEL in captions
    return np.concatenate(columns, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, help="the first model, with head_cranium.npz beside it")
    options = parser.parse_args()
    data = gnm_npz.read(options.model)
    model = auxiliary_model.read(auxiliary_model.beside(options.model), data)
    PICTURE.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(PICTURE), picture(data, model)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
