"""The state behind the review page: what is decided, undone, saved. Knows no browser."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from registration.geometry.rigid import motion_fields
from registration.stabilize.components import Head
from registration.stabilize.decisions import (
    Action,
    Change,
    Corrections,
    Decision,
    change,
    corrections,
    decided_actions,
)
from registration.stabilize.stabilized_folder import StoredComponents
from workflows.records.decisions import append_decisions


class Review:
    """Decisions about a stabilized set's components, in the order they are made."""

    def __init__(self, stored: StoredComponents, head: Head, log: Path, dataset: str, saved: Sequence[Decision] = ()):
        self.stored, self.head, self.log, self.dataset = stored, head, log, dataset
        self.decisions = list(saved)
        self._saved = len(self.decisions)
        self._update()

    def action(self, region: str, component: int) -> Action:
        return self._actions[region, component]

    def decide(self, region: str, component: int, action: Action, reason: str) -> None:
        """Raises InputError for a component or an action that there is not."""
        made = [*self.decisions, Decision(region=region, component=component, action=action, reason=reason)]
        decided_actions(self.stored.components, made)
        self.decisions = made
        self._update()

    def undo(self) -> Decision | None:
        """Take the last decision back that is not saved, and return it; what is saved stays in the log."""
        if not self.unsaved:
            return None
        last = self.decisions.pop()
        self._update()
        return last

    def save(self) -> int:
        """Append what is not in the log yet; returns how many. Raises InputError if the log is another dataset's."""
        fresh = self.decisions[self._saved :]
        if fresh:
            append_decisions(self.log, self.dataset, fresh)
        self._saved = len(self.decisions)
        return len(fresh)

    @property
    def unsaved(self) -> int:
        return len(self.decisions) - self._saved

    def motions(self, region: str, component: int) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, "V 3"]]:
        """What the whole head does along with a coefficient of one, metres: before, and after what is decided now."""
        before = self.stored.along[region][component].astype(np.float64)
        part = next(part for part in self.stored.components if part.region == region)
        weight = part.coefficients[:, component] / len(self.stored.labels)
        taken = np.tensordot(weight @ self.corrections.twists, motion_fields(self.head.points), 1)
        for coefficients, field in self.corrections.dropped:
            taken = taken + (weight @ coefficients) * field
        return before, before - taken

    def _update(self) -> None:
        self._actions = decided_actions(self.stored.components, self.decisions)
        self.corrections: Corrections = corrections(
            self.stored.components, self._actions, self.stored.labels, self.head
        )
        self.change: Change = change(self.corrections, self.head)
