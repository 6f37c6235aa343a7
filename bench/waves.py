"""Measure how much of a wave of known length a registration keeps, region by region, and what its lengths state.

    python -m bench.waves [--out DIR] [--length-mm 10 20] [--amplitude-mm 0.3] [--recipe draft]

The first model's mean head gets waves along its normals, across the face from left to right, that fade at the rims of
mouth and lids. Its registration's distance from the head without waves is compared with the wave at the same place:
gain is the slope of the one against the other, divided by that of the wavy head itself, whose closest points in creases
are not its own vertices. The stated gain is that of the last stage's lengths
(docs/algorithms.md, "Regularization of the offsets") for the wave's length along the skin. Measured are the vertices
whose edges along the waves are shorter than a quarter of their length: a coarser mesh cannot have these waves, nor do
its images show them. With the same --out an interrupted run is resumed.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

from coregister.first_model import build
from coregister.synthetic.capture import Studio, render_capture
from registration.fit.context import SkinMesh
from registration.fit.recipes import Recipe, load_recipe
from registration.fit.variables import skin_vertices
from registration.frames import MM_PER_M
from registration.geometry.closest_point import barycentric_points, closest_points
from registration.geometry.large_steps import normalised_laplacian
from registration.geometry.topology import edges, vertex_normals
from registration.losses.regularization import regularization_weights
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData
from registration.model.landmarks import schemes_beside
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.progress import console_progress
from registration.types import Registration

_FADE_RINGS = 3  # of vertices over which waves fade at rims
_FACING = 0.6  # largest component of a normal along the waves, of skin that is measured: elsewhere they are longer
_RESOLVED = 0.25  # longest edge along the waves, of their length, of a vertex that is measured
_FEWEST = 10  # vertices of which a gain says something
_ACROSS = np.array([1.0, 0.0, 0.0])  # direction of the waves


class WavyHead:
    """A model's mean head with waves along its normals."""

    def __init__(self, data: GNMData, length_m: float, amplitude_m: float):
        self.data, self.length_m = data, length_m
        self.rest = data.template_vertex_positions.astype(np.float64)
        triangles = torch.as_tensor(data.triangles.astype(np.int64))
        self.normals = vertex_normals(torch.as_tensor(self.rest), triangles).numpy()
        fade = regions.outer_surface(data).astype(np.float64)
        mean = -normalised_laplacian(data.triangles, len(self.rest))
        mean.setdiag(0)
        for _ in range(_FADE_RINGS):
            fade = np.minimum(fade, mean @ fade)
        # Outwards only: nothing enters eyeballs or teeth.
        self.height_m = amplitude_m * fade * (1 + np.cos(2 * np.pi * (self.rest @ _ACROSS) / length_m))

    @property
    def vertices(self) -> Float[np.ndarray, "V 3"]:
        """The head with its waves, metres."""
        return self.rest + self.height_m[:, None] * self.normals

    def regions(self) -> dict[str, Bool[np.ndarray, "V"]]:
        """Return the skin that is measured, by name."""
        areas, own = regions.common_face(self.data), regions.offset_regions(self.data)
        chosen = {"forehead": areas["forehead"], "cheeks": areas["cheeks"], "lips": own["lips"], "lids": own["lids"]}
        flat = regions.outer_surface(self.data) & (np.abs(self.normals @ _ACROSS) < _FACING)
        return {name: members & flat for name, members in chosen.items()}

    def resolved(self) -> Bool[np.ndarray, "V"]:
        """Return the vertices whose edges are short enough along the waves for the mesh to have them."""
        ends = edges(self.data.triangles).vertices
        along = np.abs(np.diff(self.rest[ends] @ _ACROSS, axis=1)[:, 0])
        longest = np.zeros(len(self.rest))
        for k in range(2):
            np.maximum.at(longest, ends[:, k], along)
        return longest < _RESOLVED * self.length_m

    def gain(self, vertices: Float[np.ndarray, "V 3"], members: Bool[np.ndarray, "V"]) -> float:
        """Return the share of the waves that a registration has at some of its vertices, relative to this head's."""
        return self._slope(vertices, members) / self._slope(self.vertices, members)

    def _slope(self, vertices: Float[np.ndarray, "V 3"], members: Bool[np.ndarray, "V"]) -> float:
        skin = self.data.triangles[regions.exterior(self.data)[self.data.triangles].all(1)].astype(np.int64)
        points = vertices[members].astype(np.float64)
        _, face, barycentric = closest_points(points, self.rest, skin)
        apart = points - barycentric_points(self.rest, skin, face, barycentric)
        normal = barycentric_points(self.normals, skin, face, barycentric)
        found = (apart * normal).sum(1)
        true = barycentric_points(self.height_m[:, None], skin, face, barycentric)[:, 0]
        # Without the part that is constant or linear in the place: a head's pose is not known better.
        smooth = np.column_stack([np.ones(len(points)), points])
        found, true = (values - smooth @ np.linalg.lstsq(smooth, values, rcond=None)[0] for values in (found, true))
        return float(found @ true / (true @ true))

    def stated_gain(self, recipe: Recipe, members: Bool[np.ndarray, "V"]) -> float:
        """Return the mean gain that a recipe's last stage states for the waves at some vertices."""
        lengths = recipe.stages[-1].lengths
        assert lengths is not None, "the last stage has no offsets"
        factors = np.array([1.0, *(region.length for region in recipe.regions)])
        region = np.zeros(len(self.rest), np.int64)
        region[skin_vertices(self.data)] = SkinMesh.from_model(self.data, recipe).region
        half_gain = factors[region[members]] * lengths.half_gain_mm / MM_PER_M
        a, b, c = regularization_weights(half_gain, np.full(len(half_gain), lengths.decay_mm / MM_PER_M))
        slope = np.sqrt(1 - np.square(self.normals[members] @ _ACROSS))  # the wave's length is that of its projection
        q = 2 * np.pi * slope / self.length_m
        return float(np.mean(1 / (1 + a + b * q**2 + c * q**4)))


