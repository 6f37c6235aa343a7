"""Cross-sections of sampled eyeballs, and their principal components: the two-sphere model of
[GNM, Eyeball Model Formulation].

A sclera of fixed radius and a smaller corneal sphere meet at the limbus and are blended there. A cross-section is the
outline in a plane through the optical axis: points (distance from the axis, z), metres, the sclera's centre at the
origin. Every point keeps to its structure: a point of the mean eye's limbus lies on the limbus of every eye.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

SCLERA_RADIUS = 14.6e-3  # the same for all subjects, so that the lids fit every eye
LIMBUS_RADIUS, LIMBUS_DEVIATION = 6.0e-3, 0.44e-3  # mean, standard deviation
CORNEA_RADIUS, CORNEA_DEVIATION = 8.5e-3, 0.73e-3
BLEND_LENGTH = 1.0e-3  # of the blend from cornea to sclera, along the sclera
FIXED_FROM = np.radians(65.0)  # beyond this polar angle all eyes have the same vertices
_POINTS = 49  # of the outlines that are compared, in front of the limbus and behind it

Outline = Callable[[Float[np.ndarray, "N"], Float[np.ndarray, "N"]], Float[np.ndarray, "N R 2"]]


def mean_limbus(sclera_radius: float = SCLERA_RADIUS) -> float:
    """Return the polar angle of the mean eye's limbus, radians: 24.27 degrees for the default radius."""
    return float(np.arcsin(LIMBUS_RADIUS / sclera_radius))


def half_blend(sclera_radius: float = SCLERA_RADIUS) -> float:
    """Return the polar angle of half the blend, radians."""
    return BLEND_LENGTH / sclera_radius / 2


