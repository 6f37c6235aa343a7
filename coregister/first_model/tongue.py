"""Sampled deformations of the tongue, from which its basis is built [GNM, Tongue Modeling and Articulation].

The samples are synthetic: MakeHuman's protrusion target with random bending, twist and width.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

# Standard deviations; angles at the tip, radians.
_BEND_RAD = 0.55  # up and down
_TURN_RAD = 0.45  # to the sides
_TWIST_RAD = 0.25
_WIDTH = 0.12  # fraction of the width


def sample_displacements(
    rest: Float[np.ndarray, "V 3"], protrusion: Float[np.ndarray, "V 3"], samples: int, rng: np.random.Generator
) -> Float[np.ndarray, "N V 3"]:
    """Sample random deformations of the tongue.

    Args:
        rest: vertices at rest, metres, model frame.
        protrusion: displacement of the fully protruded tongue, metres.
        samples: N.
        rng: source of randomness.

    Returns:
        Displacements from the rest position, metres.
    """
    result = np.empty((samples, *rest.shape))
    for n in range(samples):
        out = rng.uniform(0, 1)
        # Inside the mouth the tongue has little room to bend.
        bend, turn, twist = rng.normal(0, (_BEND_RAD, _TURN_RAD, _TWIST_RAD)) * (0.25 + 0.75 * out)
        wider = rng.normal(0, _WIDTH)
        result[n] = displacement(rest, protrusion, out=out, bend=bend, turn=turn, twist=twist, wider=wider)
    return result


def displacement(
    rest: Float[np.ndarray, "V 3"],
    protrusion: Float[np.ndarray, "V 3"],
    *,
    out: float = 0.0,
    bend: float = 0.0,
    turn: float = 0.0,
    twist: float = 0.0,
    wider: float = 0.0,
) -> Float[np.ndarray, "V 3"]:
    """Return the displacement of one deformation.

    The root is fixed: the deformation grows with the square of the distance from it along the tongue.

    Args:
        rest: vertices at rest, metres, model frame.
        protrusion: displacement of the fully protruded tongue, metres.
        out: fraction of the protrusion.
        bend: rotation of the tip upwards, radians.
        turn: rotation of the tip to the subject's left, radians.
        twist: rotation of the tip about the tongue's axis, radians.
        wider: relative increase of the tip's width.

    Returns:
        Displacements from the rest position, metres.
    """
    along = (rest[:, 2] - rest[:, 2].min()) / np.ptp(rest[:, 2])
    growth = (along**2)[:, None]
    pivot = np.array([0.0, rest[along < 0.3, 1].mean(), rest[:, 2].min() + 0.3 * np.ptp(rest[:, 2])])
    widened = (rest + out * protrusion - pivot) * (1 + wider * growth * (1, 0, 0))
    return Rotation.from_rotvec(growth * (-bend, turn, twist)).apply(widened) + pivot - rest
