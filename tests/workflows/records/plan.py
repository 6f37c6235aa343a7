"""A valid plan of a coregistration, for the tests of its record."""

from pathlib import Path

from coregister.next_model.recipes import few_registrations
from coregister.stopping_rule import StoppingRule
from registration.options import RegisterOptions
from workflows.records.coregistration import CoregistrationPlan
from workflows.records.dataset import Split

PLAN = CoregistrationPlan(
    dataset=Path("/d"),
    model=Path("/m.npz"),
    out=Path("/o"),
    options=RegisterOptions(),
    model_recipe=few_registrations(),
    components=(2,),
    samples=0,
    rule=StoppingRule(),
    split=Split(training=("ann",), held_out=("bob",), how="by the list"),
    captures={"ann": ("rest",), "bob": ("rest",)},
    without_truth=(),
)
