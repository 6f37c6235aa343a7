"""Identity basis: centred principal components of aligned neutral heads [GNM, Head Identity].

See docs/algorithms.md, "Covariance shrinkage"."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from coregister.next_model import eyelids
from coregister.next_model.shrinkage import Mixed
from coregister.next_model.shrinkage_weight import SHARES, left_out_rms
from coregister.region_masks import FLIP, mirrored
from registration.geometry import pca
from registration.geometry.rigid import fit_twists, motion_fields
from registration.geometry.topology import vertex_areas
from registration.model import regions
from registration.model.gnm_npz import GNMData
from registration.stabilize.subject_meshes import SkullSkin

_SHARE = 0.2  # of the previous model's
_LEAST_TO_SHARE = 3  # heads, among which other shares can be compared
_TYPICAL = 20  # components that it is compared with
_FOLLOWS = 1e-3  # weight of teeth and tongue: neutral faces mostly hide them, so they come along and decide nothing


@dataclass(frozen=True, kw_only=True)
class Identity:
    """What the head's identity basis is made of."""

    share: float = 0.99  # of the variance, kept
    most: int | None = None  # components
    previous: float | None = _SHARE  # of the variance, from the previous model, the heads have the rest; None: what
    # serves heads that are left out best, with `most` components or 20 (`coregister.next_model.shrinkage_weight`)
    by_area: bool = False  # vertices count by their area instead of alike
    mirrored: bool = True  # every head counts half, its mirror image the other half
    lids_rest: bool = True  # lids stay on the eyeballs to first order (`lids.rested`)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeadIdentity:
    """The template and K components; metres, the model's frame."""

    template: Float[np.ndarray, "V 3"]
    basis: Float[np.ndarray, "K V 3"]
    variance: Float[np.ndarray, "K"]  # of the skin, m^2 summed over its coordinates, before lids were settled
    share: float  # of the variance, kept
    previous: float  # share of the variance that is the previous model's
    tried: Mapping[float, float]  # shares that were compared -> rms distance of heads left out, metres, per vertex
    heads: int  # that came in, N
    mirrored: bool  # each has its mirror image beside it
    method: str  # of the principal components


def head_identity(
    heads: Float[np.ndarray, "N V 3"], data: GNMData, settings: Identity | None = None, memory_gb: float = 4.0
) -> HeadIdentity:
    """The basis of aligned neutrals (`align.align_neutrals`): of skin, teeth and tongue; eyeballs are filled back.

    The covariance is (1 - p) C + p (tr C / tr P) P: C of the heads about their mean, with N - 1; P = B'B of the
    previous model's components of the head, rigid motions taken out as alignment takes them out of heads (`Mixed`).
    p is `settings.previous`, or chosen; the variance in all is the heads'.

    `settings.mirrored`: people are as often asymmetric one way as the other, so the mean is symmetric, and C and P are
    those of heads and components and of their mirror images, half each. That is what their symmetric and their
    antisymmetric parts have between them: the former about their mean, with N - 1, the latter about zero, which is
    known, with N. Every component is symmetric or antisymmetric.

    The template is the heads' mean alone; eyeballs are placed to fit its lids. Teeth and tongue are the registrations'
    as the skin is, of next to no weight; only of a first model would they follow the lips [GNM, Initial Placement
    of Teeth and Tongue].
    """
    settings = settings or Identity()
    left, right = regions.eyeballs(data)
    rows = np.flatnonzero(~(left | right))
    mirror = data.mirror_indices[rows] if settings.mirrored else None
    root = _root(data, settings)[rows]
    whole = heads.mean(0, dtype=np.float64)
    mean = whole[rows] if mirror is None else (whole[rows] + whole[mirror] * FLIP) / 2
    previous = _previous(data, rows, settings.mirrored)
    previous = (previous * root).reshape(len(previous), 3 * len(rows))
    deviations = _Deviations(heads, rows, mirror, mean, root)
    share, tried = _share(deviations, len(heads), previous, settings, int(regions.skin(data).sum()))
    stream = Mixed(
        deviations,
        np.ones(len(heads)) if mirror is None else np.repeat((1, 1 - 1 / len(heads)), len(heads)),
        len(heads) - 1,
        previous,
        share,
    )
    found = pca.principal_components(
        stream, centred=False, share=settings.share, most=settings.most, memory_gb=memory_gb
    )
    basis = np.zeros((len(found.variance), *data.template_vertex_positions.shape))
    basis[:, rows] = found.components.reshape(len(basis), len(rows), 3) / root
    template = data.template_vertex_positions.astype(np.float64)
    template[rows] = mean
    template, basis = _filled(template, basis, data, settings.lids_rest)
    if settings.mirrored:
        template, basis = _settled(template, basis, data)
    return HeadIdentity(
        template=template,
        basis=basis,
        variance=found.variance,
        share=found.share,
        previous=stream.share,
        tried=tried,
        heads=len(heads),
        mirrored=settings.mirrored,
        method=found.method,
    )


