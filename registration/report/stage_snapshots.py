"""Snapshots for debugging a fit: an image and the mesh after each stage."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from registration.capture.origin import in_world
from registration.fit.initialization import select_spread_views
from registration.fit.problem import FitProblem
from registration.frames import linear_to_srgb
from registration.report.inputs import ReportView, report_views
from registration.storage.files import atomic_file
from registration.storage.mesh import write_ply

_STAGE_VIEWS = 3


def write_stage(
    folder: Path,
    name: str,
    views: tuple[ReportView, ...],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "F 3"],
) -> Path:
    """Write NAME.png and NAME.ply.

    The image has a row for each view: the target, the rendering, four times their difference where colours were
    compared, and the rendered normals. The mesh is written last, atomically: once it exists, both files are complete.

    Args:
        folder: created if it does not exist.
        name: of both files, without the extension.
        views: at least one.
        vertices: metres, capture world.
        triangles: vertex indices.

    Returns:
        The path of the mesh.
    """
    rows = []
    for view in views:
        target, rendered = linear_to_srgb(view.target_rgb), linear_to_srgb(view.rendered_rgb)
        difference = np.abs(target - rendered) * view.compared[..., None] * 4
        rows.append(np.concatenate([target, rendered, difference, 0.5 + 0.5 * view.rendered_normals], axis=1))
    width = max(row.shape[1] for row in rows)
    sheet = np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray((np.clip(np.nan_to_num(sheet), 0, 1) * 255).astype(np.uint8)).save(folder / f"{name}.png")
    mesh = folder / f"{name}.ply"
    with atomic_file(mesh) as temporary:
        write_ply(temporary, vertices, triangles)
    return mesh


class StageSnapshots:
    """Writes an image and the mesh of the fit after its initial guess and after each stage."""

    def __init__(self, problem: FitProblem, folder: Path, origin: Float[np.ndarray, "3"]):
        self._problem, self._folder, self._origin = problem, folder, origin
        self._views = select_spread_views(problem.context.pyramid[0].pixels.cameras, _STAGE_VIEWS)
        self._states = ["start"]  # what the mesh is the result of, in order

    def stage_begins(self, name: str) -> None:
        """Write the state before stage `name`, once."""
        if name == self._states[-1]:
            return
        views = report_views(*self._problem.render_views(self._views))
        vertices = in_world(self._problem.vertices().cpu().numpy(), self._origin)
        label = f"{len(self._states) - 1:02d}_{self._states[-1]}"
        write_stage(self._folder, label, views, vertices, self._problem.context.data.triangles)
        self._states.append(name)
