"""The state of a review: decisions that are made, undone and saved; independent of the browser."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

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
from registration.stabilize.edge_stretch import EdgeStretch, drop_stretch, skin_edges
from registration.stabilize.stabilized_folder import StoredComponents
from workflows.records.decisions import append_decisions


@dataclass(frozen=True, kw_only=True)
class WorkItem:
    """A component on the work list."""

    region: str
    component: int  # from 0
    flagged: bool
    decided: bool  # by an operator, saved or not
    action: Action

    @property
    def key(self) -> tuple[str, int]:
        return self.region, self.component


class ReviewState:
    """Decisions about a stabilized set's components, in order."""

    def __init__(
        self, stored: StoredComponents, head: HeadGeometry, log: Path, dataset: str, saved: Sequence[Decision] = ()
    ):
        self.stored, self.head, self.log, self.dataset = stored, head, log, dataset
        self.decisions = list(saved)
        self._saved = len(self.decisions)
        self._stretches: dict[tuple[str, int], EdgeStretch] = {}
        self._update()

    def action(self, region: str, component: int) -> Action:
        """Return the current action for a component."""
        return self._actions[region, component]

    def work_list(self) -> list[WorkItem]:
        """Return all components, the flagged ones first; the order does not depend on decisions."""
        decided = {(decision.region, decision.component) for decision in self.decisions}
        items = [
            WorkItem(
                region=part.region,
                component=k,
                flagged=bool(part.flagged[k]),
                decided=(part.region, k) in decided,
                action=self.action(part.region, k),
            )
            for part in self.stored.components
            for k in range(len(part.energy))
        ]
        return sorted(items, key=lambda item: not item.flagged)

    def undecided(self, region: str, component: int, step: Literal[-1, 1]) -> WorkItem | None:
        """Return the next or previous undecided component of the work list after a component; None if there is none.

        The search begins again at the other end; the component itself is not returned.
        """
        items = self.work_list()
        here = [item.key for item in items].index((region, component))
        others = [items[(here + step * k) % len(items)] for k in range(1, len(items))]
        return next((item for item in others if not item.decided), None)

    def stretch(self, region: str, component: int) -> EdgeStretch:
        """Return how far dropping a component stretches the mesh."""
        key = (region, component)
        if key not in self._stretches:
            part = next(part for part in self.stored.components if part.region == region)
            self._stretches[key] = drop_stretch(
                part, component, self.stored.mean_displacement, self.head, self._skin_edges
            )
        return self._stretches[key]

    @property
    def tearing(self) -> list[WorkItem]:
        """Components whose current action tears the mesh."""
        dropped = (item for item in self.work_list() if item.action == "drop")
        return [item for item in dropped if self.stretch(*item.key).tears]

    @cached_property
    def _skin_edges(self) -> np.ndarray:
        return skin_edges(self.head)

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