def sample_radii(samples: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"], int]:
    """Sample radii of limbus and cornea, metres; rejects corneas that are no larger than the limbus.

    Returns:
        Radii of the limbus, of the cornea, and how many samples were rejected on the way.
    """
    means, deviations = [LIMBUS_RADIUS, CORNEA_RADIUS], [LIMBUS_DEVIATION, CORNEA_DEVIATION]
    radii, drawn = np.empty((0, 2)), 0
    while len(radii) < samples:
        candidates = means + rng.standard_normal((samples, 2)) * deviations
        possible = np.flatnonzero(candidates[:, 0] < candidates[:, 1])[: samples - len(radii)]
        drawn += int(possible[-1]) + 1 if len(possible) else samples
        radii = np.concatenate([radii, candidates[possible]])
    return radii[:, 0], radii[:, 1], drawn - samples


def radius_at(
    angle: Float[np.ndarray, "..."],
    limbus_radius: Float[np.ndarray, "..."],
    cornea_radius: Float[np.ndarray, "..."],
    sclera_radius: float = SCLERA_RADIUS,
) -> Float[np.ndarray, "..."]:
    """Return the exterior's distance from the eye's centre at polar angles from the optical axis.

    The spheres share the limbus: z_l = sqrt(r_s^2 - r_l^2), and the cornea's centre is z_c = z_l - sqrt(r_c^2 - r_l^2).
    Within half of `BLEND_LENGTH` to either side of the limbus, a cubic matches values and slopes of both spheres.

    Args:
        angle: radians; broadcasts with the radii.
        limbus_radius: metres.
        cornea_radius: metres.
        sclera_radius: metres.

    Returns:
        Distances, metres.
    """
    half = half_blend(sclera_radius)
    centre = np.sqrt(sclera_radius**2 - limbus_radius**2) - np.sqrt(cornea_radius**2 - limbus_radius**2)
    start = np.arcsin(limbus_radius / sclera_radius) - half
    front = np.minimum(angle, start)
    root = np.sqrt(cornea_radius**2 - (centre * np.sin(front)) ** 2)
    rise = centre * np.cos(front) + root - sclera_radius
    slope = -centre * np.sin(front) * (1 + centre * np.cos(front) / root)
    # Cubic Hermite blend: the cornea for t = 0, the sclera for t = 1.
    t = np.clip((angle - start) / (2 * half), 0, 1)
    return sclera_radius + (1 - t) ** 2 * (rise * (1 + 2 * t) + 2 * half * slope * t)


def slide(
    angles: Float[np.ndarray, "R"], limbus_radius: Float[np.ndarray, "..."], sclera_radius: float = SCLERA_RADIUS
) -> Float[np.ndarray, "... R"]:
    """Return where the points at the mean eye's polar angles lie on eyes with other limbi: polar angles, radians.

    In front of the limbus all angles scale by one factor; behind it the shift decreases to zero at `FIXED_FROM`.
    """
    mean = mean_limbus(sclera_radius)
    t = np.clip((angles - mean) / (FIXED_FROM - mean), 0, 1)
    weight = np.where(angles < mean, angles / mean, (1 - t) ** 2 * (1 + 2 * t))
    return angles + weight * (np.arcsin(limbus_radius[..., None] / sclera_radius) - mean)


def surface(
    angles: Float[np.ndarray, "R"],
    limbus_radius: Float[np.ndarray, "..."],
    cornea_radius: Float[np.ndarray, "..."],
    sclera_radius: float = SCLERA_RADIUS,
) -> Float[np.ndarray, "... R 2"]:
    """Return the exterior's points at the mean eye's polar angles, each shifted as `slide` says."""
    shifted = slide(angles, limbus_radius, sclera_radius)
    axial = np.stack([np.where(angles < np.pi, np.sin(shifted), 0), np.cos(shifted)], -1)
    return radius_at(shifted, limbus_radius[..., None], cornea_radius[..., None], sclera_radius)[..., None] * axial


def rim(limbus_radius: Float[np.ndarray, "..."], sclera_radius: float = SCLERA_RADIUS) -> Float[np.ndarray, "... 2"]:
    """Return the point of the sclera at the limbus."""
    limbus = np.arcsin(limbus_radius / sclera_radius)
    return sclera_radius * np.stack([np.sin(limbus), np.cos(limbus)], -1)


@dataclass(frozen=True, kw_only=True, eq=False)
class SectionModes:
    """The principal components of sampled cross-sections: N samples, K components."""

    angles: Float[np.ndarray, "P"]  # of the cross-sections' points: polar angles on the mean eye's radii
    mean: Float[np.ndarray, "P 2"]  # of the samples' cross-sections
    limbus: Float[np.ndarray, "N"]  # radii of the samples, metres
    cornea: Float[np.ndarray, "N"]
    rejected: int  # samples whose cornea was no larger than the limbus
    scores: Float[np.ndarray, "N K"]  # of the samples, with unit variance
    signs: Float[np.ndarray, "K"]  # with which a positive score lengthens the eye
    variances: Float[np.ndarray, "L"]  # of all components, descending

    def reference_angles(self, polar_angles: Float[np.ndarray, "R"]) -> Float[np.ndarray, "R"]:
        """Return which points of the cross-sections have these polar angles in the mean of the samples."""
        of_mean = np.arctan2(self.mean[:, 0], self.mean[:, 1])
        shift = np.interp(polar_angles, of_mean, self.angles - of_mean, left=0.0, right=0.0)
        return polar_angles + shift

    def components(self, outline: Outline) -> tuple[Float[np.ndarray, "R 2"], Float[np.ndarray, "K R 2"]]:
        """Return the mean and the components of other points of the same eyes, per standard deviation, metres.

        The components combine the samples' points as they combine their cross-sections, so that nothing is
        interpolated.

        Args:
            outline: gives R points of every sample for its radii of limbus and cornea.
        """
        points = outline(self.limbus, self.cornea)
        mean = points.mean(0)
        basis = np.einsum("nk,nrc->krc", self.scores, points - mean) / (len(points) - 1)
        return mean, basis * self.signs[:, None, None]


def section_modes(
    samples: int, components: int, rng: np.random.Generator, sclera_radius: float = SCLERA_RADIUS
) -> SectionModes:
    """Sample eyes and compute the principal components of their cross-sections about the mean.

    Args:
        samples: N.
        components: K.
        rng: of the samples.
        sclera_radius: metres, the same for all samples.
    """
    limbus, cornea, rejected = sample_radii(samples, rng)
    mean = mean_limbus(sclera_radius)
    angles = np.concatenate([np.linspace(0, mean, _POINTS), np.linspace(mean, FIXED_FROM, _POINTS)[1:]])
    lines = surface(angles, limbus, cornea, sclera_radius).reshape(samples, -1)
    middle = lines.mean(0)
    lines -= middle
    variances, axes = np.linalg.eigh(lines.T @ lines / (samples - 1))
    axes = axes[:, : -components - 1 : -1]
    scores = lines @ axes / np.sqrt(variances[: -components - 1 : -1])
    signs = np.sign(axes[1])  # row 1 is the apex's z
    return SectionModes(
        angles=angles,
        mean=middle.reshape(-1, 2),
        limbus=limbus,
        cornea=cornea,
        rejected=rejected,
        scores=scores,
        signs=signs,
        variances=variances[::-1],
    )


def pupil_displacement(planar: Float[np.ndarray, "N 3"], iris_radius: float | np.floating) -> Float[np.ndarray, "N 3"]:
    """Return the displacement of an iris's vertices per unit of the pupil's coefficient c, metres.

    The pupil's radius is r_iris (1/2 + c/6): a point at -3, half the iris at 0, the whole iris at +3. Iris and pupil
    are stretched linearly.

    Args:
        planar: the vertices' offsets from the optical axis, at right angles to it, metres; those of the pupil's edge
            are half as long as those of the iris's edge.
        iris_radius: metres.
    """
    radius = np.linalg.norm(planar, axis=1, keepdims=True)
    change = np.minimum(radius, iris_radius - radius) / 3
    return planar * np.divide(change, radius, out=np.zeros_like(radius), where=radius > 0)
