"""The procedural eyeball against the dimensions of the two-sphere model."""

import numpy as np
import pytest

from coregister.anatomy import eye_sections
from coregister.first_model import eyes
from coregister.first_model.part import MeshPart
from registration.errors import InputError
from registration.geometry.closest_point import closest_points


@pytest.fixture(scope="module")
def eye() -> MeshPart:
    return eyes.eyeball()


def triangles(quads: np.ndarray) -> np.ndarray:
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def test_both_shells_are_closed_and_face_outwards(eye: MeshPart) -> None:
    quads = eye.quads
    directed = np.stack([quads, np.roll(quads, -1, 1)], -1).reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert {tuple(e) for e in directed} == {tuple(e[::-1]) for e in directed}
    assert (np.unique(quads) == np.arange(len(eye.vertices))).all()
    for name, radius in (("eye_exteriors", 14.6e-3), ("eye_interiors", 14.45e-3)):
        shell = quads[eye.groups[name][quads].all(1)]
        assert len(np.unique(shell)) - 2 * len(shell) + len(shell) == 2  # Euler: one sphere
        a, b, c = (eye.vertices[triangles(shell)[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
        assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.07)
        normals, centres = np.cross(b - a, c - a), (a + b + c) / 3
        assert (np.einsum("ij,ij->i", normals, centres) > 0).all()
        assert (np.linalg.norm(normals, axis=1) > 1e-8).all()  # m^2, no degenerate half of a quad
    assert len(eye.vertices) <= 620


def test_dimensions_of_the_mean_eye(eye: MeshPart) -> None:
    exterior = eye.vertices[eye.groups["eye_exteriors"]]
    radius = np.linalg.norm(exterior, axis=1)
    assert exterior[:, 2].max() == pytest.approx(15.789e-3, abs=1e-6)  # z_c + r_c
    behind = exterior[:, 2] < 13.310e-3 - 0.5e-3  # z_l, less half the blend
    assert radius[behind] == pytest.approx(eye_sections.SCLERA_RADIUS, abs=1e-12)
    before = exterior[:, 2] > 13.310e-3 + 0.5e-3
    assert np.linalg.norm(exterior[before] - [0, 0, 7.289e-3], axis=1) == pytest.approx(8.5e-3, abs=1e-6)
    ring = np.isclose(np.arctan2(np.hypot(*exterior.T[:2]), exterior[:, 2]), np.arcsin(6 / 14.6), atol=1e-9)
    assert ring.sum() == eyes.SEGMENTS
    assert np.hypot(*exterior[ring].T[:2]) == pytest.approx(6e-3, abs=0.03e-3)  # rounded off by the blend


@pytest.mark.parametrize("limbus, cornea", [(6.0e-3, 8.5e-3), (7.2e-3, 7.4e-3), (4.7e-3, 10.7e-3)])
def test_the_blend_is_continuous_in_value_and_slope(limbus: float, cornea: float) -> None:
    angle = np.linspace(0, np.pi / 2, 200_001)
    step = angle[1]
    radius = eye_sections.radius_at(angle, np.array(limbus), np.array(cornea))
    slope = np.diff(radius) / step
    half = eye_sections.BLEND_LENGTH / eye_sections.SCLERA_RADIUS / 2
    edge = np.arcsin(limbus / eye_sections.SCLERA_RADIUS)
    steepest = np.abs(slope).max()
    # Over the blend the slope changes by `steepest`: one grid step may cause only a few times its fraction of that.
    assert np.abs(np.diff(slope)).max() < 10 * steepest * step / (2 * half)
    assert (radius[angle > edge + half] == eye_sections.SCLERA_RADIUS).all()
    assert (np.diff(radius) < 1e-15).all()


@pytest.mark.parametrize("limbus, cornea", [(6.0e-3, 8.5e-3), (7.3e-3, 7.4e-3), (4.7e-3, 10.7e-3), (7.3e-3, 10.7e-3)])
def test_the_interior_lies_inside_the_exterior(limbus: float, cornea: float) -> None:
    eye = eyes.eyeball(limbus, cornea)
    inner, outer = (triangles(eye.quads[eye.groups[g][eye.quads].all(1)]) for g in ("eye_interiors", "eye_exteriors"))
    barycentrics = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6
    points = np.einsum("sk,fkc->fsc", barycentrics, eye.vertices[inner]).reshape(-1, 3)
    distance, face, weights = closest_points(points, eye.vertices, outer)
    a, b, c = (eye.vertices[outer[face]][:, k] for k in range(3))
    depth = np.einsum(
        "ij,ij->i", np.einsum("pk,pkc->pc", weights, eye.vertices[outer[face]]) - points, np.cross(b - a, c - a)
    )
    assert (depth > 0).all()
    assert distance.min() > 0.1e-3


def test_groups_and_rings(eye: MeshPart) -> None:
    groups = eye.groups
    assert set(groups) == {"eye_exteriors", "eye_interiors", "scleras", "irises", "pupils"}
    parts = [groups[name].astype(int) for name in ("eye_exteriors", "scleras", "irises")]
    assert (sum(parts) == 1).all()
    assert (groups["pupils"] <= groups["irises"]).all()
    assert (groups["eye_interiors"] == ~groups["eye_exteriors"]).all()
    radius = np.hypot(*eye.vertices.T[:2])
    iris = radius[groups["irises"]].max()
    assert iris == pytest.approx(6e-3, rel=0.011)
    assert np.isclose(radius[groups["pupils"]], iris / 2, rtol=1e-12).sum() == eyes.SEGMENTS
    assert radius[groups["pupils"]].max() == pytest.approx(iris / 2, rel=1e-12)
    assert np.ptp(eye.vertices[groups["irises"]][:, 2]) < 1e-15  # flat


def test_the_mirror_is_exact(eye: MeshPart) -> None:
    mirror = eye.mirror
    assert (mirror[mirror] == np.arange(len(mirror))).all()
    assert (eye.vertices[mirror] == eye.vertices * [-1, 1, 1]).all()
    mirrored = mirror[eye.quads][:, ::-1]
    assert {frozenset(q) for q in mirrored.tolist()} == {frozenset(q) for q in eye.quads.tolist()}
    edges = {tuple(e) for q in eye.quads for e in zip(q, np.roll(q, -1), strict=True)}
    assert all(tuple(e) in edges for q in mirrored for e in zip(q, np.roll(q, -1), strict=True))
    assert all((member[mirror] == member).all() for member in eye.groups.values())


def test_uv_charts_do_not_overlap(eye: MeshPart) -> None:
    uvs = eye.quad_uvs
    assert uvs.min() >= 0 and uvs.max() <= 1
    outside = eye.groups["eye_exteriors"][eye.quads].all(1)
    assert uvs[outside][..., 0].max() < 0.5 < uvs[~outside][..., 0].min()
    assert coverage(uvs).max() == 1
    iris = eye.groups["irises"][eye.quads].all(1)
    offset = uvs[iris] - [0.75, 0.75]
    scale = np.linalg.norm(offset, axis=-1) / np.linalg.norm(eye.vertices[eye.quads[iris]][..., :2], axis=-1).clip(1e-9)
    assert np.ptp(scale[scale > 0]) < 1e-9 * scale.max()  # the iris is round and to scale


def cross_2d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def coverage(uvs: np.ndarray, size: int = 512) -> np.ndarray:
    """How many triangles cover each pixel centre of the unit square; every triangle must be counter-clockwise."""
    counts = np.zeros((size, size), int)
    for a, b, c in np.concatenate([uvs[:, [0, 1, 2]], uvs[:, [0, 2, 3]]]) * size:
        area = cross_2d(b - a, c - a)
        assert area > 1e-3  # pixels
        low, high = np.floor(np.min([a, b, c], 0)).astype(int), np.ceil(np.max([a, b, c], 0)).astype(int)
        points = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), -1) + 0.5
        inside = np.all([cross_2d(q - p, points - p) > 1e-6 for p, q in ((a, b), (b, c), (c, a))], 0)
        counts[low[1] : high[1], low[0] : high[0]] += inside
    assert counts.sum() > 0.1 * size**2
    return counts


