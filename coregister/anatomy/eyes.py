"""Eyes and pupils of any model, from sampled eyeballs [GNM, Eyeball Model Formulation].

Both bases are computed once in the eyes' own frame (`registration.anatomy.eye_structure`) and moved into each eye, so
that one set of coefficients changes both alike.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from coregister.anatomy import eye_sections
from coregister.anatomy.part_basis import PartBasis
from registration.anatomy.eye_structure import EyeStructure, find_eyes
from registration.errors import InputError, check_seed
from registration.frames import MM_PER_M
from registration.geometry.topology import edges
from registration.model.gnm_npz import GNMData

_SCLERA_RANGE = (11e-3, 18e-3)  # metres: what the radii of limbus and cornea are made for, 14.6 mm, and what is near it
_MIN_SAMPLES = 100
_MAX_RING_CHANGE = 0.3e-3  # metres, of the iris's and the pupil's edges to become exact circles


@dataclass(frozen=True, kw_only=True)
class EyeSettings:
    """How the eyes' basis is made.

    Attributes:
        samples: number of sampled eyeballs.
        components: number of components to keep.
        seed: of the samples.
        mean_template: put the mean of the samples into the template; otherwise its own eyes stay, and the components
            move them.
    """

    samples: int = 10_000
    components: int = 3
    seed: int = 0
    mean_template: bool = True

    def check(self) -> None:
        """Raises InputError for settings that give no basis."""
        check_seed(self.seed)
        if self.samples < _MIN_SAMPLES or not 1 <= self.components <= 10:
            raise InputError(
                "These settings give no basis of the eyes",
                where="EyeSettings",
                expected=f"at least {_MIN_SAMPLES} samples, 1 to 10 components",
                got=f"{self.samples} samples, {self.components} components",
            )


def eye_basis(data: GNMData, settings: EyeSettings = EyeSettings()) -> PartBasis:  # noqa: B008  frozen
    """Build the identity components of both eyeballs, named eye_000, eye_001 ...

    Sampled cross-sections (`eye_sections`) give the components; each vertex of the exterior follows the cross-section
    at its polar angle in their mean, the inner shell the sclera below it, and the iris the limbus. All is evaluated on
    the samples at the vertex' own angle. The sclera's radius, the same for all samples, is the model's own.

    Args:
        data: any model of the official schema.
        settings: of the samples.

    Raises:
        InputError: as `find_eyes`, a sclera of no human size, or settings that give no basis.
    """
    settings.check()
    eyes = find_eyes(data)
    _check_size(eyes)
    modes = eye_sections.section_modes(
        settings.samples, settings.components, np.random.default_rng(settings.seed), eyes.sclera_radius
    )
    angles = modes.reference_angles(eyes.polar_angle)
    mean, components = modes.components(lambda limbus, cornea: _outlines(eyes, angles, limbus, cornea))
    template, moved = None, 0.0
    if settings.mean_template:
        change = _mean_change(eyes, mean)
        template = place_template(data, eyes, _revolved(eyes, change))
        moved = float(np.linalg.norm(change, axis=1).max())
    kept = modes.variances[: settings.components].sum() / modes.variances.sum()
    vertices, values = place(eyes, _revolved(eyes, components))
    return PartBasis(
        part="eyes",
        vertices=vertices,
        components=values,
        names=tuple(f"eye_{k:03d}" for k in range(settings.components)),
        template=template,
        record={
            "seed": settings.seed,
            "samples": settings.samples,
            "rejected": modes.rejected,
            "variance_kept": float(kept),
            "sclera_radius_mm": MM_PER_M * eyes.sclera_radius,
            "limbus_radius_mm": [MM_PER_M * eye_sections.LIMBUS_RADIUS, MM_PER_M * eye_sections.LIMBUS_DEVIATION],
            "cornea_radius_mm": [MM_PER_M * eye_sections.CORNEA_RADIUS, MM_PER_M * eye_sections.CORNEA_DEVIATION],
            "template_moved_mm": MM_PER_M * moved,
            "from_revolution_mm": MM_PER_M * max(eyes.left.deviation, eyes.right.deviation),
            "left_from_right_mm": MM_PER_M * eyes.asymmetry,
        },
    )


def pupils_basis(data: GNMData) -> PartBasis:
    """Build the expression component of both pupils, pupils_000, for coefficients in [-3, 3].

    At -3 the pupil is a point, at 0 half the iris, at 3 the whole iris; pupil and iris are stretched linearly, at right
    angles to the optical axis. The pupil's edge in the template is moved onto a circle of half the iris's radius, the
    iris's edge onto a circle, so that the ends are exact.

    Args:
        data: any model of the official schema.

    Raises:
        InputError: as `find_eyes`, or an iris whose pupil and edge are no rings.
    """
    eyes = find_eyes(data)
    iris = _iris_rings(data, eyes)
    planar = iris.offsets * eyes.iris[:, None]
    displacement = eye_sections.pupil_displacement(planar, iris.radius) * eyes.iris[:, None]
    change = np.where(eyes.iris[:, None], iris.change, 0)
    vertices, values = place(eyes, displacement[None])
    return PartBasis(
        part="pupils",
        vertices=vertices,
        components=values,
        names=("pupils_000",),
        template=place_template(data, eyes, change),
        record={
            "samples": 0,
            "rejected": 0,
            "variance_kept": 1.0,
            "coefficient": [-3, 3],
            "iris_radius_mm": MM_PER_M * iris.radius,
            "template_moved_mm": MM_PER_M * float(np.linalg.norm(change, axis=1).max()),
        },
    )


def place(eyes: EyeStructure, displacements: Float[np.ndarray, "K N 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices of both eyes, ascending, and displacements of the own frame in the model's frame."""
    vertices = np.concatenate([eyes.left.vertices, eyes.right.vertices])
    values = np.concatenate([eye.to_model(displacements) for eye in (eyes.left, eyes.right)], axis=1)
    order = np.argsort(vertices)
    return vertices[order], values[:, order]


