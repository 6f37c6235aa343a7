"""The mesh that rays meet: positions and faces only, so that no uv seam exists geometrically.

The only file that touches Mitsuba's mesh interface.
"""

from __future__ import annotations  # mi.Float exists only once a variant is chosen

import mitsuba as mi
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


class TriangleScene:
    """One welded mesh whose vertices move; the BVH follows them."""

    def __init__(self, vertex_count: int, triangles: Int[np.ndarray, "F 3"]):
        mesh = mi.Mesh("head", vertex_count, len(triangles))
        params = mi.traverse(mesh)
        # A mesh must have an extent before its first BVH; real positions arrive with `move`.
        params["vertex_positions"] = mi.Float(np.random.default_rng(0).random(3 * vertex_count, np.float32))
        params["faces"] = mi.UInt32(triangles.astype(np.uint32).ravel())
        params.update()
        self._scene = mi.load_dict({"type": "scene", "mesh": mesh})
        self._params = mi.traverse(self._scene)
        self._key = next(key for key in self._params.keys() if key.endswith("vertex_positions"))
        self._now: Tensor | None = None

    def move(self, vertices: Float[Tensor, "V 3"]) -> bool:
        """Put the vertices (metres, world) here and rebuild the BVH, unless they are already here; whether it did."""
        if self._now is not None and torch.equal(self._now, vertices):
            return False
        self._now = vertices.detach().clone()
        self._params[self._key] = mi.Float(self._now.reshape(-1))
        self._params.update()
        return True

    def cast(
        self, origin: mi.Point3f, direction: mi.Vector3f, active: mi.Bool, *, coherent: bool
    ) -> mi.PreliminaryIntersection3f:
        """Nearest hits. `direction` need not be unit: t is in units of its length."""
        return self._scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=coherent, active=active)
