"""What a head wears in the studio: short hair and a shirt, both grown from the model's own skin.

Each is the skin's surface, offset outwards by a thickness that is negative at its border: there it lies below the skin,
which leaves no gap.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from registration.geometry import rigid
from registration.geometry.smoothstep import smoothstep
from registration.geometry.topology import edges
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, group
from registration.render.studio.canvas import fill_texture, make_canvas, smoothed
from registration.render.studio.noise import SolidNoise
from registration.render.studio.scene import StudioSurface, subdivide, surface_normals
from registration.render.studio.skin import SkinAppearance, depth_inside_hairline

HAIR_M = 0.012  # full thickness
SHIRT_M = 0.005
_BORDER_M = -0.0025  # thickness at the border: below the skin
_HAIR_TEXELS, _SHIRT_TEXELS = 1024, 512
_TURNS = 1.1  # that the shirt's uv map spans: faces across its seam need no cut
_HEM = ((0.012, 0.1), (0.028, 0.4), (0.036, 1.0))  # rings below the skin's border: outwards (m), fraction of `_HEM_M`
_HEM_M = 0.15  # height of the hem below the lowest point of the skin's border: no camera sees the inside


def hair_mesh(
    data: GNMData, head: StudioSurface, classes: Float[np.ndarray, "K"], appearance: SkinAppearance, seed: int = 0
) -> StudioSurface:
    """Build short hair over the scalp of a posed head; face, ears and neck stay free. A Mitsuba variant must be active.

    Args:
        data: the head model.
        head: the posed head, world frame.
        classes: class weights of every vertex of the hair.
        appearance: gives the hair's colour.
        seed: of the hair's shape.
    """
    fine = _GarmentFit.from_head(data, head, depth_inside_hairline(data))
    noise = SolidNoise(fine.template)
    depth = fine.depth + 0.0025 * noise.smooth(0.012, seed * 10 + 1, octaves=2) * smoothstep(-0.004, 0.004, fine.depth)
    volume = 1 + 0.09 * noise.smooth(0.022, seed * 10 + 2) + 0.05 * noise.smooth(0.007, seed * 10 + 3, octaves=2)
    thickness = _BORDER_M + (HAIR_M - _BORDER_M) * smoothstep(-0.001, 0.030, depth) ** 0.8 * volume
    thickness = np.where(depth > 0, thickness, _BORDER_M)
    return fine.surface(thickness, depth > -0.002, _hair_texture(data, appearance, seed), classes)


def shirt_mesh(data: GNMData, head: StudioSurface, classes: Float[np.ndarray, "K"], seed: int = 0) -> StudioSurface:
    """Build a shirt with a round neck on a posed head, with a hem below the skin's lower border.

    Args:
        data: the head model.
        head: the posed head, world frame.
        classes: class weights of every vertex of the shirt.
        seed: of colour and folds.
    """
    template = data.template_vertex_positions.astype(np.float64)
    names = data.joint_names.tolist()
    neck = data.template_joint_positions[names.index("neck") if "neck" in names else 0].astype(np.float64)
    forward = template[:, 2] - neck[2]
    forward /= np.maximum(np.hypot(template[:, 0] - neck[0], forward), 1e-9)
    depth = np.where(exterior(data), neck[1] + 0.016 - 0.026 * forward - template[:, 1], -1.0)
    fine = _GarmentFit.from_head(data, head, depth)
    noise = SolidNoise(fine.template)
    folds = 0.0016 * noise.smooth(0.035, seed * 10 + 5, stretch=(0.6, 1.6, 1.0))
    thickness = _BORDER_M + (SHIRT_M - _BORDER_M) * smoothstep(-0.004, 0.008, fine.depth)
    thickness += folds * smoothstep(0.004, 0.03, fine.depth)
    shirt = fine.surface(thickness, fine.depth > -0.005, _cloth(seed), classes)
    return _add_hem(data, head, shirt, neck)


@dataclass(frozen=True, kw_only=True)
class _GarmentFit:
    """The head's skin, subdivided once, and the depth of its vertices inside a garment's border (m)."""

    posed: StudioSurface
    template: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    depth: Float[np.ndarray, "V"]

    @classmethod
    def from_head(cls, data: GNMData, head: StudioSurface, depth: Float[np.ndarray, "V"]) -> "_GarmentFit":
        skin = exterior(data)
        triangles = head.triangles[skin[head.triangles].all(1)]
        uvs = head.corner_uvs[skin[head.triangles].all(1)]
        # `subdivide` interpolates normals and classes: the depth is passed as a class.
        smooth = np.stack([smoothed(data, axis, 6) for axis in surface_normals(head).T], 1)
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)

        def fine(values: Float[np.ndarray, "V 3"], classes: Float[np.ndarray, "V K"]) -> StudioSurface:
            return subdivide(
                StudioSurface(
                    vertices=values,
                    triangles=triangles,
                    corner_uvs=uvs,
                    texture=head.texture,
                    classes=classes,
                    normals=smooth,
                )
            )

        posed = fine(head.vertices, depth[:, None])
        template = fine(data.template_vertex_positions.astype(np.float64), depth[:, None]).vertices
        return cls(posed=posed, template=template, normals=surface_normals(posed), depth=posed.classes[:, 0])

    def surface(
        self,
        thickness: Float[np.ndarray, "V"],
        kept: Bool[np.ndarray, "V"],
        texture: Float[np.ndarray, "R R 3"],
        classes: Float[np.ndarray, "K"],
    ) -> StudioSurface:
        """Return the largest connected patch of the faces with a kept corner, offset outwards by the thickness (m)."""
        faces = kept[self.posed.triangles].any(1)
        a, b = edges(self.posed.triangles[faces]).vertices.T
        graph = coo_matrix((np.ones(len(a)), (a, b)), shape=2 * (len(kept),))
        patch = connected_components(graph, directed=False)[1][self.posed.triangles[:, 0]]
        faces &= patch == np.bincount(patch[faces]).argmax()
        used, triangles = np.unique(self.posed.triangles[faces], return_inverse=True)
        positions = self.posed.vertices + thickness[:, None] * self.normals
        return StudioSurface(
            vertices=positions[used],
            triangles=triangles.reshape(-1, 3),
            corner_uvs=self.posed.corner_uvs[faces],
            texture=texture,
            classes=np.tile(np.asarray(classes, np.float32), (len(used), 1)),
        )


def _hair_texture(data: GNMData, appearance: SkinAppearance, seed: int) -> Float[np.ndarray, "R R 3"]:
    """Paint strands that run down from the crown, in the head's atlas; linear albedo."""
    canvas = make_canvas(data, _HAIR_TEXELS).select(group(data, "skin") > 0.5)
    points = canvas.interpolate(data.template_vertex_positions).astype(np.float64)
    top = points.max(0)
    centre = np.array([0.0, top[1] - 0.10, (points[:, 2].max() + points[:, 2].min()) / 2])
    crown = np.array([0.012, 0.92, -0.38])  # the hair whorl lies behind the top and to one side
    crown /= np.linalg.norm(crown)
    d = points - centre
    axial = d @ crown
    radial = d - axial[:, None] * crown
    noise = SolidNoise(radial + 0.10 * axial[:, None] * crown + 0.5)
    shade = (
        1 + 0.34 * noise.smooth(0.0011, seed * 10 + 7, octaves=2) + 0.22 * noise.smooth(0.006, seed * 10 + 8, octaves=2)
    )
    colours = np.array(appearance.hair) * 0.85 * np.clip(shade, 0.25, 2.2)[:, None]
    return fill_texture(canvas.size, canvas.texel, colours.astype(np.float32))


