"""What a library process does for submissions: the checks that need the library."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coregister.anatomy.assemble import BUILDERS
from coregister.first_model import build
from coregister.next_model.recipes import MODEL_RECIPES
from coregister.stopping_rule import StoppingRule
from registration.errors import InputError
from registration.model import fetch
from registration.storage.cache import cache_folder
from registration.storage.files import atomic_directory
from workflows.farm.coregistration import submit_coregistration
from workflows.farm.plan import RoundSettings, make_plan
from workflows.farm.subject import subject_run, submit_subject
from workflows.gate.decisions import DecisionLog
from workflows.gate.rules import read_thresholds
from workflows.service.library_process import Conflict
from workflows.service.places import FIRST, OFFICIAL
from workflows.steps.job_options import from_job


def store_cached_model(name: str, folder: str) -> str | None:
    """Copy a model of this machine's cache into a folder, where workers may read it.

    Args:
        name: "first" or "official".
        folder: to create; an existing one is replaced.

    Returns:
        The model's file; None if the cache has none, or there is no such name.
    """
    built = sorted(cache_folder().glob(f"first-*/{build.FILE}"), key=lambda path: path.stat().st_mtime)
    file = {FIRST: next(reversed(built), None), OFFICIAL: next(fetch.installed_files(), None)}.get(name)
    if file is None:
        return None
    beside = [path for path in file.parent.iterdir() if path.name.startswith("head_") and path.is_file()]
    with atomic_directory(Path(folder)) as temporary:
        for path in (file, *beside):
            shutil.copyfile(path, temporary / path.name)
    return str(Path(folder) / file.name)


def submit_one_subject(
    url: str, run: str, places: Mapping[str, str], options: Mapping[str, Any], neutral: str | None
) -> dict[str, Any]:
    """Submit a subject.

    Args:
        url: of the queue.
        run: name of the run.
        places: subject, model and out.
        options: of registrations, as JSON.
        neutral: name of the neutral's folder; None: by its label.

    Returns:
        The number of captures, and those that are left out.

    Raises:
        InputError: the input cannot be used. Conflict: the run cannot be submitted now.
    """
    checked = subject_run(
        Path(places["subject"]),
        model=Path(places["model"]),
        out=Path(places["out"]),
        run=run,
        options=from_job(options),
        neutral=neutral,
    )
    try:
        submit_subject(url, checked)
    except InputError as error:
        raise Conflict(error) from None
    return {"total": len(checked.flow.arguments["captures"]), "left_out": dict(checked.left_out)}


def submit_rounds(
    url: str, run: str, places: Mapping[str, str], options: Mapping[str, Any], rounds: Mapping[str, Any], farm: str
) -> dict[str, Any]:
    """Submit a coregistration.

    Args:
        url: of the queue.
        run: name of the run.
        places: dataset, model and out.
        options: of registrations, as JSON.
        rounds: iterations, all_iterations, model_recipe, held_out, components, anatomy and gate, as of `RoundOptions`.
        farm: its folder, with the decisions and the thresholds of the quality gate.

    Returns:
        The numbers of captures.

    Raises:
        InputError: the input cannot be used. Conflict: the run cannot be submitted now.
    """
    recipe = rounds["model_recipe"]
    if recipe not in MODEL_RECIPES:
        raise InputError(
            "There is no such recipe", where="model_recipe", expected=" or ".join(MODEL_RECIPES), got=recipe
        )
    components: Sequence[int] = rounds["components"]
    settings = RoundSettings(
        model_recipe=recipe,
        held_out=rounds["held_out"],
        components=tuple(components) or None,
        rule=StoppingRule(max_rounds=rounds["iterations"], early_stopping=not rounds["all_iterations"]),
        anatomy=tuple(BUILDERS) if rounds["anatomy"] == "regenerate" else (),
        gate=rounds["gate"],
        gate_thresholds=read_thresholds(None, Path(farm)),
        decisions=DecisionLog.of_farm(Path(farm)).folder,
    )
    plan = make_plan(Path(places["dataset"]), Path(places["model"]), Path(places["out"]), from_job(options), settings)
    try:
        submit_coregistration(url, plan, run=run)
    except InputError as error:
        raise Conflict(error) from None
    return {"total": sum(len(names) for names in plan.captures.values()), "left_out": {}}
