"""A coregistration's plan, checked before anything is computed, and its record with the page.

The loop itself, register all, stabilize, build the next model, evaluate it on people held out, decide, is a flow
(`flows.coregister`); what is done in it is in `steps.py`.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from coregister.evaluate.linear_fit import identity_part
from coregister.stopping_rule import Rule
from registration.errors import InputError
from registration.fit.recipes import recipe_named
from registration.model import gnm_npz
from registration.storage.hashing import plain, versions
from registration.storage.registration_folder import refuse_foreign, swap_in
from workflows.pages.coregistration import write_coregistration_page
from workflows.records.dataset import Split, read_dataset, split
from workflows.steps import coregistration

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
    rule: Rule | None = None,
) -> Plan:
    """The plan of rounds over a dataset until the rule says enough, all in the folder `out` (docs/coregistration.md).

    Args:
        dataset: a folder of subject folders, each of capture folders.
        model_path: the first model, with its landmark schemes beside it.
        held_out: as for `dataset.split`.
        components: numbers that models are measured with, the largest decides; None: COMPONENTS, as far as models go.
        samples: random heads of each model, for specificity; 0: none.

    Raises:
        InputError: `read_dataset`, `split` or `check_out` refuses; no such recipe or model; more components than there
            can be. Nothing is computed or written.
    """
    recipe_named(recipe)
    found = read_dataset(dataset)
    plan = Plan(
        dataset=Path(dataset),
        model=Path(model_path),
        out=Path(out),
        recipe=recipe,
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
    verdict = coregistration.decide(first_mm=figures[FIRST][at], rounds=rounds, rule=vars(state.plan.rule))
    done = [{**one, "decide": figure} for one, figure in zip(state.rounds, rounds, strict=True)]
    return replace(
        state,
        rounds=tuple(done),
        generalization_mm=figures,
        specificity_mm=measured["specificity_mm"],
        at=measured["at"],
        verdict=verdict,
    )


def save(state: State) -> None:
    """Write `coregistration.json` and `index.html`, each in one rename."""
    told = plain({"kind": KIND, "schema": SCHEMA, **vars(state), "versions": versions()})
    state.plan.out.mkdir(parents=True, exist_ok=True)
    swap_in(state.plan.out / MANIFEST, json.dumps(told, indent=1, allow_nan=False) + "\n")
    swap_in(state.plan.out / PAGE, write_coregistration_page(told))


def check_out(out: Path) -> None:
    """Refuse, before any work, a folder that is not ours to write into. Raises InputError."""
    refuse_foreign(out, kind=KIND, command="coregister", manifest=MANIFEST)


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
    kept = have if coregistration.builder().identity.previous != 0 else 0
    most = min(have, len(plan.split.training) - 1 + kept)
    if asked and plan.components[-1] > most:
        raise InputError(
            "There are too few subjects for so many components",
            where="components",
            expected=f"at most {most}: {len(plan.split.training)} subjects to build from, {have} in the first model",
            got=plan.components[-1],
            fix="ask for fewer components, or add subjects",
        )
