"""The tongue of a model, found from its mesh: attachment, tip, curved centre line, and coordinates of every vertex.

Nothing is assumed of the grid: a tongue may be closed, or end in an open rim by which it is attached to the floor of
the mouth. docs/anatomy.md, "Tongue".
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import spsolve

from registration.errors import InputError
from registration.frames import MM_PER_M
from registration.geometry.topology import boundary_vertices, connected_parts, edges, vertex_normals
from registration.model import regions
from registration.model.gnm_npz import GNMData

_REAR = 0.1  # of the length: where a tongue without a rim is attached
_FREE = 0.4  # of the largest distance from the attachment along the surface: beyond it a tongue is free
_ASIDE = 0.5  # a point this much nearer the median plane counts as 1 more to the front: the tip is no corner
_SMOOTHING = 4.0  # of the share along the tongue, in units of the graph's Laplacian
_LEVELS = 41  # cross-sections from which the centre line is fitted
_DEGREE = 4  # of the centre line
_STATIONS = 201  # of the stored centre line
# A tongue with a tip, as fractions of its length or largest width; the models in use have 0.00 to 0.02, 0.00 and 0.5.
_MAX_BEHIND, _MAX_ASIDE, _MAX_BLUNT = 0.1, 0.15, 0.85
_FRONT = 0.05  # of the length, where the front's width is measured
_MAX_TURN_DEG = 60.0
_MIN_LENGTH = 15e-3  # metres


@dataclass(frozen=True, kw_only=True, eq=False)
class TongueStructure:
    """The tongue of a template: N vertices, F triangles, S stations of the centre line. Metres, the model's frame.

    A vertex with the share s belongs to the cross-section of the centre line at s, in whose frame it lies at `lateral`
    (positive to the subject's left), `height` (positive towards the palate) and `ahead` (positive towards the tip).
    """

    vertices: Int[np.ndarray, "N"]  # indices into the model's vertices, ascending
    triangles: Int[np.ndarray, "F 3"]  # indices into `vertices`
    rest: Float[np.ndarray, "N 3"]
    mirror: Int[np.ndarray, "N"]  # each vertex' mirror image
    attached: Bool[np.ndarray, "N"]  # the rim, or the rear end of a closed tongue
    open_rim: bool
    tip: int  # index into `vertices`
    share: Float[np.ndarray, "N"]  # from 0 where the tongue is attached to 1 at the tip
    stations: Float[np.ndarray, "S"]  # shares, 0 to 1
    centre: Float[np.ndarray, "S 3"]  # of the cross-sections, in the median plane
    tangent: Float[np.ndarray, "S 3"]  # unit, towards the tip
    up: Float[np.ndarray, "S 3"]  # unit, normal to the tangent, in the median plane

    @cached_property
    def length(self) -> float:
        """Arc length of the centre line."""
        return float(self.arc_at(np.ones(1))[0])

    @cached_property
    def axis(self) -> Float[np.ndarray, "3"]:
        """The direction of the free half, unit, in the median plane, towards the tip."""
        chord = self.centre[-1] - self.centre[len(self.stations) // 2]
        return np.asarray(chord / np.linalg.norm(chord))

    @cached_property
    def arc(self) -> Float[np.ndarray, "N"]:
        """Arc length of the centre line from the attachment to each vertex' cross-section."""
        return self.arc_at(self.share)

    @cached_property
    def local(self) -> Float[np.ndarray, "N 3"]:
        """Lateral offset, height and distance ahead of each vertex in the frame of its cross-section."""
        offset = self.rest - interpolate(self.stations, self.centre, self.share)
        up = interpolate(self.stations, self.up, self.share)
        tangent = interpolate(self.stations, self.tangent, self.share)
        return np.stack([offset[:, 0], (offset * up).sum(1), (offset * tangent).sum(1)], 1)

    @property
    def lateral(self) -> Float[np.ndarray, "N"]:
        return self.local[:, 0]

    @property
    def height(self) -> Float[np.ndarray, "N"]:
        return self.local[:, 1]

    @cached_property
    def dorsum(self) -> Bool[np.ndarray, "N"]:
        """The upper surface: vertices whose normal points up in their cross-section; the rest is the underside."""
        normals = vertex_normals(torch.as_tensor(self.rest), torch.as_tensor(self.triangles)).numpy()
        return (normals * interpolate(self.stations, self.up, self.share)).sum(1) > 0

    @cached_property
    def half_width(self) -> float:
        """Half the largest width."""
        return float(np.abs(self.lateral).max())

    @cached_property
    def half_height(self) -> float:
        """Half the largest thickness of the free part."""
        free = self.height[self.share > 0.5]
        return float(np.ptp(free) / 2)

    def arc_at(self, share: Float[np.ndarray, "M"]) -> Float[np.ndarray, "M"]:
        """Return the arc length of the centre line at some shares."""
        steps = np.linalg.norm(np.diff(self.centre, axis=0), axis=1)
        return np.interp(share, self.stations, np.r_[0.0, np.cumsum(steps)])

    def section(self, share: float, points: Float[np.ndarray, "N 3"] | None = None) -> Float[np.ndarray, "M 2 3"]:
        """Return the segments in which the cross-section at a share cuts the surface, at rest or of other points."""
        return level_segments(self.rest if points is None else points, self.triangles, self.share, share)


def find_tongue(data: GNMData) -> TongueStructure:
    """Find the tongue's attachment, tip, centre line and cross-sections from the mesh of a model's template.

    The share along the tongue is d / (d + e), with the distances along the surface d from the attachment and e from the
    tip, the foremost point of the free part; its level sets are the cross-sections.

    Args:
        data: a model with the official components.

    Raises:
        InputError: the model has no tongue, or it is in several pieces or has no tip: the foremost point of the free
            part lies far behind the foremost of all or to a side, or the front is as wide as the body. The message has
            the figure.
    """
    vertices = np.flatnonzero(regions.tongue(data))
    if not len(vertices):
        raise _no_tongue("vertices in the group 'tongue'", "none")
    chosen = data.triangles[regions.tongue(data)[data.triangles].all(1)]
    triangles = np.searchsorted(vertices, chosen).astype(np.int64)
    rest = data.template_vertex_positions[vertices].astype(np.float64)
    if not len(triangles) or np.unique(triangles).size < len(vertices):
        raise _no_tongue("triangles at every vertex", f"{len(triangles)} triangles at {len(vertices)} vertices")
    if (pieces := len(np.unique(connected_parts(triangles)))) > 1:
        raise _no_tongue("one piece", f"{pieces} pieces")
    mirror = np.searchsorted(vertices, data.mirror_indices[vertices])
    if not np.isin(data.mirror_indices[vertices], vertices).all():
        raise _no_tongue("mirror images of its vertices in the tongue", "some elsewhere")
    rim = boundary_vertices(triangles, len(vertices))
    length = float(np.ptp(rest[:, 2]))
    attached = rim if rim.any() else rest[:, 2] < rest[:, 2].min() + _REAR * length
    graph = _surface_graph(rest, triangles)
    from_root = _distance(graph, attached)
    free = np.flatnonzero(from_root > _FREE * from_root.max())
    tip = int(free[(rest[free, 2] - _ASIDE * np.abs(rest[free, 0])).argmax()])
    _check_tip(rest, tip, attached, length)
    near_tip = np.zeros(len(rest), bool)
    near_tip[[tip, mirror[tip]]] = True
    from_tip = _distance(graph, near_tip)
    share = _smoothed(from_root / (from_root + from_tip), attached, near_tip, triangles)
    share = (share + share[mirror]) / 2
    stations, centre, tangent, up = _centre_line(rest, triangles, share, attached, tip)
    structure = TongueStructure(
        vertices=vertices,
        triangles=triangles,
        rest=rest,
        mirror=mirror,
        attached=attached,
        open_rim=bool(rim.any()),
        tip=tip,
        share=share,
        stations=stations,
        centre=centre,
        tangent=tangent,
        up=up,
    )
    _check_shape(structure)
    return structure


def level_segments(
    points: Float[np.ndarray, "N 3"], triangles: Int[np.ndarray, "F 3"], values: Float[np.ndarray, "N"], level: float
) -> Float[np.ndarray, "M 2 3"]:
    """Return the segments in which the level set of values that are linear on triangles cuts them."""
    corner = values[triangles]
    above = corner > level
    odd = np.where(above.sum(1) == 1, above.argmax(1), (~above).argmax(1))  # the corner alone on its side
    cut = np.flatnonzero(above.any(1) & ~above.all(1))
    alone = triangles[cut, odd[cut]]
    ends = []
    for step in (1, 2):
        other = triangles[cut, (odd[cut] + step) % 3]
        t = (level - values[alone]) / (values[other] - values[alone])
        ends.append(points[alone] + t[:, None] * (points[other] - points[alone]))
    return np.stack(ends, 1)


def interpolate(
    stations: Float[np.ndarray, "S"], values: Float[np.ndarray, "S 3"], share: Float[np.ndarray, "M"]
) -> Float[np.ndarray, "M 3"]:
    """Return vectors along the centre line at some shares, linear between stations."""
    return np.stack([np.interp(share, stations, values[:, k]) for k in range(3)], 1)


def _surface_graph(points: Float[np.ndarray, "N 3"], triangles: Int[np.ndarray, "F 3"]) -> sp.csr_matrix:
    """Edges, and the straight ways across each edge between the two corners opposite it, which straighten paths."""
    connectivity = edges(triangles)
    pairs = connectivity.vertices
    inner = np.flatnonzero((connectivity.faces >= 0).all(1))
    a, b = points[pairs[inner, 0]], points[pairs[inner, 1]]
    opposite = [triangles[connectivity.faces[inner, side]].sum(1) - pairs[inner].sum(1) for side in (0, 1)]
    axis = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    along, across = [], []
    for corner in opposite:
        offset = points[corner] - a
        along.append((offset * axis).sum(1))
        across.append(np.linalg.norm(offset - along[-1][:, None] * axis, axis=1))
    unfolded = np.hypot(along[0] - along[1], across[0] + across[1])
    rows = np.r_[pairs[:, 0], opposite[0]]
    columns = np.r_[pairs[:, 1], opposite[1]]
    lengths = np.r_[np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1), unfolded]
    # Duplicate pairs would add up in a sparse matrix: keep the shorter way.
    order = np.lexsort((lengths, columns, rows))
    rows, columns, lengths = rows[order], columns[order], lengths[order]
    first = np.r_[True, (np.diff(rows) != 0) | (np.diff(columns) != 0)]
    return sp.csr_matrix((lengths[first], (rows[first], columns[first])), (len(points), len(points)))


