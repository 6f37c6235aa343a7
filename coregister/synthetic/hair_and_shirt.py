"""What a head wears in the studio: short hair and a shirt, both grown from the model's own skin.

Each is the skin's surface moved outwards by a thickness that falls below zero at its rim, so that it dives into the
skin there and leaves no gap.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from registration.geometry.topology import edges
from registration.model.gnm_npz import GNMData
from registration.model.regions import exterior, group
from registration.render.studio.canvas import canvas, smoothstep, softened, texture_of
from registration.render.studio.noise import SolidNoise
from registration.render.studio.scene import StudioSurface, subdivided, with_normals
from registration.render.studio.skin import Look, scalp

HAIR_M = 0.012  # thickness where it is full
SHIRT_M = 0.005
_UNDER_M = -0.0025  # the rim's depth under the skin
_HAIR_TEXELS, _SHIRT_TEXELS = 1024, 512
_OVERLAP = 1.1  # turns that the shirt's map spans: faces across its seam need no cut
_HEM = ((0.012, 0.1), (0.028, 0.4), (0.036, 1.0))  # rings below the skin's rim: outwards (m), share of the way down
_DEPTH_M = 0.15  # of the hem below the lowest point of the skin's rim: no camera sees the inside


def hair(
    data: GNMData, head: StudioSurface, classes: Float[np.ndarray, "K"], look: Look, seed: int = 0
) -> StudioSurface:
    """Short hair over the scalp of a posed head (its surface in the world); leaves face, ears and neck free.

    `classes` are the class shares of every vertex. A Mitsuba variant must be active.
    """
    fine = _Worn.of(data, head, scalp(data))
    noise = SolidNoise(fine.template)
    reach = fine.reach + 0.0025 * noise.smooth(0.012, seed * 10 + 1, octaves=2) * smoothstep(-0.004, 0.004, fine.reach)
    volume = 1 + 0.09 * noise.smooth(0.022, seed * 10 + 2) + 0.05 * noise.smooth(0.007, seed * 10 + 3, octaves=2)
    thickness = _UNDER_M + (HAIR_M - _UNDER_M) * smoothstep(-0.001, 0.030, reach) ** 0.8 * volume
    thickness = np.where(reach > 0, thickness, _UNDER_M)
    return fine.surface(thickness, reach > -0.002, _hair_texture(data, look, seed), classes)


def shirt(data: GNMData, head: StudioSurface, classes: Float[np.ndarray, "K"], seed: int = 0) -> StudioSurface:
    """A shirt with a round neck on a posed head (its surface in the world), its hem below the skin's lower rim."""
    template = data.template_vertex_positions.astype(np.float64)
    names = data.joint_names.tolist()
    neck = data.template_joint_positions[names.index("neck") if "neck" in names else 0].astype(np.float64)
    ahead = template[:, 2] - neck[2]
    ahead /= np.maximum(np.hypot(template[:, 0] - neck[0], ahead), 1e-9)
    reach = np.where(exterior(data), neck[1] + 0.016 - 0.026 * ahead - template[:, 1], -1.0)
    fine = _Worn.of(data, head, reach)
    noise = SolidNoise(fine.template)
    folds = 0.0016 * noise.smooth(0.035, seed * 10 + 5, stretch=(0.6, 1.6, 1.0))
    thickness = _UNDER_M + (SHIRT_M - _UNDER_M) * smoothstep(-0.004, 0.008, fine.reach)
    thickness += folds * smoothstep(0.004, 0.03, fine.reach)
    worn = fine.surface(thickness, fine.reach > -0.005, _cloth(seed), classes)
    return _hemmed(data, head, worn, neck)


@dataclass(frozen=True, kw_only=True)
class _Worn:
    """The head's skin in four triangles for one, and how far inside a garment's rim its vertices lie (m)."""

    posed: StudioSurface
    template: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    reach: Float[np.ndarray, "V"]

    @classmethod
    def of(cls, data: GNMData, head: StudioSurface, reach: Float[np.ndarray, "V"]) -> "_Worn":
        skin = exterior(data)
        triangles = head.triangles[skin[head.triangles].all(1)]
        uvs = head.corner_uvs[skin[head.triangles].all(1)]
        # Normals and reach ride along as the positions and classes of surfaces of the same faces.
        smooth = np.stack([softened(data, axis, 6) for axis in with_normals(head).T], 1)
        smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)

        def fine(values: Float[np.ndarray, "V 3"], shares: Float[np.ndarray, "V K"]) -> StudioSurface:
            return subdivided(
                StudioSurface(
                    vertices=values,
                    triangles=triangles,
                    corner_uvs=uvs,
                    texture=head.texture,
                    classes=shares,
                    normals=smooth,
                )
            )

        posed = fine(head.vertices, reach[:, None])
        template = fine(data.template_vertex_positions.astype(np.float64), reach[:, None]).vertices
        return cls(posed=posed, template=template, normals=with_normals(posed), reach=posed.classes[:, 0])

    def surface(
        self,
        thickness: Float[np.ndarray, "V"],
        kept: Bool[np.ndarray, "V"],
        texture: Float[np.ndarray, "R R 3"],
        classes: Float[np.ndarray, "K"],
    ) -> StudioSurface:
        """The faces with a kept corner, moved outwards; the largest patch of them."""
        faces = kept[self.posed.triangles].any(1)
        a, b = edges(self.posed.triangles[faces]).vertices.T
        graph = coo_matrix((np.ones(len(a)), (a, b)), shape=2 * (len(kept),))
        patch = connected_components(graph, directed=False)[1][self.posed.triangles[:, 0]]
        faces &= patch == np.bincount(patch[faces]).argmax()
        used, triangles = np.unique(self.posed.triangles[faces], return_inverse=True)
        place = self.posed.vertices + thickness[:, None] * self.normals
        return StudioSurface(
            vertices=place[used],
            triangles=triangles.reshape(-1, 3),
            corner_uvs=self.posed.corner_uvs[faces],
            texture=texture,
            classes=np.tile(np.asarray(classes, np.float32), (len(used), 1)),
        )


