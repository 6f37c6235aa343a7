"""Renders the tongue's images of docs/anatomy.md: `python -m docs.pictures.tongue MODEL.npz docs/anatomy`.

Nine random tongues about the mean one, from the side over the lower teeth and from above, and the mean with each of the
first six components at two standard deviations. The jaw is closed: the tongue is as the components move it alone.
"""

import numpy as np
from jaxtyping import Float

from coregister.anatomy.part_basis import PartBasis
from coregister.anatomy.tongue import TongueSettings, tongue_basis
from docs.pictures.model import Picture, Shot, captioned, colours_of, draw
from docs.pictures.teeth import grid, pictures_command, write_pictures
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

SIZE = (300, 200)


class _Painter:
    """Draws the tongue of a model with coefficients of its components, and the lower teeth."""

    def __init__(self, data: GNMData, basis: PartBasis):
        self.basis = basis
        self.vertices = data.template_vertex_positions.astype(np.float64)
        self.colours = colours_of(data)
        tongue, teeth = regions.tongue(data), regions.lower_teeth(data)
        self.tongue, self.both = (data.triangles[rows[data.triangles].all(1)] for rows in (tongue, tongue | teeth))
        corners = self.vertices[self.tongue]
        self.centre = (corners.min((0, 1)) + corners.max((0, 1))) / 2 + (0, 0, 0.3 * float(np.ptp(corners[..., 2])))
        self.width = 2.0 * float(np.ptp(corners[..., 2]))

    def __call__(self, coefficients: Float[np.ndarray, "K"]) -> Picture:
        vertices = self.vertices.copy()
        vertices[self.basis.vertices] += np.tensordot(coefficients, self.basis.components, 1)
        side = Shot(target=tuple(self.centre), direction=(0.8, 0.15, 0.5), width=self.width, size=SIZE)
        above = Shot(target=tuple(self.centre), direction=(0.0, 1.0, 0.02), width=1.5 * self.width, size=SIZE)
        return np.concatenate(
            [draw(vertices, self.both, self.colours, side), draw(vertices, self.both, self.colours, above)]
        )


def tongues(painter: _Painter, seed: int) -> Picture:
    """Nine random tongues: the mean and components of unit variance."""
    drawn = np.random.default_rng(seed).standard_normal((9, len(painter.basis.names)))
    drawn[:, 0] = 1
    return grid([painter(coefficients) for coefficients in drawn], 3)


def components(painter: _Painter) -> Picture:
    """The mean, with each of the first six components at -2 and +2 standard deviations."""
    pictures = []
    for k in range(1, 7):
        for sign in (-2, 2):
            coefficients = np.zeros(len(painter.basis.names))
            coefficients[0], coefficients[k] = 1, sign
            pictures.append(captioned(painter(coefficients), f"{painter.basis.names[k][-3:]} at {sign:+d}", 2.5))
    return grid(pictures, 4)


def main() -> None:
    options = pictures_command(__doc__, TongueSettings().samples)
    data = gnm_npz.read(options.model)
    painter = _Painter(data, tongue_basis(data, TongueSettings(samples=options.samples)))
    write_pictures({"tongues": tongues(painter, options.seed), "tongue_components": components(painter)}, options)


if __name__ == "__main__":
    main()
