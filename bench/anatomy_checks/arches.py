"""Where dental arches stand against where identity and expression put them: the priors of `anatomy.own_parts`.

People of the first model's population, neutral and with an open mouth, are fitted by least squares to their true skin.
The corrections that the arches then need are the spread of the placements, rms over the people, largest axis.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from bench.anatomy_checks import Figure
from coregister.first_model import assembly, build, makehuman
from coregister.first_model.population import mean_person
from coregister.synthetic import expressions
from coregister.synthetic.subject import sample_subject
from registration.anatomy.tooth_structure import find_teeth
from registration.frames import MM_PER_M, matrix_to_axis_angle
from registration.geometry.rigid import align, similarity_transform
from registration.model import gnm_npz, regions
from registration.model.gnm_npz import GNMData

_PEOPLE = range(100, 109)
_EXPRESSIONS = ("smile", "jaw_open", "stretch")
_SIGMA_M = 3e-3  # of a vertex: so that coefficients are about as large as in registrations
_ROUNDS = 6  # of fit and alignment


def figures(data: GNMData) -> Iterator[Figure]:
    """Fit the people, if this is the first model's topology."""
    first = gnm_npz.read(build.bootstrap())
    if gnm_npz.topology_hash(first.triangles) != gnm_npz.topology_hash(data.triangles):
        return
    heads, fit = assembly.build_assembly(makehuman.read(makehuman.fetch()), mean_person()), _SkinFit.of(first)
    neutrals: list[_Needed] = []
    moved: dict[str, list[np.ndarray]] = {name: [] for name in _EXPRESSIONS}
    for seed in _PEOPLE:
        person = sample_subject(seed)
        truth, joints = heads.assemble(person, {target: heads.source.target(target) for target in person.weights})
        identity, neutral, size = fit.neutral(truth)
        sized = size * truth
        neutrals.append(fit.needed(identity, neutral, sized))
        for name in _EXPRESSIONS:
            performed = expressions.expression_by_name(name)
            posed = size * expressions.apply_expression(heads, performed, truth, joints)
            found = fit.needed(identity, fit.expression(identity, neutral, sized, posed), posed)
            moved[name].append(found.lower - neutrals[-1].lower)
    yield from _of("upper arch against the identity", [needed.upper for needed in neutrals], most=2.0)
    yield from _of("lower against upper, neutral as fitted", [needed.lower for needed in neutrals])
    yield from _of("the same, neutral by its identity alone", [needed.lower_at_rest for needed in neutrals], most=0.3)
    for name, differences in moved.items():
        yield from _of(f"lower against upper, {name} from the neutral", differences)


def _of(name: str, motions: list[Float[np.ndarray, "6"]], most: float | None = None) -> Iterator[Figure]:
    rms = np.sqrt(np.square(motions).mean(0))
    yield Figure(name=f"{name}: shift", value=MM_PER_M * rms[:3].max(), unit="mm", most=most)
    yield Figure(name=f"{name}: rotation", value=float(np.degrees(rms[3:].max())), unit="deg")


@dataclass(frozen=True, kw_only=True)
class _Needed:
    """Corrections of a fitted head, shift (m) and rotation vector (radians), about the centre of an arch."""

    upper: Float[np.ndarray, "6"]
    lower: Float[np.ndarray, "6"]  # against the corrected upper arch
    lower_at_rest: Float[np.ndarray, "6"]  # the same without the expression


