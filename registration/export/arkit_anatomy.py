"""The places on a head by which ARKit's shapes are defined: edges of the lids, lips and their corners, brows, jaw."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from registration.errors import InputError
from registration.geometry.quads import edges_of
from registration.model import regions
from registration.model.gnm_npz import GNMData

_PUPILS_M = 0.063  # between the pupils of an average adult; lengths are given for it
_CORNER = 0.006  # m at that size, from the corner of the mouth
_OUTERMOST = 0.0015  # m at that size: the lips' outermost part, whose middle is the corner
_JAW_JOINT = 0.9  # of the ears' depth, from their back


@dataclass(frozen=True, kw_only=True, eq=False)
class Anatomy:
    """Places of a head in the model's frame, metres. Rows are vertices; sides are the subject's left unless named."""

    points: Float[np.ndarray, "V 3"]
    mirror: Int[np.ndarray, "V"]
    unit: float  # metres per "average" metre: the distance between the pupils over that of an average adult
    upper_lid: Int[np.ndarray, "U"]  # edge of the upper lid, from the inner to the outer corner
    lower_lid: Int[np.ndarray, "L"]
    eyeball: Int[np.ndarray, "B"]
    eye_centre: Float[np.ndarray, "3"]
    areas: dict[str, Int[np.ndarray, "_"]]  # as `regions.face_areas`, and the ones below

    @classmethod
    def of(cls, data: GNMData, points: Float[np.ndarray, "V 3"]) -> "Anatomy":
        """Find the places on a head.

        Args:
            data: the model.
            points: a head of its topology, in its frame, metres.

        Raises:
            InputError: the model has no edges of the lids or of the lips.
        """
        balls = regions.eyeballs(data)
        centres = [(points[ball].min(0) + points[ball].max(0)) / 2 for ball in balls]
        unit = float(np.linalg.norm(centres[0] - centres[1])) / _PUPILS_M
        masks = regions.face_areas(data)
        lids = _edge(data, regions.exterior(data), regions.eye_sockets(data)) & (points[:, 0] > 0)
        upper, lower = _upper_and_lower(points, np.flatnonzero(lids))
        lips = _edge(data, regions.exterior(data), regions.mouth_lining(data))
        areas = {name: np.flatnonzero(mask) for name, mask in masks.items()}
        areas["upper_edge"] = np.flatnonzero(lips & masks["upper_lip"])
        areas["lower_edge"] = np.flatnonzero(lips & masks["lower_lip"])
        for name in ("upper_edge", "lower_edge"):
            if not len(areas[name]):
                raise _missing("the edges of the lips", "upper_lip, lower_lip, mouth_sock")
        red = np.concatenate([areas["upper_lip"], areas["lower_lip"]])
        end = points[red[points[red, 0] > points[red, 0].max() - _OUTERMOST * unit]].mean(0)
        near = np.linalg.norm(points[red] - end, axis=1) < _CORNER * unit
        areas["corner"] = np.unique(red[near])
        areas["lower_teeth"] = np.flatnonzero(regions.lower_teeth(data))
        areas["tongue"] = np.flatnonzero(regions.tongue(data))
        areas["ears"] = np.flatnonzero(regions.ears(data))
        return cls(
            points=points,
            mirror=data.mirror_indices.astype(np.int64),
            unit=unit,
            upper_lid=upper,
            lower_lid=lower,
            eyeball=np.flatnonzero(balls[0]),
            eye_centre=centres[0],
            areas=areas,
        )

    @property
    def corner(self) -> Float[np.ndarray, "3"]:
        """The left corner of the mouth."""
        return np.asarray(self.points[self.areas["corner"]].mean(0))

    @property
    def jaw_joint(self) -> Float[np.ndarray, "3"]:
        """A point on the axis about which the jaw turns, which runs along x: just before the ear canals."""
        ears = self.points[self.areas["ears"]]
        low, high = ears.min(0), ears.max(0)
        return np.array([0.0, (low[1] + high[1]) / 2, low[2] + _JAW_JOINT * (high[2] - low[2])])

    @property
    def aperture(self) -> float:
        """Mean height of the left eye's opening, metres, over the middle half of its width."""
        return lid_aperture(self, self.points)


def lid_aperture(anatomy: Anatomy, points: Float[np.ndarray, "V 3"]) -> float:
    """Return the mean distance between the edges of the left lids over the middle half of the eye's width.

    Args:
        anatomy: of the head at rest.
        points: the same head, deformed, metres.
    """
    at_rest = anatomy.points[anatomy.upper_lid, 0]
    low, high = np.quantile(at_rest, [0.25, 0.75])
    chosen = anatomy.upper_lid[(at_rest >= low) & (at_rest <= high)]
    opposite = at_same_width(anatomy, anatomy.lower_lid, points, anatomy.points[chosen, 0])
    return float(np.linalg.norm(points[chosen] - opposite, axis=1).mean())


def at_same_width(
    anatomy: Anatomy, rows: Int[np.ndarray, "L"], points: Float[np.ndarray, "V 3"], x: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N 3"]:
    """Return the points of a curve of vertices, ordered by x at rest, that have these x at rest."""
    known = anatomy.points[rows, 0]
    return np.stack([np.interp(x, known, points[rows, axis]) for axis in range(3)], 1)


def _edge(data: GNMData, side: Bool[np.ndarray, "V"], other: Bool[np.ndarray, "V"]) -> Bool[np.ndarray, "V"]:
    """The vertices of one part of the skin that have a neighbour in another part."""
    ends = edges_of(data.quads.astype(np.int64))[0]
    edge = np.zeros(len(side), bool)
    for here, there in (ends.T, ends[:, ::-1].T):
        edge[here[side[here] & other[there]]] = True
    return edge


def _upper_and_lower(
    points: Float[np.ndarray, "V 3"], ring: Int[np.ndarray, "R"]
) -> tuple[Int[np.ndarray, "U"], Int[np.ndarray, "L"]]:
    """Divide the edge of the lids at its corners; each part by ascending x. Raises InputError if there is none."""
    if len(ring) < 8:
        raise _missing("the edges of the lids", "eye_sockets, skin_exterior")
    x, y = points[ring, 0], points[ring, 1]
    first, last = x.argmin(), x.argmax()
    line = y[first] + (y[last] - y[first]) * (x - x[first]) / (x[last] - x[first])
    by_x = np.argsort(x, kind="stable")
    upper, lower = (ring[by_x[keep[by_x]]] for keep in (y >= line, y <= line))  # both have the corners
    return upper, lower


def _missing(what: str, where: str) -> InputError:
    return InputError(
        f"The model has not {what}, by which ARKit's shapes are defined",
        where=where,
        expected="skin that ends at the inside of lids and lips",
        got="vertex groups without common edges",
        fix="export it without --arkit",
    )