def test_the_pupil_spans_from_a_point_to_the_limbus(eye: MeshPart) -> None:
    basis = eyes.pupil_basis(eye)
    pupil = eye.groups["pupils"]
    iris = eye.groups["irises"] & ~pupil  # the visible ring
    assert (basis[~(pupil | iris)] == 0).all()
    rest = np.hypot(*eye.vertices.T[:2])
    limbus = rest[iris].max()
    edge = pupil & np.isclose(rest, limbus / 2)
    for coefficient in (-3, -1.5, 0, 1, 3):
        vertices = eye.vertices + coefficient * basis
        radius = np.hypot(*vertices.T[:2])
        assert radius[edge] == pytest.approx(limbus * (0.5 + coefficient / 6), abs=1e-15)
        assert (vertices[:, 2] == eye.vertices[:, 2]).all()
        fraction = (limbus - radius[iris]) / (limbus - rest[iris]).clip(1e-15)
        assert fraction[rest[iris] < limbus - 1e-9] == pytest.approx(1 - coefficient / 3, abs=1e-9)
    assert np.hypot(*(eye.vertices - 3 * basis)[pupil].T[:2]).max() < 1e-15
    assert np.hypot(*(eye.vertices + 3 * basis)[iris].T[:2]) == pytest.approx(limbus, abs=1e-15)


