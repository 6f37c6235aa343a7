"""The coregistration loop: register all, stabilize, build the next model, evaluate it on people held out, decide.

Only order and iteration live here; what is done is in `steps.py`.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from coregister.decide import Rule
from coregister.generalization import identity_part
from registration.artifacts import refuse_foreign, swap_in
from registration.errors import InputError
from registration.hashes import plain, versions
from registration.model import gnm_npz
from registration.progress import Named, Progress, Silent
from workflows import steps
from workflows.children import Lost, in_children
from workflows.coregistration_page import write_coregistration_page
from workflows.dataset import Dataset, Split, read_dataset, split
from workflows.local import check_recipe
from workflows.model_subjects import has_truths

SCHEMA = 1
KIND = "gnm-coregistration"
MANIFEST, PAGE = "coregistration.json", "index.html"
COMPONENTS = (5, 10, 20, 40)  # that models are measured with, unless others are asked for
FIRST = "model 0"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All that is known before the first step, checked."""

    dataset: Path
    model: Path
    out: Path
    recipe: str
    views: int | None
    seed: int
    jobs: int
    components: tuple[int, ...]
    samples: int
    rule: Rule
    split: Split


@dataclass(frozen=True, kw_only=True)
class State:
    """What there is so far: `coregistration.json`."""

    plan: Plan
    sources: Mapping[str, str] = field(default_factory=dict)  # held-out subject -> what it is measured on
    lost: Sequence[str] = ()  # held-out subjects that have nothing to be measured on
    models: Mapping[str, str] = field(default_factory=dict)  # name -> file
    rounds: Sequence[Mapping[str, Any]] = ()  # what each step of a round told
    generalization_mm: Mapping[str, Any] = field(default_factory=dict)  # model -> components -> mm
    specificity_mm: Mapping[str, Any] = field(default_factory=dict)
    at: int = 0  # the number of components that decides
    verdict: Mapping[str, Any] | None = None


def coregister(
    dataset: Path,
    *,
    model_path: Path,
    out: Path,
    recipe: str = "draft",
    held_out: float | Path | None = None,
    seed: int = 0,
    views: int | None = None,
    components: Sequence[int] | None = None,
    samples: int = 200,
    jobs: int = 1,
    rule: Rule | None = None,
    progress: Progress | None = None,
) -> State:
    """Go round over a dataset until the rule says enough, and write the folder `out` (docs/coregistration.md).

    Called again it goes on where it was interrupted: what was made from the same inputs is not made anew.

    Args:
        dataset: a folder of subject folders, each of capture folders.
        model_path: the first model, with its landmark schemes beside it.
        held_out: as for `dataset.split`.
        components: numbers that models are measured with, the largest decides; None: COMPONENTS, as far as models go.
        samples: random heads of each model, for specificity; 0: none.
        jobs: subjects that are registered side by side.

    Raises:
        InputError: `read_dataset`, `split` or `check_out` refuses; no such recipe or model; more components than there
            can be. Nothing is computed or written then. Later: too few registrations are left to build a model from.
    """
    plan = planned(
        dataset,
        model_path=model_path,
        out=out,
        recipe=recipe,
        held_out=held_out,
        seed=seed,
        views=views,
        components=components,
        samples=samples,
        jobs=jobs,
        rule=rule,
    )
    return _loop(plan, read_dataset(plan.dataset), progress or Silent())


def planned(
    dataset: Path,
    *,
    model_path: Path,
    out: Path,
    recipe: str = "draft",
    held_out: float | Path | None = None,
    seed: int = 0,
    views: int | None = None,
    components: Sequence[int] | None = None,
    samples: int = 200,
    jobs: int = 1,
    rule: Rule | None = None,
) -> Plan:
    """All that `coregister` checks before it computes or writes anything. Raises InputError as it does."""
    check_recipe(recipe)
    found = read_dataset(dataset)
    plan = Plan(
        dataset=Path(dataset),
        model=Path(model_path),
        out=Path(out),
        recipe=recipe,
        views=views,
        seed=seed,
        jobs=jobs,
        components=tuple(components or COMPONENTS),
        samples=samples,
        rule=rule or Rule(),
        split=split(found, held_out, seed),
    )
    _check(plan, asked=components is not None)
    check_out(plan.out)
    return plan


def _loop(plan: Plan, found: Dataset, progress: Progress) -> State:
    """Straight down, once a round."""
    state = State(plan=plan, models={FIRST: str(plan.model)})
    save(state)
    people = _hold_out(plan, found, progress)
    state = replace(state, sources=people["sources"], lost=people["lost"])
    model = str(plan.model)
    for number in range(plan.rule.rounds):
        name = f"it{number:02d}"
        told, place = Named(progress, name), plan.out / name
        run, steady = str(place / "registrations"), str(place / "registrations" / "stabilized")
        names = list(plan.split.training)
        registered = _register(plan, names, run, model, told)
        save(state, {"name": name, "register": registered})
        still = steps.stabilize(run=run, names=names, model=model, out=steady, progress=told)
        save(state, {"name": name, "register": registered, "stabilize": still})
        built = steps.build(
            run=run,
            names=names,
            steady=still["out"],
            dataset=str(plan.dataset),
            previous=model,
            out=str(place / "model"),
            progress=told,
        )
        model = built["model"]
        state = replace(state, models={**state.models, f"model {number + 1}": model})
        measured = steps.evaluate(
            models=state.models,
            people=people["people"],
            out=str(place / "evaluation"),
            components=plan.components,
            samples=plan.samples,
            seed=plan.seed,
            progress=told,
        )
        done = {"name": name, "register": registered, "stabilize": still, "build": built, "evaluate": measured}
        state = decided(replace(state, rounds=(*state.rounds, done)), measured)
        save(state)
        assert state.verdict is not None
        told.note(str(state.verdict["reason"]))
        if not state.verdict["go_on"]:
            break
    return state


