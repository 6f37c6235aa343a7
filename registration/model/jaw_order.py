"""The two orders of the right jaw in the scheme of 68 points.

In the scheme, points 0 to 16 run from the subject's right ear along the jaw over the chin to the left ear. Google's
`head_sparse_68.txt` had rows 2 to 6 in the reverse order until it was corrected (google/GNM, issue 75), and captures
whose landmarks were made from it have that order too.
"""

import numpy as np
from jaxtyping import Float, Int

SCHEME = "68"
_JAW = 17  # points of the scheme, the first ones
_SHORTER = 0.9  # ratio of the jaw's lengths in both orders at which one is the right one; 0.45 on a neutral head


def _turned() -> Int[np.ndarray, "68"]:
    order = np.arange(68)
    order[2:7] = order[6:1:-1].copy()
    return order


TURNED = _turned()  # `values[TURNED]` turns values of the 68 points from either order into the other


def is_reversed(points: Float[np.ndarray, "L 3"]) -> bool:
    """Return whether the points are those of the scheme with points 2 to 6 in reverse: the jaw is shorter so.

    Args:
        points: of the scheme, in any unit and frame; NaN: unknown. Another number than 68 is in no such order.
    """
    if len(points) != len(TURNED):
        return False
    if np.isfinite(points[2:7]).all(1).sum() < 2:  # both orders are equally long
        return False
    return _length(points[TURNED][:_JAW]) < _SHORTER * _length(points[:_JAW])


def _length(line: Float[np.ndarray, "N 3"]) -> float:
    known = line[np.isfinite(line).all(1)]
    return float(np.linalg.norm(np.diff(known, axis=0), axis=1).sum())
