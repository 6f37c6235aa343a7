"""The dental arch: sizes of the permanent teeth, the curve on which they stand, and each tooth's frame on it. Metres.

Sizes are those of [Nelson and Ash], table of measurements (crown length, mesiodistal and buccolingual diameters);
inclinations are those of the long axes to the normal of the occlusal plane. Teeth have their FDI numbers: 1x upper
right, 2x upper left, 3x lower left, 4x lower right; x = 1 central incisor .. 7 second molar.

A tooth's frame: m runs along the arch from mesial to distal, b outwards (to lip or cheek), h towards the tip, zero at
the neck.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from registration.errors import InputError

OVERJET = 2.7e-3  # offset of the lower teeth's curve inside the upper teeth's
_ARCH_EXPONENT = 2.2  # of the superellipse that the arch is in plan view
_FRONT_INSET, _SIDE_INSET = 3.1e-3, 5.6e-3  # from the guide's outline to the curve on which the teeth touch


@dataclass(frozen=True, kw_only=True)
class Crown:
    """The shape that teeth of one kind share, relative to their size."""

    cells: tuple[int, int]  # of the biting surface's grid along m and along b, both even
    # From root to rim: height (fraction of the crown's), half width (fraction of half the width), buccal and lingual
    # surface (fraction of half the depth), exponent of the superellipse (2: an ellipse; larger: boxier). The root's
    # height is in metres.
    rings: tuple[tuple[float, float, float, float, float], ...]
    falls: tuple[float, float]  # drop of the rim at its mesial and distal end, fraction of the height
    # Points of the biting surface inside the rim, b the outer and m the inner index: m (fraction of half the width), b
    # (fraction of half the depth), height (fraction of the crown's).
    top: tuple[tuple[float, float, float], ...]
    taper: float  # fraction by which the lingual side is narrower
    tip: int  # index in `top` of the landmark


@dataclass(frozen=True, kw_only=True)
class Tooth:
    """The size of one tooth (metres) and its inclination in the arch."""

    crown: Crown
    width: float  # mesiodistal
    height: float  # of the crown
    depth: float  # buccolingual
    tilt: float  # inclination of the tip outwards, degrees
    lean: float = 0.0  # inclination of the tip towards the midline, degrees
    overlap: float  # of the tip beyond the occlusal plane, towards the other arch, metres


_INCISOR = Crown(
    cells=(4, 2),
    rings=(
        (-3.0e-3, 0.55, 0.72, -0.72, 2.0),
        (0.0, 0.75, 0.96, -0.96, 2.2),
        (0.48, 0.95, 0.86, -0.40, 2.8),
        (0.92, 1.00, 0.36, -0.16, 3.5),
    ),
    falls=(0.02, 0.06),
    top=((-0.55, 0.12, 0.995), (0.0, 0.12, 1.0), (0.5, 0.12, 0.985)),
    taper=0.40,
    tip=1,
)
_CANINE = Crown(
    cells=(4, 2),
    rings=(
        (-3.0e-3, 0.60, 0.80, -0.80, 2.0),
        (0.0, 0.74, 0.96, -0.96, 2.1),
        (0.45, 1.00, 0.92, -0.55, 2.5),
        (0.82, 0.96, 0.52, -0.30, 2.8),
    ),
    falls=(0.17, 0.24),
    top=((-0.48, 0.12, 0.87), (0.0, 0.12, 1.0), (0.48, 0.12, 0.83)),
    taper=0.30,
    tip=1,
)
_PREMOLAR = Crown(
    cells=(2, 4),
    rings=(
        (-3.0e-3, 0.66, 0.72, -0.72, 2.0),
        (0.0, 0.80, 0.86, -0.86, 2.4),
        (0.45, 1.0, 1.00, -0.98, 2.8),
        (0.80, 0.96, 0.80, -0.80, 3.0),
    ),
    falls=(0.04, 0.05),
    top=((0.0, -0.46, 0.93), (0.0, -0.02, 0.74), (0.0, 0.50, 1.0)),
    taper=0.18,
    tip=2,
)
_MOLAR = Crown(
    cells=(4, 4),
    rings=(
        (-3.0e-3, 0.74, 0.76, -0.76, 2.4),
        (0.0, 0.82, 0.88, -0.88, 2.6),
        (0.45, 1.0, 1.00, -1.00, 3.0),
        (0.80, 0.94, 0.80, -0.80, 3.0),
    ),
    falls=(0.0, 0.02),
    top=(
        (-0.46, -0.48, 0.98),
        (0.02, -0.50, 0.80),
        (0.46, -0.46, 0.92),
        (-0.55, 0.0, 0.80),
        (0.0, 0.0, 0.70),
        (0.52, 0.0, 0.78),
        (-0.48, 0.50, 1.0),
        (0.02, 0.54, 0.82),
        (0.46, 0.50, 0.95),
    ),
    taper=0.08,
    tip=6,
)
# From the midline outwards.
UPPER = (
    Tooth(crown=_INCISOR, width=8.5e-3, height=10.5e-3, depth=7.0e-3, tilt=24, lean=2, overlap=1.4e-3),
    Tooth(crown=_INCISOR, width=6.5e-3, height=9.0e-3, depth=6.0e-3, tilt=22, lean=3, overlap=0.9e-3),
    Tooth(crown=_CANINE, width=7.5e-3, height=10.0e-3, depth=8.0e-3, tilt=19, lean=3, overlap=1.2e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.5e-3, depth=9.0e-3, tilt=10, lean=3, overlap=0.75e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.5e-3, depth=9.0e-3, tilt=7, lean=2, overlap=0.75e-3),
    Tooth(crown=_MOLAR, width=10.0e-3, height=7.5e-3, depth=11.0e-3, tilt=4, lean=1, overlap=0.45e-3),
    Tooth(crown=_MOLAR, width=9.0e-3, height=7.0e-3, depth=11.0e-3, tilt=6, overlap=0.45e-3),
)
LOWER = (
    Tooth(crown=_INCISOR, width=5.0e-3, height=9.0e-3, depth=6.0e-3, tilt=14, lean=1, overlap=0.0),
    Tooth(crown=_INCISOR, width=5.5e-3, height=9.5e-3, depth=6.5e-3, tilt=12, lean=1.5, overlap=0.0),
    Tooth(crown=_CANINE, width=7.0e-3, height=11.0e-3, depth=7.5e-3, tilt=8, lean=1, overlap=0.2e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.5e-3, depth=7.5e-3, tilt=2, lean=2, overlap=0.75e-3),
    Tooth(crown=_PREMOLAR, width=7.0e-3, height=8.0e-3, depth=8.0e-3, tilt=-5, lean=1, overlap=0.7e-3),
    Tooth(crown=_MOLAR, width=11.0e-3, height=7.5e-3, depth=10.5e-3, tilt=-8, overlap=0.45e-3),
    Tooth(crown=_MOLAR, width=10.5e-3, height=7.0e-3, depth=10.0e-3, tilt=-8, overlap=0.45e-3),
)
FDI_UPPER = (17, 16, 15, 14, 13, 12, 11, 21, 22, 23, 24, 25, 26, 27)  # from the subject's right to left
FDI_LOWER = (47, 46, 45, 44, 43, 42, 41, 31, 32, 33, 34, 35, 36, 37)


@dataclass(frozen=True, kw_only=True)
class Arch:
    """The curve of the upper teeth's contacts: half a superellipse in the occlusal plane. Metres, model frame."""

    half_width: float  # x at the back
    front: float  # z at the midline
    back: float  # z where the arch is widest
    height: float  # y of the occlusal plane at the front
    slope: float  # rise of the occlusal plane per metre towards the back


