"""One texture atlas for all mesh components."""

import numpy as np
from jaxtyping import Float

from registration.model.gnm_npz import GNMData
from registration.model.regions import components

_MARGIN = 2 / 512  # around every chart: a bilinear lookup reads one texel beyond its chart
_MAIN_WIDTH = 0.86  # of the component with the most triangles; the others are in the column next to it


def texture_atlas(data: GNMData) -> Float[np.ndarray, "F 3 2"]:
    """Return uvs of the triangles' corners in one [0, 1]^2 atlas, float32.

    The file's `triangle_uvs` have one map per mesh component; each is scaled to a cell of its own. Cells are 4 texels
    of a 512 x 512 texture apart, so that bilinear lookups in textures of 256 texels or more never mix components.

    Raises:
        InputError: a vertex is in no component.
    """
    part = components(data)[data.triangles[:, 0]]
    sizes = np.bincount(part, minlength=len(data.mesh_component_names))
    main = int(sizes.argmax())
    others = [k for k in np.flatnonzero(sizes).tolist() if k != main]
    cells = {main: ((0.0, 0.0), (_MAIN_WIDTH if others else 1.0, 1.0))}
    for row, k in enumerate(others):
        cells[k] = ((_MAIN_WIDTH, row / len(others)), (1.0, (row + 1) / len(others)))
    uvs = data.triangle_uvs.astype(np.float64)
    for k, (low, high) in cells.items():
        chart = uvs[part == k]
        # A release may have each component on a tile of its own instead of on [0, 1]^2: use the covered rectangle.
        lower, upper = chart.min((0, 1)), chart.max((0, 1))
        size = np.subtract(high, low) - 2 * _MARGIN
        uvs[part == k] = np.add(low, _MARGIN) + (chart - lower) / np.maximum(upper - lower, 1e-12) * size
    return uvs.astype(np.float32)