def place_template(data: GNMData, eyes: EyeStructure, change: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    """Return both eyes of the template, in the order of `place`: those of the model, in which the vertices that change
    leave their place for that of the mean of both eyes, moved by the change; own frame, metres."""
    vertices = np.concatenate([eyes.left.vertices, eyes.right.vertices])
    result = data.template_vertex_positions[vertices].astype(np.float64)
    moved = np.abs(change).max(1) > 0
    for eye, rows in ((eyes.left, slice(0, len(change))), (eyes.right, slice(len(change), None))):
        new = eye.centre + eye.to_model(eyes.positions + change)
        result[rows][moved] = new[moved]
    return result[np.argsort(vertices)]


def _check_size(eyes: EyeStructure) -> None:
    low, high = _SCLERA_RANGE
    if not low <= eyes.sclera_radius <= high:
        raise InputError(
            "The model's eyes have no human size",
            where="template_vertex_positions",
            expected=f"a sclera with a radius of {MM_PER_M * low:.0f} to {MM_PER_M * high:.0f} mm",
            got=f"{MM_PER_M * eyes.sclera_radius:.2f} mm",
            fix="use a model in metres with eyes of life size",
        )


def _outlines(
    eyes: EyeStructure,
    angles: Float[np.ndarray, "N"],
    limbus: Float[np.ndarray, "S"],
    cornea: Float[np.ndarray, "S"],
) -> Float[np.ndarray, "S N 2"]:
    """Return (distance from the axis, z) of every vertex for sampled radii; `angles` are its points' on the mean radii.

    The exterior lies on the sampled surfaces. Of the inner shell, what is in front of the limbus, the iris, scales with
    the limbus and moves with it along the axis; the rest slides on its own sphere as the sclera's points do.
    """
    radius = eyes.sclera_radius
    points = np.empty((len(limbus), len(angles), 2))
    points[:, eyes.exterior] = eye_sections.surface(angles[eyes.exterior], limbus, cornea, radius)
    behind = ~eyes.exterior & (angles >= eye_sections.mean_limbus(radius))
    slid = eye_sections.slide(angles[behind], limbus, radius)
    points[:, behind] = eyes.radius[behind, None] * np.stack([np.sin(slid), np.cos(slid)], -1)
    front = ~eyes.exterior & ~behind
    scale = eyes.radius[behind].mean() / radius
    rim, mean_rim = (
        scale * eye_sections.rim(values, radius) for values in (limbus, np.array(eye_sections.LIMBUS_RADIUS))
    )
    points[:, front, 0] = eyes.axis_distance[front] * (rim[:, :1] / mean_rim[0])
    points[:, front, 1] = eyes.positions[front, 2] + (rim - mean_rim)[:, 1:]
    return points


def _mean_change(eyes: EyeStructure, mean: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
    """Return how far the mean of the samples is from the template, (outwards, z); the iris stays.

    The inner shell keeps its distance from the exterior.
    """
    rest = np.stack([eyes.axis_distance, eyes.positions[:, 2]], -1)
    change = np.where(eyes.exterior[:, None], mean - rest, 0)
    outer = np.flatnonzero(eyes.exterior)
    outer = outer[np.argsort(eyes.polar_angle[outer])]
    radial = np.linalg.norm(mean[outer], axis=1) - eyes.radius[outer]
    inner = ~eyes.exterior & ~eyes.iris
    change[inner] = np.interp(eyes.polar_angle[inner], eyes.polar_angle[outer], radial)[:, None] * (
        rest[inner] / eyes.radius[inner, None]
    )
    return change


def _revolved(eyes: EyeStructure, values: Float[np.ndarray, "*K N 2"]) -> Float[np.ndarray, "*K N 3"]:
    """Return displacements (outwards, z) of the vertices in the own frame's coordinates."""
    return values[..., :1] * eyes.outward + values[..., 1:] * np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class _Iris:
    radius: float  # of its edge
    offsets: Float[np.ndarray, "N 3"]  # of all vertices from the optical axis, in the changed template
    change: Float[np.ndarray, "N 3"]  # of the template


def _iris_rings(data: GNMData, eyes: EyeStructure) -> _Iris:
    """The iris, turned about the eye's centre until its edge is at right angles to the optical axis, with exact rings.

    The edge becomes a circle about the axis, the pupil's edge one of half its radius; what lies between is stretched
    with them.
    """
    pairs = _edges(data, eyes)
    edge = _rim(pairs, eyes.iris)
    pupil = _rim(pairs, eyes.pupil)
    rest = eyes.positions
    centred = rest[edge] - rest[edge].mean(0)
    normal = np.linalg.svd(centred)[2][2]
    turned = rest @ _rotation_to_z(normal * np.sign(normal[2])).T
    rho = np.hypot(turned[:, 0], turned[:, 1])
    radius, inner = float(rho[edge].mean()), float(rho[pupil].mean())
    scatter = max(np.abs(rho[edge] - radius).max(), np.abs(rho[pupil] - inner).max(), abs(inner - radius / 2))
    if scatter > _MAX_RING_CHANGE:
        raise InputError(
            "The iris of the model is not made of rings",
            where="template_vertex_positions, vertex_groups: irises, pupils",
            expected="circles about the optical axis, the pupil's edge half as large as the iris's, to "
            f"{MM_PER_M * _MAX_RING_CHANGE:.1f} mm",
            got=f"{MM_PER_M * scatter:.3f} mm, with radii of {MM_PER_M * inner:.2f} and {MM_PER_M * radius:.2f} mm",
            fix="use a model with the official eyes, or regenerate its other parts only",
        )
    wanted = np.interp(rho, [0, inner, radius], [0, radius / 2, radius])
    wanted[edge], wanted[pupil] = radius, radius / 2
    planar = turned * [1, 1, 0]
    planar *= np.divide(wanted, rho, out=np.zeros_like(rho), where=rho > 0)[:, None]
    height = turned[:, 2].copy()
    height[edge], height[pupil] = height[edge].mean(), height[pupil].mean()
    new = planar + height[:, None] * np.array([0.0, 0.0, 1.0])
    return _Iris(radius=radius, offsets=planar, change=new - rest)


def _edges(data: GNMData, eyes: EyeStructure) -> Int[np.ndarray, "E 2"]:
    """The left eye's edges, by position in `EyeStructure`."""
    place = np.full(len(data.template_vertex_positions), -1)
    place[eyes.left.vertices] = np.arange(len(eyes.left.vertices))
    pairs = place[edges(data.triangles[(place[data.triangles] >= 0).all(1)]).vertices]
    return np.asarray(pairs)


def _rim(pairs: Int[np.ndarray, "E 2"], members: Bool[np.ndarray, "N"]) -> Int[np.ndarray, "R"]:
    """The members with a neighbour that is none."""
    crossing = pairs[members[pairs[:, 0]] != members[pairs[:, 1]]]
    return np.unique(crossing[members[crossing]])


def _rotation_to_z(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that turns a unit vector near +Z onto it."""
    x, y, z = direction
    w = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + w + w @ w / (1 + z)