def _cloth(seed: int) -> Float[np.ndarray, "R R 3"]:
    """Paint knitted cloth in the coordinates of `_cloth_uvs`; linear albedo."""
    rng = np.random.default_rng([seed, 8])
    u, v = np.meshgrid(
        (np.arange(_SHIRT_TEXELS) + 0.5) / _SHIRT_TEXELS, 1 - (np.arange(_SHIRT_TEXELS) + 0.5) / _SHIRT_TEXELS
    )
    angle = (2 * np.pi * _TURNS * u).ravel()
    noise = SolidNoise(np.stack([0.12 * np.cos(angle), 0.4 * v.ravel(), 0.12 * np.sin(angle)], 1))
    shade = (
        1 + 0.10 * noise.smooth(0.0022, seed * 10 + 9, octaves=2) + 0.07 * noise.smooth(0.03, seed * 10 + 10, octaves=2)
    )
    base = np.array([[0.045, 0.075, 0.14], [0.13, 0.14, 0.15], [0.05, 0.10, 0.075], [0.16, 0.045, 0.05]])
    colour = base[rng.integers(len(base))] * rng.uniform(0.8, 1.3)
    return (colour * np.clip(shade, 0.5, 1.6)[:, None]).reshape(_SHIRT_TEXELS, _SHIRT_TEXELS, 3).astype(np.float32)


