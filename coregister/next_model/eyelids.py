"""Eyeballs between their lids: where they stand in a new template and how they follow every identity component
[GNM, Head Identity]; docs/algorithms.md, "Eyeballs and eyelids"."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from registration.frames import MM_PER_M
from registration.geometry.closest_point import Searched, barycentric_points
from registration.geometry.extrapolation import continued
from registration.model import regions
from registration.model.gnm_npz import GNMData

BOUND = 3.0  # standard deviations at which a component is looked at, either way
_REACH = 2e-3  # metres: exterior skin this near to an eyeball is its lids' rim
_FADE = 2e-3  # metres along which the skin around a rim follows it
_ROUNDS = 5
_SETTLED = 1e-8  # metres


@dataclass(frozen=True, kw_only=True, eq=False)
class Socket:
    """One eyeball of a model at rest, and the rims of the lids about it."""

    ball: Int[np.ndarray, "B"]  # all its vertices
    shell: Float[np.ndarray, "S 3"]  # its outer surface, metres
    triangles: Int[np.ndarray, "T 3"]  # of the shell
    rim: Int[np.ndarray, "R"]
    gap: Float[np.ndarray, "R"]  # signed distance of the rim from the shell at rest, metres, positive outside

    @cached_property
    def _searched(self) -> Searched:
        return Searched(self.shell, self.triangles)

    def gaps(
        self, rim: Float[np.ndarray, "R 3"], shift: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, "R"], Float[np.ndarray, "R 3"]]:
        """Signed distances of rims from the shell moved by `shift`, and the unit directions in which they grow."""
        points = np.asarray(rim, np.float64) - shift
        distance, face, barycentric = self._searched.closest(points)
        a, b, c = (self.shell[self.triangles[face, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        away = points - barycentric_points(self.shell, self.triangles, face, barycentric)
        sign = np.where((away * normal).sum(1) < 0, -1.0, 1.0)
        # On the surface itself the way out is its normal.
        near = (distance < 1e-9)[:, None]
        direction = np.where(near, normal, away * (sign / np.maximum(distance, 1e-12))[:, None])
        return sign * distance, direction

    def shift(self, rims: list[Float[np.ndarray, "R 3"]], signs: list[float]) -> Float[np.ndarray, "3"]:
        """t for which the shell, moved by sign * t, keeps its distances from each rim best (Gauss-Newton)."""
        t = np.zeros(3)
        for _ in range(_ROUNDS):
            left, right = [], []
            for rim, sign in zip(rims, signs, strict=True):
                gap, direction = self.gaps(rim, sign * t)
                left.append(sign * direction)
                right.append(gap - self.gap)
            step = np.linalg.lstsq(np.concatenate(left), np.concatenate(right), rcond=None)[0]
            t = t + step
            if np.abs(step).max() < _SETTLED:
                break
        return t


def sockets(data: GNMData) -> tuple[Socket, Socket]:
    """The left eye's and the right eye's, of a model's template. Raises InputError if it lacks the vertex groups."""
    template, outside = data.template_vertex_positions.astype(np.float64), regions.exterior(data)
    found = []
    for ball, shell in zip(regions.eyeballs(data), regions.eyeball_shells(data), strict=True):
        triangles = data.triangles[shell[data.triangles].all(1)].astype(np.int64)
        socket = Socket(
            ball=np.flatnonzero(ball), shell=template, triangles=triangles, rim=np.zeros(0, int), gap=np.zeros(0)
        )
        middle = template[shell].mean(0)
        reach = np.linalg.norm(template[shell] - middle, axis=1).max() + _REACH
        near = np.flatnonzero(outside & (np.linalg.norm(template - middle, axis=1) < reach))
        gap, _ = socket.gaps(template[near], np.zeros(3))
        rim = np.abs(gap) < _REACH
        found.append(Socket(ball=socket.ball, shell=template, triangles=triangles, rim=near[rim], gap=gap[rim]))
    return found[0], found[1]


def placed(socket: Socket, template: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "3"]:
    """How the eyeball moves from where the sockets' model has it into a new template, metres."""
    return socket.shift([template[socket.rim]], [1.0])


def following(
    socket: Socket, template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"]
) -> Float[np.ndarray, "K 3"]:
    """How the eyeball moves with each component: distances from the lids at +-BOUND change least, metres.

    `socket` is of the template in which the eyeball stands already.
    """
    rest = template[socket.rim]
    moves = BOUND * basis[:, socket.rim].astype(np.float64)
    return np.stack([socket.shift([rest + move, rest - move], [1.0, -1.0]) / BOUND for move in moves]).reshape(-1, 3)


def rested(
    both: tuple[Socket, Socket],
    data: GNMData,
    template: Float[np.ndarray, "V 3"],
    basis: Float[np.ndarray, "K V 3"],
    shifts: Float[np.ndarray, "K 2 3"],
) -> Float[np.ndarray, "K V 3"]:
    """The basis with lids that stay on eyeballs which move by `shifts`, to first order in the coefficient.

    No translation fits all of a rim: what the gaps at +-BOUND differ by is taken out along the gaps' directions, fading
    into the skin around. What remains is second order: lids that slide along the ball. [GNM] leaves it all.
    """
    known = np.zeros(len(template), bool)
    wanted = np.zeros((len(template), len(basis), 3))
    for side, socket in enumerate(both):
        known[socket.rim] = True
        rest = template[socket.rim]
        _, outward = socket.gaps(rest, np.zeros(3))
        for k, moves in enumerate(BOUND * basis[:, socket.rim].astype(np.float64)):
            ahead, _ = socket.gaps(rest + moves, BOUND * shifts[k, side])
            back, _ = socket.gaps(rest - moves, -BOUND * shifts[k, side])
            wanted[socket.rim, k] = -((ahead - back) / (2 * BOUND))[:, None] * outward
    flat = wanted.reshape(len(template), -1)
    change = continued(flat, known, data.triangles, template, reach_m=_FADE)
    change[~regions.skin(data)] = 0
    return basis + change.reshape(len(template), len(basis), 3).swapaxes(0, 1)


def gap_change_mm(
    both: tuple[Socket, Socket], template: Float[np.ndarray, "V 3"], basis: Float[np.ndarray, "K V 3"]
) -> Float[np.ndarray, "K"]:
    """How much distances of lids from eyeballs change with each component at +-BOUND: the rim's mean, mm, the worst of
    both eyes and signs; 0 of an eyeball that no lid is near. `both` are of that template."""
    found = np.zeros((len(basis), 2, 2))
    for side, socket in enumerate(both):
        if not len(socket.rim):
            continue
        rest, centre = template[socket.rim], socket.ball
        for k, component in enumerate(BOUND * basis.astype(np.float64)):
            shift = component[centre].mean(0)
            for sign in (1, -1):
                gap, _ = socket.gaps(rest + sign * component[socket.rim], sign * shift)
                found[k, side, (sign + 1) // 2] = MM_PER_M * np.abs(gap - socket.gap).mean()
    return found.max((1, 2), initial=0)