@dataclass(frozen=True, kw_only=True, eq=False)
class _SkinFit:
    """Ridge regression of skin on a model's components of unit variance."""

    data: GNMData
    skin: Int[np.ndarray, "K"]  # every third vertex
    upper: Int[np.ndarray, "U"]  # crowns
    lower: Int[np.ndarray, "L"]

    @classmethod
    def of(cls, data: GNMData) -> "_SkinFit":
        arches = find_teeth(data)
        upper, lower = (np.concatenate([tooth.vertices[tooth.crown] for tooth in arch.teeth]) for arch in arches)
        return cls(data=data, skin=np.flatnonzero(regions.head_skin(data))[::3], upper=upper, lower=lower)

    def neutral(self, truth: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "I"], Float[np.ndarray, "E"], float]:
        """Fit identity, expression and size together, as the registration of a neutral does."""
        count = len(self.data.vertex_identity_basis)
        basis = np.concatenate([self.data.vertex_identity_basis, self.data.expression_basis])[:, self.skin]
        template = self.data.template_vertex_positions[self.skin].astype(np.float64)
        found, size = self._fit(basis, template, _moved(truth[self.skin], template), free_size=True)
        return found[:count], found[count:], size

    def expression(
        self,
        identity: Float[np.ndarray, "I"],
        neutral: Float[np.ndarray, "E"],
        truth: Float[np.ndarray, "V 3"],
        posed: Float[np.ndarray, "V 3"],
    ) -> Float[np.ndarray, "E"]:
        """Fit an expression to the posed head; identity and the rest of the neutral's skin are known."""
        fitted = self._vertices(identity, neutral, self.skin)
        aligned = _moved(truth[self.skin], fitted)
        start = self._vertices(identity, np.zeros_like(neutral), self.skin) + aligned - fitted
        T = align(truth[None, self.skin], fitted, np.ones((1, len(fitted))))[0]  # the head does not move between them
        return self._fit(self.data.expression_basis[:, self.skin], start, posed[self.skin] @ T[:3, :3].T + T[:3, 3])[0]

    def needed(
        self, identity: Float[np.ndarray, "I"], expression: Float[np.ndarray, "E"], truth: Float[np.ndarray, "V 3"]
    ) -> _Needed:
        """Compare the arches of a fit with the true ones."""
        true = _moved(truth, self._vertices(identity, expression, self.skin), self.skin)
        upper = self._vertices(identity, expression, self.upper)
        T = align(upper[None], true[self.upper], np.ones((1, len(upper))))[0]
        lower, rest = (self._vertices(identity, values, self.lower) for values in (expression, 0 * expression))
        against, at_rest = (_motion(p @ T[:3, :3].T + T[:3, 3], true[self.lower]) for p in (lower, rest))
        return _Needed(upper=_motion(upper, true[self.upper]), lower=against, lower_at_rest=at_rest)

    def _vertices(
        self, identity: Float[np.ndarray, "I"], expression: Float[np.ndarray, "E"], rows: Int[np.ndarray, "R"]
    ) -> Float[np.ndarray, "R 3"]:
        shape = np.tensordot(identity, self.data.vertex_identity_basis[:, rows].astype(np.float64), 1)
        shape += np.tensordot(expression, self.data.expression_basis[:, rows].astype(np.float64), 1)
        return self.data.template_vertex_positions[rows] + shape

    def _fit(
        self,
        basis: Float[np.ndarray, "C K 3"],
        start: Float[np.ndarray, "K 3"],
        target: Float[np.ndarray, "K 3"],
        *,
        free_size: bool = False,
    ) -> tuple[Float[np.ndarray, "C"], float]:
        """Coefficients, and the factor of the target's size, 1 unless it is free; the target is nearly aligned."""
        rows = basis.reshape(len(basis), -1).astype(np.float64) / _SIGMA_M
        information, found, size = rows @ rows.T + np.eye(len(rows)), np.zeros(len(rows)), 1.0
        aligned = target
        for _ in range(_ROUNDS):
            found = np.linalg.solve(information, rows @ (aligned - start).ravel() / _SIGMA_M)
            fitted = start + _SIGMA_M * (found @ rows).reshape(-1, 3)
            size, R, t = similarity_transform(target, fitted, free_scale=free_size)
            aligned = size * target @ R.T + t
        return found, size


def _moved(
    points: Float[np.ndarray, "P 3"], target: Float[np.ndarray, "K 3"], rows: Int[np.ndarray, "K"] | None = None
) -> Float[np.ndarray, "P 3"]:
    """Points after the rigid motion that takes them, or some of their rows, nearest to the target."""
    source = (points if rows is None else points[rows]).astype(np.float64)
    T = align(source[None], target, np.ones((1, len(target))))[0]
    return points @ T[:3, :3].T + T[:3, 3]


def _motion(source: Float[np.ndarray, "P 3"], target: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "6"]:
    T = align(source[None], target, np.ones((1, len(target))))[0]
    centre = source.mean(0)
    shift = T[:3, :3] @ centre + T[:3, 3] - centre
    return np.concatenate([shift, matrix_to_axis_angle(T[:3, :3])])