def registered(head: WavyHead, model: Path, options: argparse.Namespace, out: Path) -> Registration:
    """Render a capture of the head and register it, both unless they exist."""
    capture = out / "capture"
    with console_progress() as progress:
        if not capture.exists():
            render_capture(
                capture,
                data=head.data,
                vertices=head.vertices,
                schemes=schemes_beside(model, head.data.template_vertex_positions),
                subject="waves",
                expression="neutral",
                studio=Studio(cameras=options.views, size_px=tuple(options.size), texture_size=1024),
            )
        return register(capture, model, out / options.recipe, RegisterOptions(recipe=options.recipe), progress=progress)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/bench_waves"))
    parser.add_argument("--length-mm", type=float, nargs="+", default=[10.0, 20.0])
    parser.add_argument("--amplitude-mm", type=float, default=0.3)
    parser.add_argument("--recipe", default="draft")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--size", type=int, nargs=2, default=(360, 540), metavar=("W", "H"))
    options = parser.parse_args()
    if (shortest := min(options.length_mm)) <= 0:
        parser.error(f"--length-mm must be above 0, not {shortest:g}")
    model = build.bootstrap()
    data = gnm_npz.read(model)
    table = Table("waves, mm", "region", "vertices", "of them resolved", "gain", "stated", title=options.recipe)
    for length_mm in options.length_mm:
        head = WavyHead(data, length_mm / MM_PER_M, options.amplitude_mm / MM_PER_M)
        result = registered(head, model, options, options.out / f"{length_mm:g}mm")
        resolved = head.resolved()
        for name, members in head.regions().items():
            measured = members & resolved
            counts = str(members.sum()), str(measured.sum())
            cells = ["-", "-"]
            if measured.sum() >= _FEWEST:
                gains = head.gain(result.vertices, measured), head.stated_gain(load_recipe(options.recipe), measured)
                cells = [f"{gain:.2f}" for gain in gains]
            table.add_row(f"{length_mm:g}", name, *counts, *cells)
    Console(width=80).print(table)


if __name__ == "__main__":
    main()
