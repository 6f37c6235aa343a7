"""The state of a review: decisions that are made, undone and saved; independent of the browser."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.geometry.rigid import motion_fields
from registration.stabilize.components import HeadGeometry
from registration.stabilize.decisions import (
    Action,
    CorrectionEffect,
    Corrections,
    Decision,
    compute_corrections,
    correction_effect,
    decided_actions,
)
from registration.stabilize.stabilized_folder import StoredComponents
from workflows.records.decisions import append_decisions


class ReviewState:
    """Decisions about a stabilized set's components, in order."""

    def __init__(
        self, stored: StoredComponents, head: HeadGeometry, log: Path, dataset: str, saved: Sequence[Decision] = ()
    ):
        self.stored, self.head, self.log, self.dataset = stored, head, log, dataset
        self.decisions = list(saved)
        self._saved = len(self.decisions)
        self._update()

    def action(self, region: str, component: int) -> Action:
        """Return the current action for a component."""
        return self._actions[region, component]

    def decide(self, region: str, component: int, action: Action, reason: str) -> None:
        """Append a decision. Raises InputError for a component or an action that does not exist."""
        decisions = [*self.decisions, Decision(region=region, component=component, action=action, reason=reason)]
        decided_actions(self.stored.components, decisions)
        self.decisions = decisions
        self._update()

    def undo(self) -> Decision | None:
        """Remove the last decision that is not saved and return it; None if all are saved."""
        if not self.unsaved:
            return None
        last = self.decisions.pop()
        self._update()
        return last

    def save(self) -> int:
        """Append the new decisions to the log and return their number.

        Raises:
            InputError: the log belongs to another dataset.
        """
        new = self.decisions[self._saved :]
        if new:
            append_decisions(self.log, self.dataset, new)
        self._saved = len(self.decisions)
        return len(new)

    @property
    def unsaved(self) -> int:
        """Number of decisions that are not in the log."""
        return len(self.decisions) - self._saved

    def motions(self, region: str, component: int) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"]]:
        """Return the head's displacement at one standard deviation, metres: before and after the current decisions."""
        before = self.stored.mean_displacement[region][component].astype(np.float64)
        part = next(part for part in self.stored.components if part.region == region)
        weight = part.coefficients[:, component] / len(self.stored.labels)
        removed = np.tensordot(weight @ self.corrections.twists, motion_fields(self.head.points), 1)
        for coefficients, field in self.corrections.dropped:
            removed = removed + (weight @ coefficients) * field
        return before, before - removed

    def _update(self) -> None:
        self._actions = decided_actions(self.stored.components, self.decisions)
        self.corrections: Corrections = compute_corrections(
            self.stored.components, self._actions, self.stored.labels, self.head
        )
        self.effect: CorrectionEffect = correction_effect(self.corrections, self.head)
