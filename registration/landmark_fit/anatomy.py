"""The anatomical term of a landmark fit: an interface."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from registration.landmark_fit.state import Free, Layout


@runtime_checkable
class Anatomy(Protocol):
    """Penalizes penetrations of parts of the head in one frame."""

    def energy(
        self, identity: Float[np.ndarray, "R"], expression: Float[np.ndarray, "Q"], joints: Float[np.ndarray, "J 3 3"]
    ) -> float:
        """Half the sum of the squared weighted residuals."""
        ...

    def rows(
        self,
        identity: Float[np.ndarray, "R"],
        expression: Float[np.ndarray, "Q"],
        joints: Float[np.ndarray, "J 3 3"],
        layout: Layout,
        free: Free,
    ) -> list[tuple[Float[np.ndarray, "M _"], Float[np.ndarray, "M"]]]:
        """Weighted Jacobians by the free columns, and residuals."""
        ...
