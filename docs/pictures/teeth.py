"""Renders the teeth's images of docs/anatomy.md: `python -m docs.pictures.teeth MODEL.npz docs/anatomy [--name first]`.

Nine random dentitions of the teeth's components, and the first six components at two standard deviations.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from coregister.anatomy.part_basis import PartBasis
from coregister.anatomy.teeth import TeethSettings, teeth_basis
from docs.pictures.model import QUALITY, Picture, Shot, captioned, colours_of, draw
from registration.anatomy.tooth_structure import find_teeth
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData

SIZE = (300, 200)


class _Painter:
    """Draws the teeth and gums of a model with other vertices: from the front, and the upper arch from below."""

    def __init__(self, data: GNMData, basis: PartBasis):
        self.data, self.basis = data, basis
        self.vertices = data.template_vertex_positions.astype(np.float64)
        self.colours = colours_of(data)
        members = np.zeros(len(self.vertices), bool)
        members[basis.vertices] = True
        self.all = data.triangles[members[data.triangles].all(1)]
        upper = np.isin(self.all[:, 0], find_teeth(data)[0].vertices)
        self.upper = self.all[upper]
        corners = self.vertices[self.all]
        self.centre = (corners.min((0, 1)) + corners.max((0, 1))) / 2
        self.width = 1.25 * float(np.ptp(corners[..., 0]))

    def __call__(self, coefficients: Float[np.ndarray, "K"]) -> Picture:
        assert self.basis.template is not None
        vertices = self.vertices.copy()
        vertices[self.basis.vertices] = self.basis.template + np.tensordot(coefficients, self.basis.components, 1)
        front = Shot(target=tuple(self.centre), direction=(0.0, 0.0, 1.0), width=self.width, size=SIZE)
        below = Shot(target=tuple(self.centre), direction=(0.0, -1.0, 0.02), width=1.3 * self.width, size=SIZE)
        return np.concatenate(
            [draw(vertices, self.all, self.colours, front), draw(vertices, self.upper, self.colours, below)]
        )


def dentitions(painter: _Painter, seed: int) -> Picture:
    """Nine random dentitions of unit variance."""
    drawn = np.random.default_rng(seed).standard_normal((9, len(painter.basis.names)))
    return grid([painter(coefficients) for coefficients in drawn], 3)


def components(painter: _Painter) -> Picture:
    """Each of the first six components at -2 and +2 standard deviations."""
    pictures = []
    for k in range(6):
        for sign in (-2, 2):
            coefficients = np.zeros(len(painter.basis.names))
            coefficients[k] = sign
            pictures.append(captioned(painter(coefficients), f"{painter.basis.names[k][-3:]} at {sign:+d}", 2.5))
    return grid(pictures, 4)


def grid(pictures: Sequence[Picture], columns: int) -> Picture:
    rows = [np.concatenate(pictures[k : k + columns], 1) for k in range(0, len(pictures), columns)]
    return np.concatenate(rows)


def pictures_command(description: str | None, samples: int) -> argparse.Namespace:
    """Read the arguments of a command that draws the components of a part."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--name", default="first", help="of the model, in the files' names")
    parser.add_argument("--samples", type=int, default=samples)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def write_pictures(pictures: Mapping[str, Picture], options: argparse.Namespace) -> None:
    """Write the pictures of a model's part as NAME_MODEL.jpg."""
    options.out.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        path = options.out / f"{name}_{options.name}.jpg"
        cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def main() -> None:
    options = pictures_command(__doc__, TeethSettings().samples)
    data = gnm_npz.read(options.model)
    painter = _Painter(data, teeth_basis(data, TeethSettings(samples=options.samples)))
    write_pictures({"dentitions": dentitions(painter, options.seed), "teeth_components": components(painter)}, options)


if __name__ == "__main__":
    main()