def _hair_texture(data: GNMData, look: Look, seed: int) -> Float[np.ndarray, "R R 3"]:
    """Strands that run down from the crown, in the head's own atlas."""
    page = canvas(data, _HAIR_TEXELS).only(group(data, "skin") > 0.5)
    points = page.interpolate(data.template_vertex_positions).astype(np.float64)
    top = points.max(0)
    middle = np.array([0.0, top[1] - 0.10, (points[:, 2].max() + points[:, 2].min()) / 2])
    crown = np.array([0.012, 0.92, -0.38])  # the whorl lies behind the top and to one side
    crown /= np.linalg.norm(crown)
    d = points - middle
    down = d @ crown
    across = d - down[:, None] * crown
    noise = SolidNoise(across + 0.10 * down[:, None] * crown + 0.5)
    shade = (
        1 + 0.34 * noise.smooth(0.0011, seed * 10 + 7, octaves=2) + 0.22 * noise.smooth(0.006, seed * 10 + 8, octaves=2)
    )
    colours = np.array(look.hair) * 0.85 * np.clip(shade, 0.25, 2.2)[:, None]
    return texture_of(page.size, page.texel, colours.astype(np.float32))


def _cloth(seed: int) -> Float[np.ndarray, "R R 3"]:
    """Knitted cloth around a turn of the body; see `_cloth_uvs`."""
    rng = np.random.default_rng([seed, 8])
    u, v = np.meshgrid(
        (np.arange(_SHIRT_TEXELS) + 0.5) / _SHIRT_TEXELS, 1 - (np.arange(_SHIRT_TEXELS) + 0.5) / _SHIRT_TEXELS
    )
    turn = (2 * np.pi * _OVERLAP * u).ravel()
    noise = SolidNoise(np.stack([0.12 * np.cos(turn), 0.4 * v.ravel(), 0.12 * np.sin(turn)], 1))
    shade = (
        1 + 0.10 * noise.smooth(0.0022, seed * 10 + 9, octaves=2) + 0.07 * noise.smooth(0.03, seed * 10 + 10, octaves=2)
    )
    base = np.array([[0.045, 0.075, 0.14], [0.13, 0.14, 0.15], [0.05, 0.10, 0.075], [0.16, 0.045, 0.05]])
    colour = base[rng.integers(len(base))] * rng.uniform(0.8, 1.3)
    return (colour * np.clip(shade, 0.5, 1.6)[:, None]).reshape(_SHIRT_TEXELS, _SHIRT_TEXELS, 3).astype(np.float32)


def _hemmed(data: GNMData, head: StudioSurface, worn: StudioSurface, neck: Float[np.ndarray, "3"]) -> StudioSurface:
    """The shirt continued below the skin's open rim, and mapped around the body."""
    source, target = data.template_vertex_positions.astype(np.float64), head.vertices
    body = group(data, "skin") > 0.5
    own = source[body] - source[body].mean(0)
    u, _, vt = np.linalg.svd(own.T @ (target[body] - target[body].mean(0)))
    turn = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    local = (worn.vertices - target[body].mean(0)) @ turn + source[body].mean(0)  # in the template's frame
    loop = _lower_rim(worn, local)
    vertices, triangles = [local], [worn.triangles]
    above = loop
    floor = local[loop, 1].min() - _DEPTH_M
    for number, (out, share) in enumerate(_HEM):
        away = local[loop, ::2] - neck[::2]
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        ring = local[loop].copy()
        ring[:, ::2] += out * away * (1.0, 0.5)  # a body is wider than it is deep
        ring[:, 1] += share * (floor - ring[:, 1])
        below = len(local) + number * len(loop) + np.arange(len(loop))
        vertices.append(ring)
        a, b = above, np.roll(above, -1)
        c, d = below, np.roll(below, -1)
        triangles += [np.stack([b, a, c], 1), np.stack([b, c, d], 1)]
        above = below
    place, faces = np.concatenate(vertices), np.concatenate(triangles)
    return StudioSurface(
        vertices=(place - source[body].mean(0)) @ turn.T + target[body].mean(0),
        triangles=faces,
        corner_uvs=_cloth_uvs(place, faces, neck),
        texture=worn.texture,
        classes=np.tile(worn.classes[:1], (len(place), 1)),
    )


def _lower_rim(worn: StudioSurface, local: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, "B"]:
    """The open rim with the lowest middle, in the order in which its faces run."""
    own = edges(worn.triangles)
    following = dict(own.vertices[own.faces[:, 1] < 0].tolist())
    rims = []
    while following:
        first, after = following.popitem()
        rim = [first]
        while after != first and after in following:
            rim.append(after)
            after = following.pop(after)
        rims.append(np.array(rim))
    return min((rim for rim in rims if len(rim) > 2), key=lambda rim: local[rim, 1].mean())


def _cloth_uvs(
    place: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], neck: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "F 3 2"]:
    """Turn around the neck and height over 40 cm."""
    turn = np.arctan2(place[:, 0] - neck[0], place[:, 2] - neck[2])[faces]
    turn = turn[:, :1] + (turn - turn[:, :1] + np.pi) % (2 * np.pi) - np.pi
    turn += np.pi * np.where(turn.min(1, keepdims=True) < -np.pi, 3, 1)
    height = (place[:, 1] - place[:, 1].min()) / 0.4
    return np.stack([turn / (2 * np.pi * _OVERLAP), height[faces]], -1).astype(np.float32)
