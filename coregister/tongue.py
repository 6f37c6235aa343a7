"""The tongue: its motions, as samples for its own basis (paper, Tongue Modeling; algorithms, section 7).

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
    """Displacements of the tongue's vertices, metres; `protrusion` is what sticking it out wholly adds.

    The root stays: every motion grows with the square of the distance from it, along the tongue.
    """
    along = (rest[:, 2] - rest[:, 2].min()) / np.ptp(rest[:, 2])
    grown = along**2
    pivot = np.array([0.0, rest[along < 0.3, 1].mean(), rest[:, 2].min() + 0.3 * np.ptp(rest[:, 2])])
    found = np.empty((samples, *rest.shape))
    for n in range(samples):
        out = rng.uniform(0, 1)
        bend, turn, twist = rng.normal(0, (_BEND, _TURN, _TWIST))
        # A tongue in the mouth has little room; one that is out is free.
        angles = np.array([-bend, turn, twist]) * (0.25 + 0.75 * out)
        moved = (rest + out * protrusion - pivot) * (1 + rng.normal(0, _WIDTH) * grown[:, None] * (1, 0, 0))
        found[n] = Rotation.from_rotvec(grown[:, None] * angles).apply(moved) + pivot - rest
    return found
