"""The renderer's mathematics in plain torch: slow, exact and short; documentation, and the reference of its tests.

`ReferenceRenderer` renders what `renderer.Renderer` renders, for tiny scenes: every ray is tested against every face.

Rays. In the camera's frame a ray has direction d = K^-1 (x, y, 1): d_z = 1, so that t along it is depth. It hits a face
with corners p_0, p_1, p_2 where t d = b_0 p_0 + b_1 p_1 + b_2 p_2 with barycentrics of sum 1. By Cramer's rule

    b_j = w_j / W,  t = D / W,  w_0 = <d, p_1 x p_2> and cyclic,  W = w_0 + w_1 + w_2,  D = <p_0, p_1 x p_2>

It is a hit if no b_j is negative and t > 0. The camera sees the face's outer side if D < 0.

Interior of faces. The face that a ray hits is determined without gradients. Its b_j are differentiable functions of the
corners, and every channel is a function of the b_j: autograd computes their gradients.

Silhouettes. A pixel is a box, over which the channels f are averaged; they are discontinuous at projections x(s) of
edges. With the adjoint g of the pixel that contains x, and n a unit normal of the edge in the image,

    dLoss = sum over edges of the integral of g . [f(x - h n) - f(x + h n)] n . dx  along x,  h -> 0

Both signs of the normal give the same result. All edges are summed: at an edge without a discontinuity, inside a smooth
surface or behind another part, both sides agree. No test for silhouettes, texture seams or occlusion is needed. The
integral is a midpoint rule, with a ray on either side.

Limits: discontinuities that are not at edges are missing, so parts must not intersect; and two visible edges must not
coincide in an image (a face seen exactly edge-on), because the jump between them would count twice.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from registration.geometry.topology import edges, vertex_normals
from registration.types import Camera, Pixels, Rendered

_H_PX = 1e-6  # see the formula above; float64 resolves it


class ReferenceRenderer:
    """Renders one topology in float64, with the arguments of `Renderer`."""

    def __init__(
        self,
        triangles: Int[np.ndarray, "F 3"],
        corner_uvs: Float[np.ndarray, "F 3 2"],
        vertex_classes: Float[np.ndarray, "V K"],
    ):
        """
        Args:
            triangles: of vertices that are not duplicated at uv seams.
            corner_uvs: in [0, 1]^2; (0, 0) is the texture's lower left corner.
            vertex_classes: soft class weights of the vertices.
        """
        self._triangles = torch.tensor(triangles.astype(np.int64))
        self._corner_uvs = torch.tensor(corner_uvs, dtype=torch.float64)
        self._classes = torch.tensor(vertex_classes, dtype=torch.float64)
        self._ends = torch.tensor(edges(triangles).vertices)

    def __call__(
        self,
        vertices: Float[Tensor, "V 3"],
        texture: Float[Tensor, "R R 3"] | None,
        pixels: Pixels,
        offset: tuple[float, float] = (0.5, 0.5),
    ) -> Rendered:
        """Render pixels by one ray each; differentiable by autograd, except at silhouettes.

        Args:
            vertices: world frame, metres.
            texture: linear, row 0 at v = 1, at least 2 x 2 texels; without one, RGB is zero.
            pixels: which pixels to render.
            offset: position of the ray in each pixel, from its corner (px).
        """
        xy = torch.stack([pixels.x, pixels.y], 1) + torch.tensor(offset, dtype=torch.float64)
        parts = [self._shade(vertices, texture, c, xy[pixels.view == n]) for n, c in enumerate(pixels.cameras)]
        rgb, normals, mask, classes = torch.cat(parts).split([3, 3, 1, self._classes.shape[1]], 1)
        return Rendered(rgb=rgb, normals=normals, mask=mask[:, 0], classes=classes)

    def silhouette_gradient(
        self,
        vertices: Float[Tensor, "V 3"],
        texture: Float[Tensor, "R R 3"] | None,
        pixels: Pixels,
        adjoint: Rendered,
        points: int = 8,
    ) -> Float[Tensor, "V 3"]:
        """Return dLoss / d(vertices), per metre, due to changes of visibility; see the module.

        Args:
            vertices: world frame, metres.
            texture: as rendered.
            pixels: as rendered; an edge counts where it lies in a listed pixel.
            adjoint: dLoss / d(every channel of every listed pixel).
            points: of the quadrature along the piece of an edge inside a pixel.
        """
        vertices = vertices.detach().double().requires_grad_()
        g = torch.cat([adjoint.rgb, adjoint.normals, adjoint.mask[:, None], adjoint.classes], 1).detach()
        loss = 0 * vertices.sum()
        for view, camera in enumerate(pixels.cameras):
            x, normal, length_px = self._edge_points(vertices, camera, points)
            pixel = _listed_pixel(pixels.index[view], x)
            x, normal, length_px, pixel = (values[pixel >= 0] for values in (x, normal, length_px, pixel))
            with torch.no_grad():
                inner, outer = (self._shade(vertices, texture, camera, x + h * normal) for h in (-_H_PX, _H_PX))
                weight = length_px * (g[pixel] * (inner - outer)).sum(1)
            loss = loss + (weight[:, None] * normal * x).sum()  # only x carries a gradient
        return torch.autograd.grad(loss, vertices)[0]

    def _shade(
        self, vertices: Tensor, texture: Tensor | None, camera: Camera, xy: Float[Tensor, "N 2"]
    ) -> Float[Tensor, "N D"]:
        """Return colour, normal, coverage and classes at image positions (px); zero where no face is hit."""
        vertices = vertices.double()
        corners = _local(vertices, camera)[self._triangles]
        xy = xy.detach()
        directions = torch.cat([xy, torch.ones_like(xy[:, :1])], 1) @ _tensor(np.linalg.inv(camera.intrinsics).T)
        face, is_hit = _nearest(corners.detach(), directions)
        face = face[is_hit]
        barycentric, _, is_outer = _intersect(corners[face], directions[is_hit])

        def blend(values: Float[Tensor, "H 3 C"]) -> Float[Tensor, "H C"]:
            return (barycentric[..., None] * values).sum(1)

        colour = torch.zeros(len(face), 3, dtype=torch.float64)
        if texture is not None:
            colour = _sample_texture(texture.double(), blend(self._corner_uvs[face]))
        normal = blend(vertex_normals(vertices, self._triangles)[self._triangles[face]])
        normal = torch.nn.functional.normalize(normal, dim=1) * torch.where(is_outer, 1.0, -1.0)[:, None]
        classes = blend(self._classes[self._triangles[face]])
        channels = torch.cat([colour, normal, torch.ones_like(colour[:, :1]), classes], 1)
        return channels.new_zeros(len(xy), channels.shape[1]).index_put((is_hit,), channels)

    def _edge_points(
        self, vertices: Float[Tensor, "V 3"], camera: Camera, points: int
    ) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 2"], Float[Tensor, "N"]]:
        """Sample the projections of all edges in front of the camera: `points` per piece of an edge inside a pixel.

        Returns:
            Points (px, with gradients), normals of their edges, and the length of edge per point (px).
        """
        ends = _local(vertices, camera)[self._ends]  # (E, 2, 3)
        ends = ends[(ends[..., 2] > 0).all(1)] @ _tensor(camera.intrinsics.T)
        a, b = (ends[..., :2] / ends[..., 2:]).unbind(1)
        along = (b - a).detach()
        length = along.norm(dim=1).clamp_min(1e-12)
        sizes = camera.width_px, camera.height_px
        borders = [(torch.arange(size + 1) - a[:, k, None]) / along[:, k, None] for k, size in enumerate(sizes)]
        cuts = torch.cat([*borders, 0 * along], 1).detach().nan_to_num().clamp(0, 1)
        cuts = torch.nn.functional.pad(cuts.sort(1).values, (0, 1), value=1.0)
        step = cuts.diff() / points
        edge, piece = (step > 0).nonzero(as_tuple=True)
        step, start = step[edge, piece, None], cuts[edge, piece, None]
        s = (start + step * (torch.arange(points) + 0.5)).reshape(-1, 1)
        edge, step = edge.repeat_interleave(points), step.expand(-1, points).reshape(-1)
        normal = torch.stack([-along[:, 1], along[:, 0]], 1) / length[:, None]
        return torch.lerp(a[edge], b[edge], s), normal[edge], step * length[edge]


def _tensor(matrix: np.ndarray) -> Tensor:
    return torch.tensor(matrix, dtype=torch.float64)


def _local(vertices: Float[Tensor, "V 3"], camera: Camera) -> Float[Tensor, "V 3"]:
    """Transform from the world to the camera's frame, metres."""
    pose = _tensor(camera.T_cam_world)
    return vertices @ pose[:3, :3].T + pose[:3, 3]


