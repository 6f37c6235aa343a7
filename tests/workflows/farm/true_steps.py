"""The real flows and steps of a coregistration; only the registrations are stand-ins that take milliseconds."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import workflows.steps.register
import workflows.steps.subject
from tests.workflows.rounds import TrueRegister
from workflows.engine.jobs import Step
from workflows.farm.flows import FLOWS
from workflows.steps.table import REGISTER
from workflows.steps.table import STEPS as REAL

STEPS: Mapping[str, Step] = {
    **REAL,
    REGISTER: replace(REAL[REGISTER], function="tests.workflows.farm.true_steps:register_capture"),
}
__all__ = ["FLOWS", "STEPS"]


def register_capture(**arguments: Any) -> dict[str, Any]:
    """The real step, which is given the true vertices in place of a fit's."""
    true = TrueRegister()
    workflows.steps.register.register = workflows.steps.subject.register = true  # type: ignore[assignment]
    return workflows.steps.register.register_capture(**arguments)