def _add_hem(data: GNMData, head: StudioSurface, shirt: StudioSurface, neck: Float[np.ndarray, "3"]) -> StudioSurface:
    """Extend the shirt below the skin's open border, and map it around the body."""
    skin = group(data, "skin") > 0.5
    source = data.template_vertex_positions[skin].astype(np.float64)
    T_world_model = rigid.align(source[None], head.vertices[skin], np.ones((1, len(source))))[0]
    rotation, translation = T_world_model[:3, :3], T_world_model[:3, 3]
    local = (shirt.vertices - translation) @ rotation  # in the template's frame
    loop = _lower_boundary(shirt, local)
    vertices, triangles = [local], [shirt.triangles]
    above = loop
    floor = local[loop, 1].min() - _HEM_M
    for number, (outwards, fraction) in enumerate(_HEM):
        radial = local[loop, ::2] - neck[::2]
        radial /= np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-9)
        ring = local[loop].copy()
        ring[:, ::2] += outwards * radial * (1.0, 0.5)  # a body is wider than it is deep
        ring[:, 1] += fraction * (floor - ring[:, 1])
        below = len(local) + number * len(loop) + np.arange(len(loop))
        vertices.append(ring)
        a, b = above, np.roll(above, -1)
        c, d = below, np.roll(below, -1)
        triangles += [np.stack([b, a, c], 1), np.stack([b, c, d], 1)]
        above = below
    points, faces = np.concatenate(vertices), np.concatenate(triangles)
    return StudioSurface(
        vertices=points @ rotation.T + translation,
        triangles=faces,
        corner_uvs=_cloth_uvs(points, faces, neck),
        texture=shirt.texture,
        classes=np.tile(shirt.classes[:1], (len(points), 1)),
    )


def _lower_boundary(shirt: StudioSurface, local: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, "B"]:
    """Return the boundary loop with the lowest mean height, oriented as its faces."""
    mesh_edges = edges(shirt.triangles)
    following = dict(mesh_edges.vertices[mesh_edges.faces[:, 1] < 0].tolist())
    loops = []
    while following:
        first, after = following.popitem()
        loop = [first]
        while after != first and after in following:
            loop.append(after)
            after = following.pop(after)
        loops.append(np.array(loop))
    return min((loop for loop in loops if len(loop) > 2), key=lambda loop: local[loop, 1].mean())


def _cloth_uvs(
    points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], neck: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "F 3 2"]:
    """Return cylindrical uvs: u is the angle around the neck in `_TURNS` turns, v the height in 40 cm."""
    angle = np.arctan2(points[:, 0] - neck[0], points[:, 2] - neck[2])[faces]
    angle = angle[:, :1] + (angle - angle[:, :1] + np.pi) % (2 * np.pi) - np.pi
    angle += np.pi * np.where(angle.min(1, keepdims=True) < -np.pi, 3, 1)
    height = (points[:, 1] - points[:, 1].min()) / 0.4
    return np.stack([angle / (2 * np.pi * _TURNS), height[faces]], -1).astype(np.float32)
