"""The plan of a coregistration, checked before anything is computed."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from coregister.evaluate.linear_fit import identity_part
from coregister.next_model.recipes import DEFAULT_MODEL_RECIPE, load_model_recipe
from coregister.stopping_rule import Rule
from registration.errors import InputError
from registration.fit.recipes import named_recipe
from registration.model import gnm_npz
from workflows.records.coregistration import Plan, check_out
from workflows.records.dataset import read_dataset, split

COMPONENTS = (5, 10, 20, 40)  # that models are measured with, unless others are asked for


def make_plan(
    dataset: Path,
    *,
    model_path: Path,
    out: Path,
    recipe: str = "draft",
    model_recipe: str = DEFAULT_MODEL_RECIPE,
    held_out: float | Path | None = None,
    seed: int = 0,
    views: int | None = None,
    components: Sequence[int] | None = None,
    samples: int = 200,
    rule: Rule | None = None,
) -> Plan:
    """The plan of rounds over a dataset until the rule says enough, all in the folder `out` (docs/coregistration.md).

    Args:
        dataset: a folder of subject folders, each of capture folders.
        model_path: the first model, with its landmark schemes beside it.
        model_recipe: name or import path of the settings of model building (`load_model_recipe`).
        held_out: as for `dataset.split`.
        components: numbers that models are measured with, the largest decides; None: COMPONENTS, as far as models go.
        samples: random heads of each model, for specificity; 0: none.

    Raises:
        InputError: `read_dataset`, `split` or `check_out` refuses; no such recipe or model; more components than there
            can be. Nothing is computed or written.
    """
    named_recipe(recipe)
    found = read_dataset(dataset)
    plan = Plan(
        dataset=Path(dataset),
        model=Path(model_path),
        out=Path(out),
        recipe=recipe,
        model_recipe=load_model_recipe(model_recipe),
        views=views,
        seed=seed,
        components=tuple(components or COMPONENTS),
        samples=samples,
        rule=rule or Rule(),
        split=split(found, held_out, seed),
    )
    _check(plan, asked=components is not None)
    check_out(plan.out)
    return plan


def _check(plan: Plan, asked: bool) -> None:
    """Everything that a later step would refuse and that is known now."""
    refuse: Callable[..., InputError] = partial(InputError, fix="change it")
    if plan.rule.rounds < 1:
        raise refuse("There is no round to go", where="iterations", expected="from 1", got=plan.rule.rounds)
    if list(plan.components) != sorted(set(plan.components)) or plan.components[0] < 1:
        expected = "whole numbers from 1, each larger than the one before"
        raise refuse(
            "The numbers of components are out of order", where="components", expected=expected, got=plan.components
        )
    have = len(identity_part(gnm_npz.read(plan.model)).basis)
    kept = have if plan.model_recipe.identity.shrinkage != 0 else 0
    most = min(have, len(plan.split.training) - 1 + kept)
    if asked and plan.components[-1] > most:
        raise InputError(
            "There are too few subjects for so many components",
            where="components",
            expected=f"at most {most}: {len(plan.split.training)} subjects to build from, {have} in the first model",
            got=plan.components[-1],
            fix="ask for fewer components, or add subjects",
        )
