"""An iteration of Mitsuba's projective integrator [Zhang 2023] on the renderer's scene, for comparison.

It is `direct_projective` without lighting and without patches: `sample` returns the diffuse texture of the first hit,
the boundary term of primary visibility is the library's, and there is no indirect light. It casts one ray per pixel
each for the image, the adjoint of the interior and that of the boundary. Of the ways to render without lighting this is
the fastest: the existing plugins need the texture as an area light; `prb_projective` took 1.7 times and
`direct_projective` 2.2 times as long.

The comparison is not exact. In its favour: three channels instead of our sixteen, because the boundary term does not
support further channels (AOVs), and no vertex normals to differentiate. Against it: it renders whole images instead of
the pixels that a fit compares, and one view at a time, because the sensor that batches views has no adjoint.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from registration.types import Camera


def iteration(
    cameras: Sequence[Camera],
    triangles: Int[np.ndarray, "F 3"],
    corner_uvs: Float[np.ndarray, "F 3 2"],
    texture: Float[torch.Tensor, "R R 3"],
    next_vertices: Callable[[], Float[torch.Tensor, "V 3"]],
) -> Callable[[], None]:
    """Return a function that renders all views and propagates random adjoint images to vertices and texture.

    Args:
        cameras: the views.
        triangles: of vertices that are not duplicated at uv seams.
        corner_uvs: of the atlas.
        texture: linear.
        next_vertices: returns the vertices of each iteration.
    """
    import drjit as dr
    import mitsuba as mi

    # Mitsuba has one uv per vertex: vertices on a seam are duplicated.
    corners = np.column_stack([triangles.ravel(), corner_uvs.reshape(-1, 2)])
    rows, faces = np.unique(corners, axis=0, return_inverse=True)
    welded = mi.UInt32(rows[:, 0].astype(np.uint32))
    uvs = rows[:, 1:] * [1, -1] + [0, 1]  # its row 0 is at v = 0

    image = {"type": "bitmap", "bitmap": mi.Bitmap(texture.detach().cpu().numpy()), "raw": True, "wrap_mode": "clamp"}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": image}})
    mesh = mi.Mesh("head", len(rows), len(triangles), has_vertex_texcoords=True, props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = _split(next_vertices(), welded)
    params["vertex_texcoords"] = mi.Float(uvs.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    params.update()

    mi.register_integrator("unshaded", _integrator())
    sensors = {f"view{number}": _sensor(camera) for number, camera in enumerate(cameras)}
    integrator = {"type": "unshaded", "sppi": 0}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "mesh": mesh, **sensors})
    params = mi.traverse(scene)
    positions_key, texels_key = (
        next(key for key in params.keys() if key.endswith(end)) for end in ("vertex_positions", "reflectance.data")
    )
    rng = np.random.default_rng(0)
    adjoint = [mi.TensorXf(rng.random((c.height_px, c.width_px, 3), np.float32)) for c in cameras]
    seed = 0

    def iterate() -> None:
        nonlocal seed
        positions, texels = mi.Float(next_vertices().detach().reshape(-1)), mi.TensorXf(texture.detach())
        dr.enable_grad(positions, texels)
        params[positions_key] = dr.ravel(dr.gather(mi.Point3f, positions, welded))
        params[texels_key] = texels
        params.update()
        loss = mi.Float(0)
        for view, weights in enumerate(adjoint):
            loss += dr.sum(weights * mi.render(scene, params, sensor=view, spp=1, seed=seed), axis=None).array
            seed += 1
        dr.backward(loss)
        dr.eval(dr.grad(positions), dr.grad(texels))
        dr.sync_thread()

    return iterate


def _split(vertices: torch.Tensor, welded: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    return dr.ravel(dr.gather(mi.Point3f, mi.Float(vertices.detach().reshape(-1)), welded))


def _integrator() -> type:
    """Return the integrator's class, which can be defined only after a variant is set."""
    import drjit as dr
    import mitsuba as mi
    from mitsuba.ad.integrators.direct_projective import DirectProjectiveIntegrator

    class Unshaded(DirectProjectiveIntegrator):
        """Return the diffuse colour of the first hit."""

        def sample(
            self,
            mode: Any,
            scene: Any,
            sampler: Any,
            ray: Any,
            depth: Any,
            δL: Any,
            state_in: Any,
            active: Any,
            project: bool = False,
            si_shade: Any = None,
            **_: Any,
        ) -> tuple[Any, Any, list[Any], Any]:
            with dr.resume_grad(when=mode != dr.ADMode.Primal):
                hit = si_shade
                if hit is None:
                    hit = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True, active=active)
                colour = dr.select(hit.is_valid(), hit.bsdf().eval_diffuse_reflectance(hit, active), 0)
            return colour, hit.is_valid(), [], None

    return Unshaded


def _sensor(camera: Camera) -> dict[str, Any]:
    import mitsuba as mi

    (focal, _, cx), (_, _, cy), _ = camera.intrinsics
    # Mitsuba's cameras have x to the left and y up.
    to_world = np.linalg.inv(camera.T_cam_world) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    film = {"type": "hdrfilm", "width": camera.width_px, "height": camera.height_px, "rfilter": {"type": "box"}}
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(to_world),
        "fov": float(np.degrees(2 * np.arctan(camera.width_px / (2 * focal)))),
        "principal_point_offset_x": float(0.5 - cx / camera.width_px),
        "principal_point_offset_y": float(0.5 - cy / camera.height_px),
        "film": film | {"pixel_format": "rgb", "component_format": "float32", "sample_border": True},
        "sampler": {"type": "independent", "sample_count": 1},
    }
