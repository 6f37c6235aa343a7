"""The eyeball: two closed surfaces of revolution, their identity basis and the basis vector of the pupil.

The two-sphere model of [GNM, Eyeball Model Formulation]: a sclera of fixed radius and a smaller corneal
sphere that meet at the limbus, smoothed there. One outline, rows (distance from the axis, z), turns about the optical
axis +Z; each of its points is a ring of `SEGMENTS` mesh vertices or, on the axis, a pole. Metres throughout.
"""

import numpy as np
from jaxtyping import Float, Int

from coregister.first_model.part import Part
from registration.errors import InputError

SCLERA_RADIUS = 14.6e-3  # the same for everyone, so that the lids fit every eye
LIMBUS_RADIUS, LIMBUS_DEVIATION = 6.0e-3, 0.44e-3  # mean and standard deviation over people
CORNEA_RADIUS, CORNEA_DEVIATION = 8.5e-3, 0.73e-3
BLEND_LENGTH = 1.0e-3  # of the transition from cornea to sclera, along the sclera
INTERIOR_SCALE = 0.99  # the inner shell about the same centre, so 0.15 mm inside the sclera
SEGMENTS = 24

_MEAN_LIMBUS = float(np.arcsin(LIMBUS_RADIUS / SCLERA_RADIUS))  # a polar angle: 24.27 degrees
_HALF_BLEND = BLEND_LENGTH / SCLERA_RADIUS / 2
_STILL = np.radians(65.0)  # behind this polar angle all eyes have the same vertices
# Polar angles of the mean eye's rings. Both shells share those of the back, so neither can cut through the other.
_BACK = np.radians([33.0, 44.0, 57.0, 73.0, 90.0, 118.0, 148.0, 180.0])
_LIMBUS = _MEAN_LIMBUS + np.array([-_HALF_BLEND, 0, _HALF_BLEND])
_EXTERIOR = np.concatenate([np.radians([0.0, 6.0, 12.0, 18.0]), _LIMBUS, _BACK])
_IRIS = np.array([0, 1 / 4, 1 / 2, 2 / 3, 5 / 6, 1])  # shares of the iris' radius
_PUPIL_EDGE = 2  # in `_IRIS`
_INTERIOR = np.concatenate([_IRIS * _MEAN_LIMBUS, _BACK])  # of the uv map alone: there the iris lies on the sphere
_POLYLINE = np.concatenate([np.linspace(0, _MEAN_LIMBUS, 49), np.linspace(_MEAN_LIMBUS, _STILL, 49)[1:]])
_UV_RADIUS = 0.24  # of a chart that shows half a shell


