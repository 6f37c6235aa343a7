"""The eyeball: two closed surfaces of revolution, their identity basis and the basis vector of the pupil.

The two-sphere model of [GNM, Eyeball Model Formulation]: a sclera of fixed radius and a smaller corneal sphere that
meet at the limbus, blended there. An outline of points (distance from the axis, z) is revolved about the optical axis
+Z; each of its points becomes a ring of `SEGMENTS` mesh vertices or, on the axis, a pole. All lengths are metres.
"""

import numpy as np
from jaxtyping import Float, Int

from coregister.anatomy.eye_sections import (
    CORNEA_RADIUS,
    FIXED_FROM,
    LIMBUS_RADIUS,
    SCLERA_RADIUS,
    half_blend,
    mean_limbus,
    pupil_displacement,
    rim,
    section_modes,
    surface,
)
from coregister.first_model.part import MeshPart
from registration.errors import InputError

INTERIOR_SCALE = 0.99  # of the inner shell, 0.15 mm inside the sclera
SEGMENTS = 24

_MEAN_LIMBUS, _HALF_BLEND = mean_limbus(), half_blend()  # polar angles
# Polar angles of the mean eye's rings. Both shells share those of the back, so that they cannot intersect.
_BACK = np.radians([33.0, 44.0, 57.0, 73.0, 90.0, 118.0, 148.0, 180.0])
_LIMBUS = _MEAN_LIMBUS + np.array([-_HALF_BLEND, 0, _HALF_BLEND])
_EXTERIOR = np.concatenate([np.radians([0.0, 6.0, 12.0, 18.0]), _LIMBUS, _BACK])
_IRIS = np.array([0, 1 / 4, 1 / 2, 2 / 3, 5 / 6, 1])  # fractions of the iris's radius
_PUPIL_EDGE = 2  # index in `_IRIS`
_INTERIOR = np.concatenate([_IRIS * _MEAN_LIMBUS, _BACK])  # for the uv map only, where the iris lies on the sphere
_UV_RADIUS = 0.24  # of the chart of half a shell