def decided(state: State, measured: Mapping[str, Any]) -> State:
    """The state with the figures of all models, measured alike, and the verdict."""
    at, figures = str(measured["at"]), measured["generalization_mm"]
    rounds = []
    for number, one in enumerate(state.rounds, 1):
        failed = sum(not row["usable"] for rows in one["register"].values() for row in rows.values())
        rounds.append(
            {
                "generalization_mm": figures[f"model {number}"][at],
                "drift_mm": one["build"]["drift_mm"],
                "registered": one["build"]["registered"],
                "failed": failed + len(one["build"]["rejected"]),
            }
        )
    verdict = steps.decide(first_mm=figures[FIRST][at], rounds=rounds, rule=vars(state.plan.rule))
    done = [{**one, "decide": figure} for one, figure in zip(state.rounds, rounds, strict=True)]
    return replace(
        state,
        rounds=tuple(done),
        generalization_mm=figures,
        specificity_mm=measured["specificity_mm"],
        at=measured["at"],
        verdict=verdict,
    )


def _hold_out(plan: Plan, found: Dataset, progress: Progress) -> dict[str, Any]:
    """What models are measured on; who has no truth is registered, once and for all rounds, with the first model."""
    data, told = gnm_npz.read(plan.model), Named(progress, "held out")
    bare = [name for name in plan.split.held_out if not has_truths(found.subjects[name], data)]
    run = str(plan.out / "held_out" / "registrations")
    if bare:
        _register(plan, bare, run, str(plan.model), told)
    return steps.hold_out(
        dataset=str(plan.dataset),
        names=list(plan.split.held_out),
        registrations=run,
        model=str(plan.model),
        out=str(plan.out / "held_out"),
        progress=told,
    )


def _register(
    plan: Plan, names: Sequence[str], run: str, model: str, progress: Progress
) -> dict[str, dict[str, dict[str, Any]]]:
    """All subjects; subject -> capture -> what became of it. Whatever happens to one, the others are registered."""
    settings = {"model": model, "recipe": plan.recipe, "views": plan.views, "seed": plan.seed}
    calls = {
        name: {"subject_dir": str(plan.dataset / name), "out": str(Path(run) / name), **settings} for name in names
    }
    rows: dict[str, dict[str, dict[str, Any]]] = {}
    for name, told in in_children(steps.register_subject, calls, jobs=plan.jobs, tries=5, progress=progress):
        lost = isinstance(told, Lost)
        rows[name] = {"all": {"status": "error", "reason": told.reason, "usable": False}} if lost else told["rows"]
        usable = sum(row["usable"] for row in rows[name].values())
        progress.at(len(rows), len(names), f"{name}: {usable} of {len(rows[name])} registered")
    return {name: rows[name] for name in names}


def save(state: State, open_round: Mapping[str, Any] | None = None) -> None:
    """Write `coregistration.json` and `index.html`, each in one rename; `open_round`: of a round that goes on."""
    rounds = [*state.rounds, *([open_round] if open_round else [])]
    body = {name: value for name, value in vars(state).items() if name != "rounds"}
    told = plain({"kind": KIND, "schema": SCHEMA, **body, "rounds": rounds, "versions": versions()})
    state.plan.out.mkdir(parents=True, exist_ok=True)
    swap_in(state.plan.out / MANIFEST, json.dumps(told, indent=1, allow_nan=False) + "\n")
    swap_in(state.plan.out / PAGE, write_coregistration_page(told))


def check_out(out: Path) -> None:
    """Refuse, before any work, a folder that is not ours to write into. Raises InputError."""
    refuse_foreign(out, kind=KIND, command="coregister", manifest=MANIFEST)


def _check(plan: Plan, asked: bool) -> None:
    """Everything that a later step would refuse and that is known now."""
    refuse: Callable[..., InputError] = partial(InputError, fix="change it")
    if plan.jobs < 1:
        raise refuse("The number of jobs is out of range", where="jobs", expected="from 1", got=plan.jobs)
    if plan.rule.rounds < 1:
        raise refuse("There is no round to go", where="iterations", expected="from 1", got=plan.rule.rounds)
    if list(plan.components) != sorted(set(plan.components)) or plan.components[0] < 1:
        expected = "whole numbers from 1, each larger than the one before"
        raise refuse(
            "The numbers of components are out of order", where="components", expected=expected, got=plan.components
        )
    have = len(identity_part(gnm_npz.read(plan.model)).basis)
    kept = have if steps.builder().identity.previous != 0 else 0
    most = min(have, len(plan.split.training) - 1 + kept)
    if asked and plan.components[-1] > most:
        raise InputError(
            "There are too few subjects for so many components",
            where="components",
            expected=f"at most {most}: {len(plan.split.training)} subjects to build from, {have} in the first model",
            got=plan.components[-1],
            fix="ask for fewer components, or add subjects",
        )
