"""The cubic step between two thresholds."""

import numpy as np
from jaxtyping import Float


def smoothstep(low: float, high: float, x: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Return 0 below `low`, 1 above `high` and 3 t^2 - 2 t^3 between them; decreasing if `low` is the larger."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
