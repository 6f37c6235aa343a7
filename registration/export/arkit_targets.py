"""What ARKit's 52 shapes do, as motions of places on a head: where the edges of the lids, the lips, the brows, the jaw
go at weight 1. Lengths are in millimetres for an average adult and follow the distance between the pupils.

The motions are this project's own description of the shapes' published names and meanings; nobody's shapes are copied.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from registration.export.arkit_anatomy import Anatomy, at_same_width

_MM = 1e-3
_MEETING = 0.12  # of the eye's opening, from below: where the lids meet
_GAZE_DEG = {"Up": 20.0, "Down": 22.0, "In": 25.0, "Out": 25.0}
_JAW_DEG = 13.0
_CORNER_SHARE = 0.4  # of the jaw's motion, that the corners of the mouth make
_UPPER_LIP_SHARE = 0.35  # of the opening, by which the upper lip comes down to close it
EYE, FACE, TONGUE = ("left_eye",), ("lower_face",), ("tongue",)  # components of the basis, as `expression_modes`
OPPOSITE = {"left_eye": "right_eye", "right_eye": "left_eye"}
BOTH_EYES = ("left_eye", "right_eye")


@dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Vertices and their displacements, metres; those of one motion count together as much as those of another."""

    rows: Int[np.ndarray, "N"]
    moves: Float[np.ndarray, "N 3"]
    share: float = 1.0

    def mirrored(self, mirror: Int[np.ndarray, "V"]) -> "Motion":
        return replace(self, rows=mirror[self.rows], moves=self.moves * (-1, 1, 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """What a shape does."""

    modes: tuple[str, ...]  # the components that may be used
    motions: tuple[Motion, ...]
    reach: float  # metres; the skin farther than this from all that moves stays
    gaze: Float[np.ndarray, "V 3"] | None = field(default=None)  # displacement of the eyeball by its joint

    def mirrored(self, mirror: Int[np.ndarray, "V"]) -> "Target":
        """The same on the other side."""
        return Target(
            modes=tuple(OPPOSITE.get(mode, mode) for mode in self.modes),
            motions=tuple(motion.mirrored(mirror) for motion in self.motions),
            reach=self.reach,
            gaze=None if self.gaze is None else self.gaze[mirror] * (-1, 1, 1),
        )


def left_targets(head: Anatomy) -> dict[str, Target]:
    """Return the shapes of the left side, by their names without "Left"."""
    return {**_eye(head), **_brow_cheek_and_nose(head), **_mouth_side(head)}


def sideways_targets(head: Anatomy) -> dict[str, Target]:
    """Return the shapes that go to the left, by their names without "Left": jaw and mouth."""
    return {"jaw": _jaw_shifted(head, (6, 0, 0)), "mouth": _lips(head)["mouthLeft"]}


def middle_targets(head: Anatomy) -> dict[str, Target]:
    """Return the shapes of both sides, but mouthClose."""
    lips = {name: target for name, target in _lips(head).items() if name != "mouthLeft"}
    return {**_jaw(head), **lips, **_both_sides(head)}


def closing(head: Anatomy, jaw_open: Float[np.ndarray, "V 3"]) -> Target:
    """Return mouthClose, which closes the lips while the jaw stays open: it is added to jawOpen.

    Args:
        head: the head at rest.
        jaw_open: the solved displacement of jawOpen.
    """
    upper, lower = (_by_x(head, head.areas[edge]) for edge in ("upper_edge", "lower_edge"))
    at = head.points[upper, 0]
    gap = at_same_width(head, lower, jaw_open, at) - jaw_open[upper]
    down = np.zeros_like(head.points)
    down[upper] = _UPPER_LIP_SHARE * gap
    red, lower_red = head.areas["upper_lip"], head.areas["lower_lip"]
    upper_moves = at_same_width(head, upper, down, head.points[red, 0])
    meeting = at_same_width(head, upper, jaw_open + down, head.points[lower_red, 0])  # where the upper edge is then
    motions = (
        Motion(rows=red, moves=upper_moves),
        Motion(rows=lower_red, moves=meeting - jaw_open[lower_red]),
        _still(head, "lower_teeth"),
        _still(head, "chin", share=0.3),
    )
    return _target(head, FACE, motions, 30)


def _eye(head: Anatomy) -> dict[str, Target]:
    upper, lower, points = head.upper_lid, head.lower_lid, head.points

    def meeting(rows: Int[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
        """Where the lids' edges meet, on the sphere about the eye's centre on which the lower one lies."""
        x = points[rows, 0]
        low, high = (at_same_width(head, edge, points, x) for edge in (lower, upper))
        middle = low + _MEETING * (high - low) - head.eye_centre
        radius = np.linalg.norm(low - head.eye_centre, axis=1, keepdims=True)
        return head.eye_centre + middle / np.linalg.norm(middle, axis=1, keepdims=True) * radius

    def lid(rows: Int[np.ndarray, "N"], move_mm: tuple[float, float, float]) -> Motion:
        """Most in the middle of the lid, nothing at its corners."""
        x = points[rows, 0]
        along = (x - x.min()) / (x.max() - x.min())
        return Motion(rows=rows, moves=np.sin(np.pi * along)[:, None] * _metres(head, move_mm))

    def lids(upper_mm: tuple[float, float, float], lower_mm: tuple[float, float, float]) -> tuple[Motion, ...]:
        return lid(upper, upper_mm), lid(lower, lower_mm)

    blink = tuple(Motion(rows=rows, moves=meeting(rows) - points[rows]) for rows in (upper, lower))
    lid_moves: dict[str, tuple[Motion, ...]] = {
        "eyeBlink": blink,
        "eyeWide": lids((0, 2.2, -0.6), (0, -0.5, 0)),
        "eyeSquint": lids((0, -1.0, 0), (0, 2.2, 0.3)),
        "eyeLookUp": lids((0, 1.6, -0.4), (0, 0.8, 0)),
        "eyeLookDown": lids((0, -4.0, 0.6), (0, -1.0, -0.2)),
        "eyeLookIn": lids((-0.8, 0, 0), (-0.8, 0, 0)),
        "eyeLookOut": lids((0.8, 0, 0), (0.8, 0, 0)),
    }
    found = {}
    for name, motions in lid_moves.items():
        target = _target(head, EYE, motions, 22)
        direction = name.removeprefix("eyeLook")
        found[name] = replace(target, gaze=_gaze(head, direction)) if direction in _GAZE_DEG else target
    return found


def _gaze(head: Anatomy, direction: str) -> Float[np.ndarray, "V 3"]:
    """The displacement of the left eyeball that looks in a direction: a turn about its centre."""
    axis, sign = {"Up": (0, -1), "Down": (0, 1), "In": (1, -1), "Out": (1, 1)}[direction]
    turn = Rotation.from_rotvec(np.eye(3)[axis] * sign * np.radians(_GAZE_DEG[direction]))
    moves = np.zeros_like(head.points)
    local = head.points[head.eyeball] - head.eye_centre
    moves[head.eyeball] = turn.apply(local) - local
    return moves


def _brow_cheek_and_nose(head: Anatomy) -> dict[str, Target]:
    rows, along = _brow_rows(head)
    down = Motion(rows=rows, moves=(1 - 0.6 * along)[:, None] * _metres(head, (-2, -4.5, 0)))
    outer = Motion(rows=rows, moves=_bump(along, 0.65, 0.35)[:, None] * _metres(head, (0, 6, -1)))
    squint = _whole(head, "left_infraorbital", (0, 3, 1.5))
    nose = head.areas["nose"]
    at_wing = _bump(head.points[nose, 0], 0.015 * head.unit, 0.008 * head.unit)
    wing = Motion(rows=nose, moves=at_wing[:, None] * _metres(head, (1, 3.5, 0)))
    lip = _along_lip(head, "upper_lip", 0.012, 0.01, (0, 2.5, 0))
    return {
        "browDown": _target(head, EYE, (down, *_lids_at_rest(head)), 25),
        "browOuterUp": _target(head, EYE, (outer, *_lids_at_rest(head)), 25),
        "cheekSquint": _target(head, FACE, (squint, _still(head, "corner")), 30),
        "noseSneer": _target(head, FACE, (wing, lip, _still(head, "lower_lip")), 30),
    }


def _brow_rows(head: Anatomy) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """The left brow, and where its vertices are from its inner end (0) to its outer one (1)."""
    rows = head.areas["left_brow"]
    x = head.points[rows, 0]
    return rows, (x - x.min()) / np.ptp(x)


def _lids_at_rest(head: Anatomy) -> tuple[Motion, ...]:
    return tuple(Motion(rows=rows, moves=np.zeros((len(rows), 3))) for rows in (head.upper_lid, head.lower_lid))


def _mouth_side(head: Anatomy) -> dict[str, Target]:
    other = Motion(rows=head.areas["corner"], moves=np.zeros((len(head.areas["corner"]), 3))).mirrored(head.mirror)
    teeth = _still(head, "lower_teeth")

    def corner(*move_mm: float) -> Target:
        return _target(head, FACE, (_whole(head, "corner", move_mm), other, teeth), 45)

    def half(*motions: Motion) -> Target:
        return _target(head, FACE, (*motions, other, teeth), 35)

    return {
        "mouthSmile": corner(7, 7, -5),
        "mouthFrown": corner(1, -7, -2),
        "mouthDimple": corner(4.5, 0.5, -4),
        "mouthStretch": corner(7, -2.5, -4),
        "mouthPress": half(
            _along_lip(head, "upper_lip", 0.013, 0.012, (0, -1.2, -1)),
            _along_lip(head, "lower_lip", 0.013, 0.012, (0, 1.8, -1)),
        ),
        "mouthLowerDown": half(
            _along_lip(head, "lower_lip", 0.011, 0.012, (1, -6, -0.5)), _along_lip(head, "upper_lip", 0, 1, (0, 0, 0))
        ),
        "mouthUpperUp": half(
            _along_lip(head, "upper_lip", 0.011, 0.012, (0, 5, 0)), _along_lip(head, "lower_lip", 0, 1, (0, 0, 0))
        ),
    }


def _jaw(head: Anatomy) -> dict[str, Target]:
    turn = Rotation.from_rotvec([np.radians(_JAW_DEG), 0, 0])

    def opened(rows: Int[np.ndarray, "N"]) -> Motion:
        local = head.points[rows] - head.jaw_joint
        return Motion(rows=rows, moves=turn.apply(local) - local)

    corner = opened(head.areas["corner"])
    corner = replace(corner, moves=_CORNER_SHARE * corner.moves + _metres(head, (-2, 0, 0)))
    parts = [opened(rows) for rows in _with_the_jaw(head)]
    motions = (*parts, _still(head, "upper_lip"), corner, corner.mirrored(head.mirror))
    return {"jawOpen": _target(head, (*FACE, *TONGUE), motions, 90), "jawForward": _jaw_shifted(head, (0, 0, 5))}


def _jaw_shifted(head: Anatomy, move_mm: tuple[float, float, float]) -> Target:
    parts = [_moved(head, rows, move_mm) for rows in _with_the_jaw(head)]
    return _target(head, (*FACE, *TONGUE), (*parts, _still(head, "upper_lip", share=0.2)), 70)


def _with_the_jaw(head: Anatomy) -> list[Int[np.ndarray, "_"]]:
    """Lower teeth and tongue; chin and lower lip."""
    groups = ("lower_teeth", "tongue"), ("chin", "lower_lip")
    return [np.concatenate([head.areas[area] for area in areas]) for areas in groups]


def _lips(head: Anatomy) -> dict[str, Target]:
    teeth = _still(head, "lower_teeth")

    def corners(*move_mm: float) -> tuple[Motion, Motion]:
        left = _whole(head, "corner", move_mm)
        return left, left.mirrored(head.mirror)

    def middle(area: str, *move_mm: float) -> Motion:
        return _along_lip(head, area, 0, 0.014, move_mm)

    def lips(motions: Iterable[Motion], reach_mm: float = 35) -> Target:
        return _target(head, FACE, (*motions, teeth), reach_mm)

    pucker = (middle("upper_lip", 0, -0.5, 6), middle("lower_lip", 0, 0.5, 6), *corners(-7, 0, 4))
    funnel = (middle("upper_lip", 0, 3, 5), middle("lower_lip", 0, -4, 5), *corners(-6, 0, 4))
    left = [_whole(head, lip, (7, 0, 0)) for lip in ("upper_lip", "lower_lip")]
    return {
        "mouthPucker": lips(pucker, 45),
        "mouthFunnel": lips(funnel, 45),
        "mouthLeft": lips(left, 45),
        "mouthRollLower": lips((middle("lower_lip", 0, 2.5, -5), *corners(0, 0, 0))),
        "mouthRollUpper": lips((middle("upper_lip", 0, -2, -4.5), *corners(0, 0, 0))),
        "mouthShrugLower": lips((_whole(head, "chin", (0, 4, 1.5)), middle("lower_lip", 0, 3.5, 2))),
        "mouthShrugUpper": lips((middle("upper_lip", 0, 3.5, 2), middle("lower_lip", 0, 1.5, 1))),
    }


def _both_sides(head: Anatomy) -> dict[str, Target]:
    tongue = head.areas["tongue"]
    z = head.points[tongue, 2]
    out = Motion(rows=tongue, moves=(((z - z.min()) / np.ptp(z)) ** 2)[:, None] * _metres(head, (0, -4, 28)))
    rows, along = _brow_rows(head)
    inner = Motion(rows=rows, moves=_bump(along, 0.0, 0.4)[:, None] * _metres(head, (0, 6, -1)))
    brows = (inner, *_lids_at_rest(head))
    middle = _whole(head, "middle_brow", (0, 5, -0.8))
    cheek = head.areas["left_cheek"]
    from_middle = np.linalg.norm(head.points[cheek] - head.points[cheek].mean(0), axis=1)
    profile = 1 - (from_middle / from_middle.max()) ** 2
    blown = Motion(rows=cheek, moves=profile[:, None] * _metres(head, (6, 0, 3)))
    mouth = [_still(head, area) for area in ("upper_lip", "lower_lip", "chin")]
    return {
        "browInnerUp": _target(head, BOTH_EYES, (*brows, *(b.mirrored(head.mirror) for b in brows), middle), 25),
        "cheekPuff": _target(head, FACE, (blown, blown.mirrored(head.mirror), *mouth), 45),
        "tongueOut": _target(head, TONGUE, (out,), 200),
    }


def _by_x(head: Anatomy, rows: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    return rows[np.argsort(head.points[rows, 0], kind="stable")]


def _target(head: Anatomy, modes: tuple[str, ...], motions: Iterable[Motion], reach_mm: float) -> Target:
    return Target(modes=modes, motions=tuple(motions), reach=reach_mm * _MM * head.unit)


def _metres(head: Anatomy, move_mm: Iterable[float]) -> Float[np.ndarray, "3"]:
    return np.array(list(move_mm), float) * _MM * head.unit


def _whole(head: Anatomy, area: str, move_mm: Iterable[float], share: float = 1.0) -> Motion:
    return replace(_moved(head, head.areas[area], move_mm), share=share)


def _moved(head: Anatomy, rows: Int[np.ndarray, "N"], move_mm: Iterable[float]) -> Motion:
    return Motion(rows=rows, moves=np.tile(_metres(head, move_mm), (len(rows), 1)))


def _still(head: Anatomy, area: str, share: float = 1.0) -> Motion:
    return _whole(head, area, (0, 0, 0), share)


def _along_lip(head: Anatomy, lip: str, centre: float, width: float, move_mm: Iterable[float]) -> Motion:
    """A lip moves most at x = `centre` (metres at average size), and less by `width` beside it."""
    rows = head.areas[lip]
    profile = _bump(head.points[rows, 0], centre * head.unit, width * head.unit)
    return Motion(rows=rows, moves=profile[:, None] * _metres(head, move_mm))


def _bump(x: Float[np.ndarray, "N"], centre: float, width: float) -> Float[np.ndarray, "N"]:
    return np.exp(-(((x - centre) / width) ** 2))
