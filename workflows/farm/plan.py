"""The plan of a coregistration, checked before anything is computed."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from coregister.anatomy.assemble import check_structures
from coregister.anatomy.part_basis import PartName
from coregister.evaluate.linear_fit import identity_part
from coregister.next_model.recipes import DEFAULT_MODEL_RECIPE, ModelRecipe, load_model_recipe
from coregister.next_model.size import check_recipe
from coregister.stopping_rule import StoppingRule
from registration.errors import InputError
from registration.model import gnm_npz
from registration.model.gnm_npz import GNMData
from registration.options import RegisterOptions
from workflows.gate.rules import GateThresholds
from workflows.records.coregistration import CoregistrationPlan, GateSettings, check_out
from workflows.records.dataset import read_dataset, split
from workflows.records.step_results import Policy
from workflows.records.training_subjects import has_truths
from workflows.steps.job_options import to_job

COMPONENTS = (5, 10, 20, 40)  # numbers of components that models are evaluated with by default


@dataclass(frozen=True, kw_only=True)
class RoundSettings:
    """What is done in each round besides registration, and when to stop.

    Attributes:
        model_recipe: settings of model building, as for `load_model_recipe`.
        held_out: as for `dataset.split`.
        components: numbers of components that models are evaluated with; the stopping rule uses the largest. None:
            COMPONENTS, as far as models have them.
        samples: random heads of each model, for specificity; 0: none.
        rule: when to stop.
        anatomy: parts that the first round regenerates in its model, as `coregister.anatomy.assemble` does.
        gate: whether models are built from registrations that are for a person before the person has decided.
        gate_thresholds: of the gate's rules.
        decisions: folder of the log of decisions; None: there are none.
    """

    model_recipe: str | ModelRecipe = DEFAULT_MODEL_RECIPE
    held_out: float | Path | None = None
    components: Sequence[int] | None = None
    samples: int = 200
    rule: StoppingRule = field(default_factory=StoppingRule)
    anatomy: tuple[PartName, ...] = ()
    gate: Policy = "auto"
    gate_thresholds: GateThresholds = field(default_factory=GateThresholds)
    decisions: Path | None = None


def make_plan(
    dataset: Path,
    model: Path,
    out: Path,
    options: RegisterOptions = RegisterOptions(),  # noqa: B008  frozen
    rounds: RoundSettings = RoundSettings(),  # noqa: B008  frozen
) -> CoregistrationPlan:
    """Plan rounds of registration and model building over a dataset (docs/coregistration.md).

    Args:
        dataset: a folder of subject folders with capture folders.
        model: file of the first model, with its landmark schemes next to it.
        out: folder of all results.
        options: of all registrations; the seed is that of everything random.
        rounds: model building, evaluation and the stopping rule.

    Raises:
        InputError: `read_dataset`, `split`, `check_recipe` or `check_out` refuses; there is no such recipe or model;
            more components than there can be; the model lacks the structure of a part to regenerate. Nothing is
            computed or written.
    """
    options = to_job(options)
    source = read_dataset(dataset)
    division = split(source, rounds.held_out, options.seed)
    data = gnm_npz.read(Path(model))
    check_structures(data, rounds.anatomy)
    names = (*division.training, *division.held_out)
    plan = CoregistrationPlan(
        dataset=Path(dataset).resolve(),
        model=Path(model).resolve(),
        out=Path(out).resolve(),
        options=options,
        model_recipe=load_model_recipe(rounds.model_recipe),
        components=tuple(rounds.components or COMPONENTS),
        samples=rounds.samples,
        rule=rounds.rule,
        split=division,
        captures={name: tuple(capture.root.name for capture in source.subjects[name].captures) for name in names},
        without_truth=tuple(name for name in division.held_out if not has_truths(source.subjects[name], data)),
        anatomy=rounds.anatomy,
        gate=GateSettings(
            policy=rounds.gate,
            thresholds=rounds.gate_thresholds.to_json(),
            decisions=None if rounds.decisions is None else Path(rounds.decisions).resolve(),
        ),
    )
    _check(plan, data, requested=rounds.components is not None)
    check_out(plan.out)
    return plan


def _check(plan: CoregistrationPlan, data: GNMData, requested: bool) -> None:
    """Refuse what a later step would refuse."""
    if plan.rule.max_rounds < 1:
        raise InputError("There is no round", where="iterations", expected="at least 1", got=plan.rule.max_rounds)
    if list(plan.components) != sorted(set(plan.components)) or plan.components[0] < 1:
        raise InputError(
            "The numbers of components are out of order",
            where="components",
            expected="whole numbers from 1 in increasing order",
            got=plan.components,
        )
    captures = [len(plan.captures[name]) for name in plan.split.training]
    check_recipe(len(captures), sum(captures) - len(captures), data, plan.model_recipe)
    available = len(identity_part(data).basis)
    kept = available if plan.model_recipe.identity.shrinkage != 0 else 0
    limit = min(available, len(plan.split.training) - 1 + kept)
    if requested and plan.components[-1] > limit:
        subjects = len(plan.split.training)
        raise InputError(
            "There are too few subjects for so many components",
            where="components",
            expected=f"at most {limit}: {subjects} training subjects, {available} components in the first model",
            got=plan.components[-1],
            fix="request fewer components, or add subjects",
        )
