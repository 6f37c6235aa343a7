"""What the regeneration of one anatomical part gives: its components, and a new template if it has one."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

PartName = Literal["eyes", "teeth", "tongue", "pupils"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PartBasis:
    """The components of one anatomical part. N vertices of the part, K components; metres, the model's frame."""

    part: PartName
    vertices: Int[np.ndarray, "N"]  # indices into the model's vertices, ascending
    components: Float[np.ndarray, "K N 3"]  # per standard deviation; of the identity (eyes, teeth) or the expression
    names: tuple[str, ...]  # of the components, as eye_000
    template: Float[np.ndarray, "N 3"] | None = None  # replaces the model's; None: unchanged
    record: Mapping[str, Any]  # JSON values: seed, samples, rejected, variance kept
