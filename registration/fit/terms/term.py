"""The protocol of a loss term, and its inputs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from registration.fit.appearance import Appearance
from registration.fit.context import FitContext
from registration.fit.recipes import Stage
from registration.fit.variables import Variables
from registration.losses.regularization import OffsetRegularizer
from registration.types import Rendered, Targets


@dataclass(frozen=True, kw_only=True, eq=False)
class StageContext:
    """The inputs that all steps of a stage share."""

    fit: FitContext
    stage: Stage
    variables: Variables
    appearance: Appearance
    landmarks_used: Mapping[str, Bool[np.ndarray, "L"]]  # scheme -> without outliers
    regularizer: OffsetRegularizer | None  # while offsets are free


@dataclass(frozen=True, kw_only=True, eq=False)
class StepState:
    """One step: its views, mesh and rendering. Mesh and rendering are differentiable in the free variables."""

    step: int  # of the stage, from 0
    views: Sequence[int]  # the views of this step
    batch: Targets  # of these views, weighted by the views' weights
    skin_offsets: Float[Tensor, "S 3"]  # bind pose, metres
    vertices: Float[Tensor, "V 3"]  # world, metres
    rendered: Rendered
    agree: Bool[Tensor, "P"]  # pixels where rendering and target show the same kind of surface


@runtime_checkable
class Term(Protocol):
    """One loss of a stage."""

    def __call__(self, state: StepState) -> Mapping[str, Tensor]:
        """Return weighted scalars by name; the fit minimizes the sum over all terms."""
        ...


TermFactory = Callable[[StageContext], Term | None]
"""Makes the term of a stage, or None if the stage does without it."""
