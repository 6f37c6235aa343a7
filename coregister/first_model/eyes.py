"""The eyeball: two closed surfaces of revolution, their identity basis and the basis vector of the pupil.

The two-sphere model of [GNM, Eyeball Model Formulation]: a sclera of fixed radius and a smaller corneal sphere that
meet at the limbus, blended there. An outline of points (distance from the axis, z) is revolved about the optical axis
+Z; each of its points becomes a ring of `SEGMENTS` mesh vertices or, on the axis, a pole. All lengths are metres.
"""

import numpy as np
from jaxtyping import Float, Int

from coregister.first_model.part import MeshPart
from registration.errors import InputError

SCLERA_RADIUS = 14.6e-3  # the same for all subjects, so that the lids fit every eye
LIMBUS_RADIUS, LIMBUS_DEVIATION = 6.0e-3, 0.44e-3  # mean, standard deviation
CORNEA_RADIUS, CORNEA_DEVIATION = 8.5e-3, 0.73e-3
BLEND_LENGTH = 1.0e-3  # of the blend from cornea to sclera, along the sclera
INTERIOR_SCALE = 0.99  # of the inner shell, 0.15 mm inside the sclera
SEGMENTS = 24

_MEAN_LIMBUS = float(np.arcsin(LIMBUS_RADIUS / SCLERA_RADIUS))  # a polar angle: 24.27 degrees
_HALF_BLEND = BLEND_LENGTH / SCLERA_RADIUS / 2
_FIXED_FROM = np.radians(65.0)  # beyond this polar angle all eyes have the same vertices
# Polar angles of the mean eye's rings. Both shells share those of the back, so that they cannot intersect.
_BACK = np.radians([33.0, 44.0, 57.0, 73.0, 90.0, 118.0, 148.0, 180.0])
_LIMBUS = _MEAN_LIMBUS + np.array([-_HALF_BLEND, 0, _HALF_BLEND])
_EXTERIOR = np.concatenate([np.radians([0.0, 6.0, 12.0, 18.0]), _LIMBUS, _BACK])
_IRIS = np.array([0, 1 / 4, 1 / 2, 2 / 3, 5 / 6, 1])  # fractions of the iris's radius
_PUPIL_EDGE = 2  # index in `_IRIS`
_INTERIOR = np.concatenate([_IRIS * _MEAN_LIMBUS, _BACK])  # for the uv map only, where the iris lies on the sphere
_POLYLINE = np.concatenate([np.linspace(0, _MEAN_LIMBUS, 49), np.linspace(_MEAN_LIMBUS, _FIXED_FROM, 49)[1:]])
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
    if not 0 < limbus_radius < min(cornea_radius, SCLERA_RADIUS * np.sin(_FIXED_FROM)):
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


def pupil_displacement(part: MeshPart) -> Float[np.ndarray, "V 3"]:
    """Return the displacement of an `eyeball`'s vertices per unit of the pupil's coefficient c, metres.

    The pupil's radius is r_iris (1/2 + c/6): a point at -3, half the iris at 0, the whole iris at +3. Iris and pupil
    are stretched linearly.
    """
    planar = part.vertices * [1, 1, 0] * part.groups["irises"][:, None]
    radius = np.linalg.norm(planar, axis=1, keepdims=True)
    change = np.minimum(radius, radius.max() - radius) / 3
    return planar * np.divide(change, radius, out=np.zeros_like(radius), where=radius > 0)


def variation(samples: int = 10_000, *, components: int = 3, seed: int = 0) -> Float[np.ndarray, "K V 3"]:
    """Build the linear identity basis of `eyeball()`'s vertices.

    Each sampled pair of radii gives a dense outline whose points keep their position relative to the limbus; the
    components are those of the outlines (PCA about their mean). Their scores over the samples give the same linear
    combinations of the mesh's rings, so that nothing is interpolated and the iris follows the limbus. Beyond 65 degrees
    from the axis nothing moves. Source: [GNM, Eyeball Model Formulation].

    Args:
        samples: number of sampled eyes.
        components: K.
        seed: of the samples.

    Returns:
        Components scaled by their standard deviations, metres; a positive coefficient lengthens the eye.
    """
    limbus, cornea = sample_radii(samples, np.random.default_rng(seed))
    lines = _surface(_POLYLINE, limbus, cornea).reshape(samples, -1)
    lines -= lines.mean(0)
    variances, axes = np.linalg.eigh(lines.T @ lines / (samples - 1))
    scores = lines @ axes[:, : -components - 1 : -1] / np.sqrt(variances[: -components - 1 : -1])
    rings = _outline(limbus, cornea)
    basis = np.einsum("nk,nrc->krc", scores, rings - rings.mean(0)) / (samples - 1)
    return _revolve(basis * np.sign(basis[:, :1, 1:]))


