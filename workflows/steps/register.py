"""Steps of the farm beside those of `steps.py`: one capture a call. A worker's child calls them with JSON arguments."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from coregister.stopping_rule import Rule
from registration.capture.native import read
from registration.errors import InputError
from registration.fit.recipes import recipe_named
from registration.model import gnm_npz
from registration.model.landmarks import schemes_beside
from registration.progress import Progress
from registration.register import register
from registration.render.backend import Variant
from registration.storage import hashing
from registration.storage.registration_folder import read_manifest, swap_in
from workflows.engine.jobs import Unusable
from workflows.records.coregistration import FIRST, Plan, State, decided, save
from workflows.records.dataset import Split, read_dataset
from workflows.records.remote import capture_here, model_here
from workflows.records.store import Store
from workflows.records.subject import USABLE
from workflows.records.training_subjects import has_truths
from workflows.steps.subject import begin_subject

REGISTRATION = "registration"  # the folder within an attempt


def register_stored(
    *,
    capture: str,
    model: str,
    store: str,
    key: str,
    recipe: str = "draft",
    views: int | None = None,
    seed: int = 0,
    variant: Variant = "llvm",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Register a capture and publish the folder under `key`. What was made from the same input is returned at once.

    Raises:
        InputError: as `register`, or an input cannot be fetched.
        Unusable: the registration's status is failed; it is published all the same, for whoever looks into it.
    """
    resolved = recipe_named(recipe)
    file = model_here(model)
    data = gnm_npz.read(file)
    schemes = schemes_beside(file, len(data.template_vertex_positions))
    inputs = {f"landmarks {name}": hashing.content_of(one.indices, one.weights) for name, one in schemes.items()}
    inputs["model"] = gnm_npz.content_hash(data)
    with capture_here(capture) as folder:
        inputs["capture"] = hashing.hash_capture(read(folder))
        settings = {"recipe": hashing.plain(resolved), "views": views, "seed": seed, "variant": variant}

        def make(attempt: Path) -> dict[str, Any]:
            result = register(
                folder,
                model_path=file,
                out=attempt / REGISTRATION,
                recipe=recipe,
                views=views,
                seed=seed,
                variant=variant,
                progress=progress,
            )
            scan = result.figures.get("scan_to_mesh", {}).get("face")
            return hashing.plain({"status": result.status, "reason": result.reason, "scan_to_mesh_face": scan})

        made = Store(store).produce(key, wanted=hashing.input_hash(inputs, settings), make=make)
    if made.about.get("status") == "failed":
        raise Unusable(f"registration failed: {made.about.get('reason')}")
    return {**made.brief(), "attempt": made.attempt}


def register_capture(
    *,
    capture: str,
    model: str,
    out: str,
    neutral: str | None = None,
    subject_dir: str | None = None,
    recipe: str = "draft",
    views: int | None = None,
    seed: int = 0,
    variant: Variant = "llvm",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Register one capture of a subject into the folder `out`, from the folder of its neutral's registration.

    With `subject_dir`, the folder of the subject's captures, it is the first of them: the subject's record is begun.

    Raises:
        InputError: as `register`.
        Unusable: the registration's status is failed; its folder is kept.
    """
    if subject_dir is not None:
        begin_subject(Path(subject_dir), model_path=Path(model), out=Path(out).parent, recipe=recipe)
    result = register(
        Path(capture),
        model_path=Path(model),
        out=Path(out),
        recipe=recipe,
        views=views,
        seed=seed,
        neutral=None if neutral is None else Path(neutral),
        variant=variant,
        progress=progress,
    )
    if result.status == "failed":
        raise Unusable(f"registration failed: {result.reason}")
    return {"out": out, "status": result.status, "content_id": read_manifest(Path(out))["content_id"]}


def write_plan(plan: Plan, file: Path) -> None:
    """All that the flow of a coregistration has to know, for coordinators and workers to read."""
    found, data = read_dataset(plan.dataset), gnm_npz.read(plan.model)
    names = (*plan.split.training, *plan.split.held_out)
    bare = [name for name in plan.split.held_out if not has_truths(found.subjects[name], data)]
    captures = {name: [one.root.name for one in found.subjects[name].captures] for name in names}
    told = {**asdict(plan), "captures": captures, "bare": bare}  # of each subject the neutral first
    file.parent.mkdir(parents=True, exist_ok=True)
    swap_in(file, json.dumps(hashing.plain(told), indent=1, allow_nan=False) + "\n")


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
    state = decided(state, rounds[-1]["evaluate"])
    save(state)
    assert state.verdict is not None
    return dict(state.verdict)


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
        views=told["views"],
        seed=told["seed"],
        components=tuple(told["components"]),
        samples=told["samples"],
        rule=Rule(**{name: value for name, value in told["rule"].items() if name != "type"}),
        split=split,
    )
