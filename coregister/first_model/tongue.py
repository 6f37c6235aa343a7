"""The tongue: its motions, as samples for its own basis [GNM, Tongue Modeling and Articulation].

The samples are made, not captured: MakeHuman's protrusion target times random bends, twists and changes of width.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

_BEND = 0.55  # radians at the tip, standard deviation, up and down
_TURN = 0.45  # to the sides
_TWIST = 0.25
_WIDTH = 0.12  # share


def motions(
    rest: Float[np.ndarray, "V 3"], protrusion: Float[np.ndarray, "V 3"], samples: int, rng: np.random.Generator
) -> Float[np.ndarray, "N V 3"]:
    """Displacements of the tongue's vertices, metres; `protrusion` is what sticking it out wholly adds."""
    found = np.empty((samples, *rest.shape))
    for n in range(samples):
        out = rng.uniform(0, 1)
        # A tongue in the mouth has little room; one that is out is free.
        bend, turn, twist = rng.normal(0, (_BEND, _TURN, _TWIST)) * (0.25 + 0.75 * out)
        found[n] = moved(rest, protrusion, out=out, bend=bend, turn=turn, twist=twist, wider=rng.normal(0, _WIDTH))
    return found


def moved(
    rest: Float[np.ndarray, "V 3"],
    protrusion: Float[np.ndarray, "V 3"],
    *,
    out: float = 0.0,
    bend: float = 0.0,
    turn: float = 0.0,
    twist: float = 0.0,
    wider: float = 0.0,
) -> Float[np.ndarray, "V 3"]:
    """One motion's displacements: `out` is a share of the protrusion, `bend` (up), `turn` (to the subject's left) and
    `twist` are radians at the tip, `wider` a share of its width.

    The root stays: every motion grows with the square of the distance from it, along the tongue.
    """
    along = (rest[:, 2] - rest[:, 2].min()) / np.ptp(rest[:, 2])
    grown = (along**2)[:, None]
    pivot = np.array([0.0, rest[along < 0.3, 1].mean(), rest[:, 2].min() + 0.3 * np.ptp(rest[:, 2])])
    swollen = (rest + out * protrusion - pivot) * (1 + wider * grown * (1, 0, 0))
    return Rotation.from_rotvec(grown * (-bend, turn, twist)).apply(swollen) + pivot - rest