def fit_arch(upper_guide: Float[np.ndarray, "S 3"], lower_guide: Float[np.ndarray, "R 3"]) -> Arch:
    """Fit the dental arch to coarse horseshoe-shaped strips around the upper and the lower teeth.

    In plan view the arch is the upper strip's outline, inset so that the teeth keep clear of lips and cheeks. The
    occlusal plane lies midway between the upper strip's lower edge and the lower strip's upper edge.

    Args:
        upper_guide: points of the upper strip, metres, model frame.
        lower_guide: points of the lower strip.

    Returns:
        The arch.

    Raises:
        InputError: a guide has fewer than three points or a non-finite one, or the arch is too small for teeth.
    """
    for name, guide in (("upper_guide", upper_guide), ("lower_guide", lower_guide)):
        if len(guide) < 3 or not np.isfinite(guide).all():
            raise InputError(
                "The guide does not determine a dental arch",
                where=name,
                expected="at least three finite points, in metres",
                got=f"{len(guide)} points, {int((~np.isfinite(guide)).any(1).sum())} of them not finite",
                fix="pass the vertices of a strip around the teeth",
            )
    half_width = float(np.abs(upper_guide[:, 0]).max() - _SIDE_INSET)
    front, back = float(upper_guide[:, 2].max() - _FRONT_INSET), float(upper_guide[:, 2].min())
    if half_width < 0.01 or front - back < 0.02 or np.ptp(lower_guide[:, 2]) < 0.01:
        raise InputError(
            "The guides are too small for teeth",
            where="upper_guide, lower_guide",
            expected="arches more than 32 mm wide and 24 mm deep that open backwards",
            got=f"half width {half_width:.4f} m and depth {front - back:.4f} m after the inset from the lips",
            fix="check the unit (metres) and the frame (+Y up, +Z out of the face)",
        )
    edges = np.array([_occlusal_edge(upper_guide, -1), _occlusal_edge(lower_guide, 1)])  # arch, front or back, (z, y)
    slopes = (edges[:, 1, 1] - edges[:, 0, 1]) / (edges[:, 0, 0] - edges[:, 1, 0])
    heights = edges[:, 0, 1] + slopes * (edges[:, 0, 0] - front)
    height, slope = float(heights.mean()), float(slopes.mean())
    return Arch(half_width=half_width, front=front, back=back, height=height, slope=slope)