def _intersect(
    corners: Float[Tensor, "*B 3 3"], directions: Float[Tensor, "N 3"]
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"], Bool[Tensor, "*B"]]:
    """Intersect rays with the planes of faces, one face per ray or one for all.

    Returns:
        Barycentrics, depths (m), and whether the camera sees the faces' outer sides.
    """
    crosses = torch.linalg.cross(corners.roll(-1, -2), corners.roll(-2, -2))
    w = (crosses @ directions[..., None])[..., 0] if crosses.ndim == 3 else directions @ crosses.T
    determinant = (corners[..., 0, :] * crosses[..., 0, :]).sum(-1)
    total = w.sum(-1)
    return w / total[..., None], determinant / total, determinant < 0


def _nearest(
    corners: Float[Tensor, "F 3 3"], directions: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N"], Bool[Tensor, "N"]]:
    """Return the first face that each ray hits, and whether there is one."""
    depth = torch.full((len(directions),), torch.inf, dtype=torch.float64)
    nearest = torch.zeros(len(directions), dtype=torch.int64)
    for face, triangle in enumerate(corners):
        barycentric, t, _ = _intersect(triangle, directions)
        nearer = (barycentric >= 0).all(1) & (t > 0) & (t < depth)
        depth[nearer], nearest[nearer] = t[nearer], face
    return nearest, depth.isfinite()


def _sample_texture(texture: Float[Tensor, "R R 3"], uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
    """Interpolate bilinearly between texel centres, clamped at the border; row 0 at v = 1."""
    size = len(texture)
    position = (torch.stack([uv[:, 0], 1 - uv[:, 1]], 1) * size - 0.5).clamp(0, size - 1)
    first = position.detach().long().clamp(max=size - 2)
    column, row = first.unbind(1)
    fx, fy = (position - first).split(1, 1)
    above = torch.lerp(texture[row, column], texture[row, column + 1], fx)
    below = torch.lerp(texture[row + 1, column], texture[row + 1, column + 1], fx)
    return torch.lerp(above, below, fy)


def _listed_pixel(index: Int[Tensor, "H W"], x: Float[Tensor, "N 2"]) -> Int[Tensor, "N"]:
    """Return the listed pixels that contain image positions (px), or -1."""
    column, row = x.detach().floor().long().unbind(1)
    inside = (column >= 0) & (column < index.shape[1]) & (row >= 0) & (row < index.shape[0])
    return torch.where(inside, index[row.where(inside, 0), column.where(inside, 0)].long(), -1)