def test_three_components_reproduce_sampled_eyes(eye: MeshPart) -> None:
    basis = eyes.variation().reshape(3, -1)
    limbus, cornea, _ = eye_sections.sample_radii(400, np.random.default_rng(7))
    sampled = [eyes.eyeball(*pair).vertices for pair in zip(limbus, cornea, strict=True)]
    displacements = (np.stack(sampled) - eye.vertices).reshape(len(sampled), -1)
    coefficients = displacements @ np.linalg.pinv(basis)
    residual = np.linalg.norm((displacements - coefficients @ basis).reshape(len(sampled), -1, 3), axis=2)
    assert np.sqrt((np.linalg.norm(displacements.reshape(len(sampled), -1, 3), axis=2) ** 2).mean()) > 0.2e-3
    assert np.sqrt((residual**2).mean()) < 3e-6
    assert np.quantile(residual.max(1), 0.99) < 60e-6
    assert coefficients[:, :2].std(0) == pytest.approx([1, 1], abs=0.12)  # two radii: two free components
    assert np.abs(np.corrcoef(coefficients[:, 0], coefficients[:, 1])[0, 1]) < 0.15


def test_variation_is_deterministic_and_preserves_the_sclera(eye: MeshPart) -> None:
    basis = eyes.variation(seed=3)
    assert (basis == eyes.variation(seed=3)).all()
    assert not (basis == eyes.variation(seed=4)).all()
    assert basis.shape == (3, len(eye.vertices), 3)
    angle = np.arctan2(np.hypot(*eye.vertices.T[:2]), eye.vertices[:, 2])
    assert np.abs(basis[:, angle > np.radians(65)]).max() < 1e-12
    assert (basis[:, eye.mirror] == basis * [-1, 1, 1]).all()
    # Between limbus and lids the sclera's vertices slide: along a tangent, at three deviations 1.2 mm, so up to
    # 1.2^2 / (2 * 14.6) mm off the sphere.
    for sign in (-3, 3):
        vertices = eye.vertices + sign * basis[0]
        on_sclera = eye.groups["eye_exteriors"] & (angle > np.radians(32))
        assert np.linalg.norm(vertices[on_sclera], axis=1) == pytest.approx(eye_sections.SCLERA_RADIUS, abs=0.055e-3)


@pytest.mark.parametrize("limbus, cornea", [(8.5e-3, 8.5e-3), (0.0, 8.5e-3), (13.5e-3, 14e-3), (6.0, 8.5)])
def test_impossible_radii_are_refused(limbus: float, cornea: float) -> None:
    with pytest.raises(InputError, match="do not form an eyeball"):
        eyes.eyeball(limbus, cornea)
