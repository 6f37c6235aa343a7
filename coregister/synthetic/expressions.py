"""Named expressions of synthetic subjects, in the categories of the capture protocol [GNM, Data Foundation &
Acquisition]."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from coregister.first_model import tongue
from coregister.first_model.assembly import HeadAssembly, push_out_of_eyes
from registration.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Expression:
    """One static expression: weights of MakeHuman's face units, gaze direction and tongue pose."""

    category: str
    units: Mapping[str, float] = field(default_factory=dict)  # by name of the face unit
    gaze_deg: tuple[float, float] = (0.0, 0.0)  # to the subject's left, up
    tongue: Mapping[str, float] = field(default_factory=dict)  # arguments of `tongue.displacement`


def _both(*units: str, weight: float = 1.0) -> dict[str, float]:
    return {f"{unit}{side}": weight for unit in units for side in ("Left", "Right")}


def _looking(direction: str, weight: float = 1.0) -> dict[str, float]:
    """Return the units of the lids that accompany a gaze direction."""
    inner, outer = ("Right", "Left") if direction == "Left" else ("Left", "Right")
    if direction in ("Up", "Down"):
        return _both(f"eyeLook{direction}", weight=weight)
    return {f"eyeLookIn{inner}": weight, f"eyeLookOut{outer}": weight}


EXPRESSIONS: Mapping[str, Expression] = {
    "neutral": Expression(category="neutral"),
    "stretch": Expression(
        category="flexing", units={"jawOpen": 0.8, "browInnerUp": 0.8} | _both("eyeWide", "browOuterUp", "mouthStretch")
    ),
    "compress": Expression(
        category="flexing", units=_both("eyeSquint", "browDown", "noseSneer", "mouthPress") | {"mouthShrugLower": 0.5}
    ),
    "smile": Expression(category="flexing", units=_both("mouthSmile", weight=0.9) | _both("cheekSquint", weight=0.6)),
    "viseme_aa": Expression(category="visemes", units={"jawOpen": 0.55} | _both("mouthLowerDown", weight=0.3)),
    "viseme_ee": Expression(
        category="visemes", units={"jawOpen": 0.15} | _both("mouthStretch", "mouthDimple", weight=0.6)
    ),
    "viseme_oo": Expression(category="visemes", units={"jawOpen": 0.2, "mouthPucker": 0.7}),
    "viseme_ff": Expression(category="visemes", units={"mouthRollLower": 0.6} | _both("mouthUpperUp", weight=0.4)),
    "lips_rolled": Expression(category="lips", units={"mouthRollUpper": 1.0, "mouthRollLower": 1.0}),
    "pucker": Expression(category="lips", units={"mouthPucker": 1.0}),
    "funnel": Expression(category="lips", units={"mouthFunnel": 1.0, "jawOpen": 0.2}),
    "sadness": Expression(
        category="emotions", units={"browInnerUp": 1.0, "mouthShrugLower": 0.5} | _both("mouthFrown", weight=0.9)
    ),
    "fear": Expression(
        category="emotions",
        units={"browInnerUp": 0.9, "jawOpen": 0.25} | _both("eyeWide") | _both("mouthStretch", weight=0.7),
    ),
    "anger": Expression(category="emotions", units=_both("browDown", "noseSneer") | _both("mouthPress", weight=0.6)),
    "tongue_out": Expression(category="tongue", units={"jawOpen": 0.5}, tongue={"out": 1.0}),
    "tongue_left": Expression(category="tongue", units={"jawOpen": 0.5}, tongue={"out": 0.8, "turn": 0.5}),
    "jaw_open": Expression(category="jaw", units={"jawOpen": 1.0}),
    "jaw_left": Expression(category="jaw", units={"jawLeft": 1.0, "jawOpen": 0.1}),
    "jaw_right": Expression(category="jaw", units={"jawRight": 1.0, "jawOpen": 0.1}),
    "wink_left": Expression(category="eyes", units={"eyeBlinkLeft": 1.0, "cheekSquintLeft": 0.7}),
    "wink_right": Expression(category="eyes", units={"eyeBlinkRight": 1.0, "cheekSquintRight": 0.7}),
    "blink": Expression(category="eyes", units=_both("eyeBlink")),
    "half_blink": Expression(category="eyes", units=_both("eyeBlink", weight=0.5)),
    "squint": Expression(category="eyes", units=_both("eyeSquint", "cheekSquint", weight=0.9)),
    "gaze_left": Expression(category="gaze", units=_looking("Left"), gaze_deg=(25.0, 0.0)),
    "gaze_up": Expression(category="gaze", units=_looking("Up"), gaze_deg=(0.0, 18.0)),
    "gaze_down": Expression(category="gaze", units=_looking("Down"), gaze_deg=(0.0, -20.0)),
    "brows_up": Expression(category="eyebrows", units={"browInnerUp": 1.0} | _both("browOuterUp")),
    "brows_down": Expression(category="eyebrows", units=_both("browDown")),
    "cheeks_blown": Expression(category="cheeks", units={"cheekPuff": 1.0}),
}


def expression_by_name(name: str) -> Expression:
    """Return the expression of this name.

    Raises:
        InputError: there is none; the message lists all names.
    """
    if name not in EXPRESSIONS:
        raise InputError(
            "There is no such expression",
            where="expression",
            expected=", ".join(EXPRESSIONS),
            got=name,
            fix="choose one of these",
        )
    return EXPRESSIONS[name]


def apply_expression(
    assembly: HeadAssembly, expression: Expression, vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
) -> Float[np.ndarray, "V 3"]:
    """Return a neutral head's vertices with an expression applied.

    Args:
        assembly: the rules by which parts follow MakeHuman's base mesh.
        expression: what to apply.
        vertices: of the neutral head, aligned with the template; metres.
        joints: of the neutral head, metres.

    Returns:
        Vertices, metres; lids stay outside the eyeballs.
    """
    source, rows = assembly.source, assembly.slices
    result = vertices.copy()
    if expression.units:
        delta = sum(weight * source.target(f"faceunits/{unit}") for unit, weight in expression.units.items())
        result += assembly.expression_displacement(np.asarray(delta))
    if expression.tongue:
        rest = assembly.template[rows["tongue"]]
        out = assembly.tongue_displacement(source.target("faceunits/tongueOut"))[rows["tongue"]]
        result[rows["tongue"]] += tongue.displacement(rest, out, **expression.tongue)
    left, up = expression.gaze_deg
    gaze = Rotation.from_euler("yx", [left, -up], degrees=True)
    for side, name in enumerate(("left_eye", "right_eye"), start=2):
        result[rows[name]] = gaze.apply(result[rows[name]] - joints[side]) + joints[side]
    result[rows["skin"]] = push_out_of_eyes(result[rows["skin"]], joints[2:])
    return result