@dataclass(frozen=True, kw_only=True)
class ArchPlacement:
    """Frames of the T teeth of an arch's left half, from the midline outwards. Metres, model frame."""

    teeth: tuple[Tooth, ...]
    scale: float  # of the sizes of all teeth
    upper: bool  # the upper arch, whose tips point down and whose frames are right-handed
    tip: Float[np.ndarray, "T 3"]  # origins
    m: Float[np.ndarray, "T 3"]  # unit axes; see the module
    b: Float[np.ndarray, "T 3"]
    h: Float[np.ndarray, "T 3"]


def place_teeth(arch: Arch, teeth: tuple[Tooth, ...], *, upper: bool) -> ArchPlacement:
    """Place teeth side by side along an arch.

    Teeth too wide for the arch are all scaled by the same factor. The lower teeth stand `OVERJET` inside the arch.

    Args:
        arch: the arch of the upper teeth.
        teeth: from the midline outwards.
        upper: whether these are the upper teeth.

    Returns:
        The frames of the left half's teeth.
    """
    angle = np.linspace(0, np.pi / 2, 2001)
    line = np.stack([np.sin(angle), np.cos(angle)], 1) ** (2 / _ARCH_EXPONENT)
    stretch = np.hypot(1, arch.slope)  # ratio of lengths in the inclined plane to those in plan view
    line = line * [arch.half_width, stretch * (arch.front - arch.back)]  # (x, towards the front), in that plane
    if not upper:
        tangent = np.gradient(line, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        tangent[0] = [1, 0]
        line = line + OVERJET * tangent[:, ::-1] * [1, -1]
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    scale = min(1.0, length / sum(tooth.width for tooth in teeth))
    contacts = [np.array([0, line[0, 1]])]
    for tooth in teeth:
        contacts.append(_next_contact(line, contacts[-1], scale * tooth.width))
    forward = np.array([0, -arch.slope, 1]) / stretch
    normal = np.array([0, 1, arch.slope]) / stretch
    origin = np.array([0, arch.height, arch.front]) - stretch * (arch.front - arch.back) * forward
    points = origin + np.array([[x, 0, 0] + y * forward for x, y in contacts])
    m = np.diff(points, axis=0)
    m /= np.linalg.norm(m, axis=1, keepdims=True)
    outward = np.cross(m, normal)
    axis = -normal if upper else normal
    tilt, lean = np.radians([[tooth.tilt, tooth.lean] for tooth in teeth]).T[..., None]
    overlap = scale * np.array([tooth.overlap for tooth in teeth])[:, None]
    tilted = np.cos(tilt) * axis + np.sin(tilt) * outward
    return ArchPlacement(
        teeth=teeth,
        scale=scale,
        upper=upper,
        tip=(points[1:] + points[:-1]) / 2 + overlap * axis,
        m=np.cos(lean) * m + np.sin(lean) * tilted,
        b=np.cos(tilt) * outward - np.sin(tilt) * axis,
        h=np.cos(lean) * tilted - np.sin(lean) * m,
    )


def _next_contact(
    line: Float[np.ndarray, "P 2"], start: Float[np.ndarray, "2"], width: float
) -> Float[np.ndarray, "2"]:
    """Return the next point of a polyline at distance `width` from `start`; the polyline is extended beyond its end."""
    beyond = line[-1] + 2 * width * (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    line = np.concatenate([line, beyond[None]])
    distance = np.linalg.norm(line - start, axis=1)
    nearest = int(distance.argmin())
    after = nearest + int(np.argmax(distance[nearest:] >= width))
    before = line[after - 1] - start
    along = line[after] - line[after - 1]
    # |before + t along| = width
    a, half, c = along @ along, before @ along, before @ before - width**2
    return line[after - 1] + along * (-half + np.sqrt(half**2 - a * c)) / a


def _occlusal_edge(guide: Float[np.ndarray, "S 3"], sign: int) -> Float[np.ndarray, "2 2"]:
    """Return (z, y) of a guide's lowest (sign -1) or highest (1) point in the front and the back third of its depth."""
    depth = (guide[:, 2] - guide[:, 2].min()) / np.ptp(guide[:, 2])
    thirds = [guide[depth >= 2 / 3], guide[depth <= 1 / 3]]
    return np.stack([points[np.argmax(sign * points[:, 1]), 2:0:-1] for points in thirds])