def _distance(graph: sp.csr_matrix, seeds: Bool[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    return np.asarray(dijkstra(graph, directed=False, indices=np.flatnonzero(seeds), min_only=True))


def _smoothed(
    share: Float[np.ndarray, "N"],
    low: Bool[np.ndarray, "N"],
    high: Bool[np.ndarray, "N"],
    triangles: Int[np.ndarray, "F 3"],
) -> Float[np.ndarray, "N"]:
    """The share without the jags of paths along edges; 0 and 1 stay where they are."""
    pairs = edges(triangles).vertices
    ones = np.ones(len(pairs))
    adjacency = sp.coo_matrix((ones, pairs.T), (len(share), len(share)))
    adjacency = (adjacency + adjacency.T).tocsr()
    degree = np.asarray(adjacency.sum(1)).ravel()
    free = ~(low | high)
    laplacian = sp.diags(free / degree) @ (sp.diags(degree) - adjacency)
    target = np.where(low, 0.0, np.where(high, 1.0, share))
    return np.clip(spsolve((sp.identity(len(share)) + _SMOOTHING * laplacian).tocsc(), target), 0, 1)


def _centre_line(
    rest: Float[np.ndarray, "N 3"],
    triangles: Int[np.ndarray, "F 3"],
    share: Float[np.ndarray, "N"],
    attached: Bool[np.ndarray, "N"],
    tip: int,
) -> tuple[Float[np.ndarray, "S"], Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"]]:
    """Stations, and there the centres of the cross-sections, smooth along the tongue, tangents and upward normals."""
    levels = np.linspace(0, 1, _LEVELS)[1:-1]
    centres = [rest[attached].mean(0)]
    for level in levels:
        ends = level_segments(rest, triangles, share, level)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        centres.append(length @ ends.mean(1) / max(length.sum(), 1e-12))
    centres.append(rest[tip])
    shares = np.r_[0.0, levels, 1.0]
    heavy = np.ones(len(shares))
    heavy[-1] = 4.0  # the line ends at the tip
    stations = np.linspace(0, 1, _STATIONS)
    centre, tangent = np.zeros((_STATIONS, 3)), np.zeros((_STATIONS, 3))
    for axis in (1, 2):  # it lies in the median plane, x = 0
        curve = np.polynomial.Polynomial.fit(shares, np.stack(centres)[:, axis], _DEGREE, w=heavy)
        centre[:, axis], tangent[:, axis] = curve(stations), curve.deriv()(stations)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return stations, centre, tangent, np.cross(tangent, (1.0, 0.0, 0.0))


def _check_tip(rest: np.ndarray, tip: int, attached: np.ndarray, length: float) -> None:
    if length < _MIN_LENGTH:
        raise _no_tongue(f"at least {_MIN_LENGTH * MM_PER_M:.0f} mm from back to front", f"{length * MM_PER_M:.1f} mm")
    behind, aside = float(rest[:, 2].max() - rest[tip, 2]), abs(float(rest[tip, 0]))
    if behind > _MAX_BEHIND * length:
        got = f"the free part ends {behind * MM_PER_M:.1f} mm behind the foremost point"
        raise _no_tongue(f"a tip at the front, at most {_MAX_BEHIND * length * MM_PER_M:.1f} mm behind it", got)
    if aside > _MAX_ASIDE * np.ptp(rest[:, 0]):
        got = f"the foremost point of the free part lies {aside * MM_PER_M:.1f} mm beside the median plane"
        raise _no_tongue("a tip in the median plane", got)


def _check_shape(structure: TongueStructure) -> None:
    """Refuse a blunt front, and a free part that does not point forwards."""
    free, across = structure.share > _FREE, structure.rest[:, 0]
    foremost = structure.rest[:, 2] > structure.rest[free, 2].max() - _FRONT * structure.length
    blunt = float(np.ptp(across[free & foremost]) / np.ptp(across[free]))
    if blunt > _MAX_BLUNT:
        got = f"a front of {100 * blunt:.0f} % of the largest width, in its foremost {100 * _FRONT:.0f} %"
        raise _no_tongue(f"a front that narrows to {100 * _MAX_BLUNT:.0f} % of the largest width", got)
    turn = float(np.degrees(np.arccos(np.clip(structure.axis[2], -1, 1))))
    if turn > _MAX_TURN_DEG:
        raise _no_tongue(f"a free part that points forwards, within {_MAX_TURN_DEG:.0f} degrees", f"{turn:.0f} degrees")


def _no_tongue(expected: str, got: str) -> InputError:
    return InputError(
        "The model's tongue has no tip",
        where="vertex group 'tongue'",
        expected=expected,
        got=got,
        fix="use a model whose tongue is one piece, attached behind or below and free in front",
    )