def sample_radii(samples: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Sample radii of limbus and cornea, metres; rejects corneas that are no larger than the limbus."""
    means, deviations = [LIMBUS_RADIUS, CORNEA_RADIUS], [LIMBUS_DEVIATION, CORNEA_DEVIATION]
    radii = np.empty((0, 2))
    while len(radii) < samples:
        candidates = means + rng.standard_normal((samples, 2)) * deviations
        radii = np.concatenate([radii, candidates[candidates[:, 0] < candidates[:, 1]]])
    return radii[:samples, 0], radii[:samples, 1]


def radius_at(
    angle: Float[np.ndarray, "..."], limbus_radius: Float[np.ndarray, "..."], cornea_radius: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Return the exterior's distance from the eye's centre at polar angles from the optical axis.

    The spheres share the limbus: z_l = sqrt(r_s^2 - r_l^2), and the cornea's centre is z_c = z_l - sqrt(r_c^2 - r_l^2).
    Within half of `BLEND_LENGTH` to either side of the limbus, a cubic matches values and slopes of both spheres.

    Args:
        angle: radians; broadcasts with the radii.
        limbus_radius: metres.
        cornea_radius: metres.

    Returns:
        Distances, metres.
    """
    centre = np.sqrt(SCLERA_RADIUS**2 - limbus_radius**2) - np.sqrt(cornea_radius**2 - limbus_radius**2)
    start = np.arcsin(limbus_radius / SCLERA_RADIUS) - _HALF_BLEND
    front = np.minimum(angle, start)
    root = np.sqrt(cornea_radius**2 - (centre * np.sin(front)) ** 2)
    rise = centre * np.cos(front) + root - SCLERA_RADIUS
    slope = -centre * np.sin(front) * (1 + centre * np.cos(front) / root)
    # Cubic Hermite blend: the cornea for t = 0, the sclera for t = 1.
    t = np.clip((angle - start) / (2 * _HALF_BLEND), 0, 1)
    return SCLERA_RADIUS + (1 - t) ** 2 * (rise * (1 + 2 * t) + 2 * _HALF_BLEND * slope * t)


def _surface(
    angles: Float[np.ndarray, "R"], limbus_radius: Float[np.ndarray, "..."], cornea_radius: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "... R 2"]:
    """Return the exterior's points at the mean eye's polar angles, shifted so that each point keeps to its structure.

    In front of the limbus all angles scale by one factor; behind it the shift decreases to zero at `_FIXED_FROM`.
    """
    limbus_radius, cornea_radius = limbus_radius[..., None], cornea_radius[..., None]
    t = np.clip((angles - _MEAN_LIMBUS) / (_FIXED_FROM - _MEAN_LIMBUS), 0, 1)
    weight = np.where(angles < _MEAN_LIMBUS, angles / _MEAN_LIMBUS, (1 - t) ** 2 * (1 + 2 * t))
    shifted = angles + weight * (np.arcsin(limbus_radius / SCLERA_RADIUS) - _MEAN_LIMBUS)
    axial = np.stack([np.where(angles < np.pi, np.sin(shifted), 0), np.cos(shifted)], -1)
    return radius_at(shifted, limbus_radius, cornea_radius)[..., None] * axial


def _outline(
    limbus_radius: Float[np.ndarray, "..."], cornea_radius: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "... R 2"]:
    """Return (distance from the axis, z) of every ring: exterior, then interior, each from front to back."""
    limbus = np.arcsin(limbus_radius / SCLERA_RADIUS)
    rim = SCLERA_RADIUS * np.stack([np.sin(limbus), np.cos(limbus)], -1)
    iris = rim[..., None, :] * np.stack([_IRIS, np.ones_like(_IRIS)], -1)
    interior = np.concatenate([iris, _surface(_BACK, limbus_radius, cornea_radius)], -2)
    return np.concatenate([_surface(_EXTERIOR, limbus_radius, cornea_radius), INTERIOR_SCALE * interior], -2)


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
