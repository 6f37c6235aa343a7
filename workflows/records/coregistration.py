"""The record of a coregistration, `coregistration.json`, and its plan, `plan.json`, for coordinators and workers."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from coregister.next_model.recipes import ModelRecipe
from coregister.stopping_rule import Rule
from registration.errors import InputError
from registration.model import gnm_npz
from registration.storage.files import atomic_write_text, refuse_foreign
from registration.storage.hashing import to_jsonable, versions
from workflows.records.dataset import Split, read_dataset
from workflows.records.training_subjects import has_truths

SCHEMA = 1
KIND = "gnm-coregistration"
MANIFEST, PAGE = "coregistration.json", "index.html"
FIRST = "model 0"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """All that is known before the first step, checked."""

    dataset: Path
    model: Path
    out: Path
    recipe: str
    model_recipe: ModelRecipe
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


def write_state(state: State, page: Callable[[Mapping[str, Any]], str]) -> None:
    """Write `coregistration.json` and `index.html`, which `page` makes from its entries, each in one rename."""
    told = to_jsonable({"kind": KIND, "schema": SCHEMA, **vars(state), "versions": versions()})
    state.plan.out.mkdir(parents=True, exist_ok=True)
    atomic_write_text(state.plan.out / MANIFEST, json.dumps(told, indent=1, allow_nan=False) + "\n")
    atomic_write_text(state.plan.out / PAGE, page(told))


def check_out(out: Path) -> None:
    """Refuse, before any work, a folder that is not ours to write into. Raises InputError."""
    refuse_foreign(out, kind=KIND, command="coregister", manifest=MANIFEST)


def write_plan(plan: Plan, file: Path) -> None:
    """All that the flow of a coregistration has to know, for coordinators and workers to read."""
    found, data = read_dataset(plan.dataset), gnm_npz.read(plan.model)
    names = (*plan.split.training, *plan.split.held_out)
    bare = [name for name in plan.split.held_out if not has_truths(found.subjects[name], data)]
    captures = {name: [one.root.name for one in found.subjects[name].captures] for name in names}
    told = {**asdict(plan), "captures": captures, "bare": bare}  # of each subject the neutral first
    file.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_text(file, json.dumps(to_jsonable(told), indent=1, allow_nan=False) + "\n")


def read_plan(file: Path) -> dict[str, Any]:
    """What `write_plan` wrote. Raises InputError if it cannot be read."""
    try:
        told: dict[str, Any] = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            "The plan of a coregistration cannot be read",
            where=file,
            expected="the file that `gnmreg coregister` wrote",
            got=error,
            fix="run `gnmreg coregister` again",
        ) from None
    return told