def carried(data: GNMData) -> Int[np.ndarray, "_"]:
    """Identity components of the previous model in which no skin moves: eyes' and teeth's own shapes."""
    return np.flatnonzero(~_moves_skin(data))


def _moves_skin(data: GNMData) -> np.ndarray:
    return np.abs(data.vertex_identity_basis[:, regions.skin(data)]).max(axis=(1, 2), initial=0) > 0


def _root(data: GNMData, settings: Identity) -> Float[np.ndarray, "V 1"]:
    """What displacements are multiplied by before they are compared."""
    skin = regions.skin(data)
    area = vertex_areas(data.template_vertex_positions, data.triangles) if settings.by_area else np.ones(len(skin))
    if settings.mirrored:
        area = (area + area[data.mirror_indices]) / 2
    mean = area[skin].mean()
    return (np.sqrt(np.maximum(area, 0.01 * mean) / mean) * np.where(skin, 1, _FOLLOWS))[:, None]


def _previous(data: GNMData, rows: Int[np.ndarray, "R"], both: bool) -> Float[np.ndarray, "K R 3"]:
    """The previous model's components of the head in these rows, each without the rigid motion of the stable skin;
    with `both` their symmetric and antisymmetric parts."""
    basis = data.vertex_identity_basis[_moves_skin(data)].astype(np.float64)
    stable = SkullSkin.of(data).area
    points = data.template_vertex_positions.astype(np.float64)
    points = points - stable @ points / stable.sum()
    basis -= np.tensordot(fit_twists(basis, points, stable), motion_fields(points), 1)
    if not both:
        return basis[:, rows]
    twins = mirrored(basis, data.mirror_indices)
    return np.concatenate([basis + twins, basis - twins])[:, rows] / 2


class _Deviations:
    """Of every head from the mean, in `rows`; with `mirror`, all symmetric parts and then all antisymmetric ones."""

    def __init__(
        self,
        heads: Float[np.ndarray, "N V 3"],
        rows: Int[np.ndarray, "R"],
        mirror: Int[np.ndarray, "R"] | None,
        mean: Float[np.ndarray, "R 3"],
        root: Float[np.ndarray, "R 1"],
    ):
        self._heads, self._rows, self._mirror, self._mean, self._root = heads, rows, mirror, mean, root

    def __iter__(self) -> Iterator[Float[np.ndarray, "D"]]:
        for sign in (0,) if self._mirror is None else (1, -1):
            for head in self._heads:
                yield ((self._part(head, sign) - (self._mean if sign >= 0 else 0)) * self._root).ravel()

    def _part(self, head: Float[np.ndarray, "V 3"], sign: int) -> Float[np.ndarray, "R 3"]:
        own = head[self._rows].astype(np.float64)
        return own if self._mirror is None else (own + sign * head[self._mirror] * FLIP) / 2


def _share(
    deviations: "_Deviations", heads: int, previous: Float[np.ndarray, "K D"], settings: Identity, skin: int
) -> tuple[float, dict[float, float]]:
    """The previous model's share, and the shares that were compared for it. Samples are held in memory, in float32."""
    if settings.previous is not None:
        return settings.previous, {}
    if heads < _LEAST_TO_SHARE or not previous.any():
        return _SHARE, {}
    rows = np.concatenate([np.stack([d.astype(np.float32) for d in deviations]), previous.astype(np.float32)])
    gram = np.zeros((len(rows), len(rows)))
    for first in range(0, rows.shape[1], 4096):
        part = rows[:, first : first + 4096].astype(np.float64)
        gram += part @ part.T
    members = np.split(np.arange(2 * heads if settings.mirrored else heads), 2 if settings.mirrored else 1)
    rms = left_out_rms(gram, members, (True, False)[: len(members)], settings.most or _TYPICAL)
    rms /= np.sqrt(skin)
    return SHARES[int(rms.argmin())], dict(zip(SHARES, rms.tolist(), strict=True))


def _settled(
    template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"], data: GNMData
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "K V 3"]]:
    """Without the traces that an iteration leaves, or a previous template whose eyes and teeth are not symmetric."""
    mirror = data.mirror_indices
    twins = mirrored(basis, mirror)
    sign = np.where((basis * twins).sum((1, 2)) < 0, -1, 1)[:, None, None]
    return (template + template[mirror] * FLIP) / 2, (basis + sign * twins) / 2


def _filled(
    template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"], data: GNMData, lids_rest: bool
) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "K V 3"]]:
    """Eyeballs between the lids."""
    for socket in eyelids.sockets(data):
        template[socket.ball] += eyelids.placed(socket, template)
    both = eyelids.sockets(replace(data, template_vertex_positions=template))
    shifts = np.stack([eyelids.following(socket, template, basis) for socket in both], 1)
    if lids_rest:
        basis = eyelids.rested(both, data, template, basis, shifts)
    for side, socket in enumerate(both):
        basis[:, socket.ball] = shifts[:, None, side]
    return template, basis