def eyeball(limbus_radius: float = LIMBUS_RADIUS, cornea_radius: float = CORNEA_RADIUS) -> MeshPart:
    """Build one eyeball about the origin, looking along +Z.

    The interior shell is a slightly smaller sclera with a flat iris in the plane of its front rim. In the uv map the
    exterior fills the left half and the interior the right, each with its front above its back.

    Args:
        limbus_radius: metres.
        cornea_radius: metres.

    Returns:
        604 vertices, the exterior's first, then the interior's, each from front to back. Groups: `eye_exteriors`;
        `eye_interiors`, the disjoint union of `irises` (with the pupil) and `scleras`; `pupils` (the pupil's edge and
        what is inside). `mirror` is the vertex at (-x, y, z), which is also the corresponding vertex of the other eye.

    Raises:
        InputError: not 0 < limbus radius < cornea radius, or the limbus does not fit on the sclera's front.
    """
    if not 0 < limbus_radius < min(cornea_radius, SCLERA_RADIUS * np.sin(FIXED_FROM)):
        raise InputError(
            "These radii do not form an eyeball",
            where="limbus_radius, cornea_radius",
            expected="0 < limbus radius < cornea radius, in metres, the limbus on the front of a sclera of 0.0146 m",
            got=f"{limbus_radius}, {cornea_radius}",
            fix="use radii near the means, 0.006 and 0.0085",
        )
    ring, column = _layout()
    level = ring - len(_EXTERIOR)  # of the interior
    outer = int((level < 0).sum())
    quads = [_shell_quads(len(_EXTERIOR)), _shell_quads(len(_INTERIOR))]
    charts = [
        _shell_chart(_EXTERIOR, ring[:outer], column[:outer], quads[0], 0.25),
        _shell_chart(_INTERIOR, level[outer:], column[outer:], quads[1], 0.75),
    ]
    mirrored = np.where(column < 0, 0, (SEGMENTS // 2 - column) % SEGMENTS - column)
    return MeshPart(
        vertices=_revolve(_outline(np.array(limbus_radius), np.array(cornea_radius))),
        quads=np.concatenate([quads[0], outer + quads[1]]),
        quad_uvs=np.concatenate(charts),
        groups={
            "eye_exteriors": level < 0,
            "eye_interiors": level >= 0,
            "pupils": (level >= 0) & (level <= _PUPIL_EDGE),
            "irises": (level >= 0) & (level < len(_IRIS)),
            "scleras": level >= len(_IRIS),
        },
        mirror=np.arange(len(ring)) + mirrored,
    )


def pupil_basis(part: MeshPart) -> Float[np.ndarray, "V 3"]:
    """Return the displacement of an `eyeball`'s vertices per unit of the pupil's coefficient, metres."""
    planar = part.vertices * [1, 1, 0] * part.groups["irises"][:, None]
    return pupil_displacement(planar, np.linalg.norm(planar, axis=1).max())


def variation(samples: int = 10_000, *, components: int = 3, seed: int = 0) -> Float[np.ndarray, "K V 3"]:
    """Build the linear identity basis of `eyeball()`'s vertices from sampled cross-sections.

    The iris follows the limbus; beyond 65 degrees from the axis nothing moves. From [GNM, Eyeball Model Formulation].

    Args:
        samples: number of sampled eyes.
        components: K.
        seed: of the samples.

    Returns:
        Components scaled by their standard deviations, metres; a positive coefficient lengthens the eye.
    """
    modes = section_modes(samples, components, np.random.default_rng(seed))
    return _revolve(modes.components(_outline)[1])


def _outline(
    limbus_radius: Float[np.ndarray, "..."], cornea_radius: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "... R 2"]:
    """Return (distance from the axis, z) of every ring: exterior, then interior, each from front to back."""
    iris = rim(limbus_radius)[..., None, :] * np.stack([_IRIS, np.ones_like(_IRIS)], -1)
    interior = np.concatenate([iris, surface(_BACK, limbus_radius, cornea_radius)], -2)
    return np.concatenate([surface(_EXTERIOR, limbus_radius, cornea_radius), INTERIOR_SCALE * interior], -2)


def _layout() -> tuple[Int[np.ndarray, "V"], Int[np.ndarray, "V"]]:
    """Return each vertex's ring, in the order of `_outline`, and its index in that ring, or -1 for a pole."""
    rings = len(_EXTERIOR) + len(_INTERIOR)
    poles = [0, len(_EXTERIOR) - 1, len(_EXTERIOR), rings - 1]
    counts = np.where(np.isin(np.arange(rings), poles), 1, SEGMENTS)
    column = np.concatenate([[-1] if count == 1 else np.arange(count) for count in counts])
    return np.repeat(np.arange(rings), counts), column


def _revolve(outline: Float[np.ndarray, "... R 2"]) -> Float[np.ndarray, "... V 3"]:
    """Revolve outlines about the axis."""
    ring, column = _layout()
    return np.concatenate([outline[..., ring, :1] * _directions(column), outline[..., ring, 1:]], -1)


def _directions(column: Int[np.ndarray, "V"]) -> Float[np.ndarray, "V 2"]:
    """Return unit vectors in the plane of a ring, from +X to +Y; columns k and `SEGMENTS` / 2 - k mirror each other."""
    # All sines are copies of one quarter's, so that mirror images agree to the last bit.
    quarter = SEGMENTS // 4
    sines = np.sin(np.pi / 2 * np.arange(quarter + 1) / quarter)
    sines = np.concatenate([sines, sines[-2::-1], -sines[1:], -sines[-2:0:-1]])
    return np.stack([sines[(column + quarter) % SEGMENTS], sines[column]], -1) * (column >= 0)[:, None]


def _shell_quads(rings: int) -> Int[np.ndarray, "Q 4"]:
    """Return a closed shell's quads, counter-clockwise from outside; at a pole each spans two edges of the ring."""
    k = np.arange(SEGMENTS)
    after = (k + 1) % SEGMENTS
    starts = 1 + SEGMENTS * np.arange(rings - 2)
    bands = [np.stack([s + k, s + SEGMENTS + k, s + SEGMENTS + after, s + after], 1) for s in starts[:-1]]
    even, pole = k[::2], np.zeros(SEGMENTS // 2, int)
    front = np.stack([pole, 1 + even, 2 + even, 1 + (even + 2) % SEGMENTS], 1)
    back = starts[-1] + np.stack([pole + SEGMENTS, (even + 2) % SEGMENTS, even + 1, even], 1)
    return np.concatenate([front, *bands, back])


def _shell_chart(
    angles: Float[np.ndarray, "R"],
    ring: Int[np.ndarray, "V"],
    column: Int[np.ndarray, "V"],
    quads: Int[np.ndarray, "Q 4"],
    u: float,
) -> Float[np.ndarray, "Q 4 2"]:
    """Return a shell's uvs centred at u: two azimuthal equidistant discs with the seam at z = 0."""
    angle, planar = angles[ring][:, None], _directions(column)
    front = [u, 0.75] + _UV_RADIUS * angle / (np.pi / 2) * planar
    back = [u, 0.25] + _UV_RADIUS * (2 - angle / (np.pi / 2)) * planar * [-1, 1]
    in_front = angles[ring[quads]].max(1) <= np.pi / 2
    return np.where(in_front[:, None, None], front[quads], back[quads])