def eyeball(limbus_radius: float = LIMBUS_RADIUS, cornea_radius: float = CORNEA_RADIUS) -> Part:
    """One eye about the origin, 604 vertices: the exterior's first, then the interior's, each from front to back.

    The interior is the sclera, a little smaller, up to a flat iris in the plane of its front rim. Groups:
    `eye_exteriors`; `eye_interiors`, which `irises` (up to the rim, the pupil included) and `scleras` share without
    overlap; and `pupils` (the pupil's edge and all inside it). The eye is its own mirror image in x, so
    `mirror` is the vertex at (-x, y, z), which is also the vertex of the other eye. In the uv map the exterior has the
    left half and the interior the right, each with its front above its back.

    Raises:
        InputError: not 0 < limbus radius < cornea radius, or the limbus does not fit on the sclera's front.
    """
    if not 0 < limbus_radius < min(cornea_radius, SCLERA_RADIUS * np.sin(_STILL)):
        raise InputError(
            "these radii make no eye",
            where="limbus_radius, cornea_radius",
            expected="0 < limbus radius < cornea radius, in metres, the limbus on the front of a sclera of 0.0146 m",
            got=f"{limbus_radius}, {cornea_radius}",
            fix="the means over people are 0.006 and 0.0085",
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
    return Part(
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


def pupil_displacement(part: Part) -> Float[np.ndarray, "V 3"]:
    """What one unit of the pupil's coefficient c adds to the vertices of an `eyeball`.

    The pupil's radius is r_iris (1/2 + c/6): a point at -3, half the iris at rest, the whole iris at +3. The iris
    between pupil and rim is stretched or compressed linearly, the pupil inside its edge too.
    """
    planar = part.vertices * [1, 1, 0] * part.groups["irises"][:, None]
    radius = np.linalg.norm(planar, axis=1, keepdims=True)
    moved = np.minimum(radius, radius.max() - radius) / 3
    return planar * np.divide(moved, radius, out=np.zeros_like(radius), where=radius > 0)


def variation(samples: int = 10_000, *, components: int = 3, seed: int = 0) -> Float[np.ndarray, "K V 3"]:
    """The linear identity basis of `eyeball()`'s vertices: K components, each scaled by its standard deviation.

    Radii of limbus and cornea are drawn from their normal distributions (again where the cornea would be no larger than
    the limbus), each draw makes a dense smoothed polyline whose vertices keep their places relative to the limbus, and
    the components are those of the polylines (PCA about their mean). Their scores over the draws give the same linear
    combinations of the mesh's rings, so nothing is interpolated and the iris follows the limbus. Behind 65 degrees from
    the axis nothing moves. A positive coefficient of any component lengthens the eye.
    """
    limbus, cornea = draw_radii(samples, np.random.default_rng(seed))
    lines = _surface(_POLYLINE, limbus, cornea).reshape(samples, -1)
    lines -= lines.mean(0)
    variances, axes = np.linalg.eigh(lines.T @ lines / (samples - 1))
    scores = lines @ axes[:, : -components - 1 : -1] / np.sqrt(variances[: -components - 1 : -1])
    rings = _outline(limbus, cornea)
    basis = np.einsum("nk,nrc->krc", scores, rings - rings.mean(0)) / (samples - 1)
    return _revolve(basis * np.sign(basis[:, :1, 1:]))


def draw_radii(samples: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Radii of limbus and cornea of `samples` people, the cornea's always the larger."""
    means, deviations = [LIMBUS_RADIUS, CORNEA_RADIUS], [LIMBUS_DEVIATION, CORNEA_DEVIATION]
    drawn = np.empty((0, 2))
    while len(drawn) < samples:
        more = means + rng.standard_normal((samples, 2)) * deviations
        drawn = np.concatenate([drawn, more[more[:, 0] < more[:, 1]]])
    return drawn[:samples, 0], drawn[:samples, 1]


def radius_at(
    angle: Float[np.ndarray, "..."], limbus_radius: Float[np.ndarray, "..."], cornea_radius: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """Distance of the exterior from the eye's centre at a polar angle from the optical axis; all broadcast.

    The spheres share the limbus: z_l = sqrt(r_s^2 - r_l^2), and the cornea's centre is z_c = z_l - sqrt(r_c^2 - r_l^2).
    Across `BLEND_LENGTH`, half of it on each side of the limbus, a cubic keeps the values and slopes of both.
    """
    centre = np.sqrt(SCLERA_RADIUS**2 - limbus_radius**2) - np.sqrt(cornea_radius**2 - limbus_radius**2)
    start = np.arcsin(limbus_radius / SCLERA_RADIUS) - _HALF_BLEND
    front = np.minimum(angle, start)
    root = np.sqrt(cornea_radius**2 - (centre * np.sin(front)) ** 2)
    rise = centre * np.cos(front) + root - SCLERA_RADIUS
    slope = -centre * np.sin(front) * (1 + centre * np.cos(front) / root)
    # Hermite's cubic: at t = 0, up to `start`, it is the cornea itself, from t = 1 on the sclera.
    t = np.clip((angle - start) / (2 * _HALF_BLEND), 0, 1)
    return SCLERA_RADIUS + (1 - t) ** 2 * (rise * (1 + 2 * t) + 2 * _HALF_BLEND * slope * t)


def _surface(
    angles: Float[np.ndarray, "R"], limbus_radius: Float[np.ndarray, "..."], cornea_radius: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "... R 2"]:
    """The exterior's points at the mean eye's polar angles, which move along so that limbus stays limbus.

    In front all angles scale alike; behind, the shift of the limbus fades out up to `_STILL`.
    """
    limbus_radius, cornea_radius = limbus_radius[..., None], cornea_radius[..., None]
    t = np.clip((angles - _MEAN_LIMBUS) / (_STILL - _MEAN_LIMBUS), 0, 1)
    share = np.where(angles < _MEAN_LIMBUS, angles / _MEAN_LIMBUS, (1 - t) ** 2 * (1 + 2 * t))
    moved = angles + share * (np.arcsin(limbus_radius / SCLERA_RADIUS) - _MEAN_LIMBUS)
    axial = np.stack([np.where(angles < np.pi, np.sin(moved), 0), np.cos(moved)], -1)
    return radius_at(moved, limbus_radius, cornea_radius)[..., None] * axial


def _outline(
    limbus_radius: Float[np.ndarray, "..."], cornea_radius: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "... R 2"]:
    """(Distance from the axis, z) of every ring: the exterior's, then the interior's, each from front to back."""
    limbus = np.arcsin(limbus_radius / SCLERA_RADIUS)
    rim = SCLERA_RADIUS * np.stack([np.sin(limbus), np.cos(limbus)], -1)
    iris = rim[..., None, :] * np.stack([_IRIS, np.ones_like(_IRIS)], -1)
    interior = np.concatenate([iris, _surface(_BACK, limbus_radius, cornea_radius)], -2)
    return np.concatenate([_surface(_EXTERIOR, limbus_radius, cornea_radius), INTERIOR_SCALE * interior], -2)


def _layout() -> tuple[Int[np.ndarray, "V"], Int[np.ndarray, "V"]]:
    """Each vertex' ring, in the order of `_outline`, and its place in that ring, or -1 for a pole."""
    rings = len(_EXTERIOR) + len(_INTERIOR)
    poles = [0, len(_EXTERIOR) - 1, len(_EXTERIOR), rings - 1]
    counts = np.where(np.isin(np.arange(rings), poles), 1, SEGMENTS)
    column = np.concatenate([[-1] if count == 1 else np.arange(count) for count in counts])
    return np.repeat(np.arange(rings), counts), column


def _revolve(outline: Float[np.ndarray, "... R 2"]) -> Float[np.ndarray, "... V 3"]:
    ring, column = _layout()
    return np.concatenate([outline[..., ring, :1] * _directions(column), outline[..., ring, 1:]], -1)


def _directions(column: Int[np.ndarray, "V"]) -> Float[np.ndarray, "V 2"]:
    """Unit vectors in the plane of a ring, from +X towards +Y; columns k and `SEGMENTS` / 2 - k mirror each other."""
    # One quarter's sines make all, so that mirror images agree to the last bit.
    quarter = SEGMENTS // 4
    sines = np.sin(np.pi / 2 * np.arange(quarter + 1) / quarter)
    sines = np.concatenate([sines, sines[-2::-1], -sines[1:], -sines[-2:0:-1]])
    return np.stack([sines[(column + quarter) % SEGMENTS], sines[column]], -1) * (column >= 0)[:, None]


def _shell_quads(rings: int) -> Int[np.ndarray, "Q 4"]:
    """Quads of one closed shell, counter-clockwise seen from outside; at a pole each takes two edges of the ring."""
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
    """The uv map of one shell about a given u: two discs, distances from each pole true, the seam where z = 0."""
    angle, planar = angles[ring][:, None], _directions(column)
    front = [u, 0.75] + _UV_RADIUS * angle / (np.pi / 2) * planar
    back = [u, 0.25] + _UV_RADIUS * (2 - angle / (np.pi / 2)) * planar * [-1, 1]
    in_front = angles[ring[quads]].max(1) <= np.pi / 2
    return np.where(in_front[:, None, None], front[quads], back[quads])
