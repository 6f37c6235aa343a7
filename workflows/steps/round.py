"""The step that ends a round: the stopping rule, the record of the coregistration and its page."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from coregister.next_model.recipes import ModelRecipe
from coregister.stopping_rule import Round, Rule, decide
from registration.progress import Progress
from workflows.pages.coregistration import write_coregistration_page
from workflows.records.coregistration import FIRST, Plan, State, read_plan, write_state
from workflows.records.dataset import Split
from workflows.records.subject import USABLE


def end_round(
    *,
    plan: str,
    people: Mapping[str, Any],
    rounds: Sequence[Mapping[str, Any]],
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the record and the page of a coregistration after a round, and tell whether to go on.

    `rounds`: of each round so far its name and what stabilize, build and evaluate told; the subjects' rows are read
    from their folders.
    """
    told = read_plan(Path(plan))
    state = State(
        plan=_plan(told),
        sources=people["sources"],
        lost=people["lost"],
        models={FIRST: told["model"]},
    )
    for number, one in enumerate(rounds, 1):
        run = Path(told["out"]) / one["name"] / "registrations"
        rows = {name: _rows(run / name) for name in told["split"]["training"]}
        models = {**state.models, f"model {number}": one["build"]["model"]}
        state = replace(state, models=models, rounds=(*state.rounds, {**one, "register": rows}))
    state = apply_verdict(state, rounds[-1]["evaluate"])
    write_state(state, write_coregistration_page)
    assert state.verdict is not None
    return dict(state.verdict)


def apply_verdict(state: State, measured: Mapping[str, Any]) -> State:
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
    verdict = decide(figures[FIRST][at], [Round(**row) for row in rounds], state.plan.rule)
    done = [{**one, "decide": figure} for one, figure in zip(state.rounds, rounds, strict=True)]
    return replace(
        state,
        rounds=tuple(done),
        generalization_mm=figures,
        specificity_mm=measured["specificity_mm"],
        at=measured["at"],
        verdict=vars(verdict),
    )


def _rows(subject: Path) -> dict[str, Any]:
    try:
        rows: list[dict[str, Any]] = json.loads((subject / "subject.json").read_text("utf-8"))["captures"]
    except (OSError, ValueError, KeyError):
        return {"all": {"status": "error", "reason": "its jobs failed", "usable": False}}
    return {
        row["name"]: {"status": row["status"], "reason": row["reason"], "usable": row["status"] in USABLE}
        for row in rows
    }


def _plan(told: Mapping[str, Any]) -> Plan:
    split = Split(
        training=tuple(told["split"]["training"]), held_out=tuple(told["split"]["held_out"]), how=told["split"]["how"]
    )
    return Plan(
        dataset=Path(told["dataset"]),
        model=Path(told["model"]),
        out=Path(told["out"]),
        recipe=told["recipe"],
        model_recipe=ModelRecipe.from_json(told["model_recipe"], where="the plan's model_recipe"),
        views=told["views"],
        seed=told["seed"],
        components=tuple(told["components"]),
        samples=told["samples"],
        rule=Rule(**{name: value for name, value in told["rule"].items() if name != "type"}),
        split=split,
    )
