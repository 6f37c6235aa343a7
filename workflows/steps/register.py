"""The steps that register one capture. A worker's child calls them with JSON arguments."""

from pathlib import Path
from typing import Any

from registration.capture.native import read_capture
from registration.fit.recipes import named_recipe
from registration.inputs import input_hash, read_schemes
from registration.model import gnm_npz
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.progress import Progress
from registration.render.backend import Variant
from registration.storage import hashing
from registration.storage.registration_folder import read_manifest
from workflows.engine.jobs import PermanentStepError
from workflows.records.remote import fetch_capture, fetch_model
from workflows.records.store import Store
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
        PermanentStepError: the registration's status is failed; it is published nevertheless, for inspection.
    """
    options = RegisterOptions(recipe=named_recipe(recipe), views=views, seed=seed, variant=variant)
    file = fetch_model(model)
    data = gnm_npz.read(file)
    schemes = read_schemes(file, data, options.landmark_files)
    with fetch_capture(capture) as folder:
        wanted = input_hash(read_capture(folder), data, schemes, None, options)

        def make(attempt: Path) -> dict[str, Any]:
            result = register(folder, file, attempt / REGISTRATION, options, progress=progress)
            scan = result.figures.get("scan_to_mesh", {}).get("face")
            return hashing.to_jsonable({"status": result.status, "reason": result.reason, "scan_to_mesh_face": scan})

        made = Store(store).produce(key, wanted=wanted, make=make)
    if made.about.get("status") == "failed":
        raise PermanentStepError(f"registration failed: {made.about.get('reason')}")
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
        PermanentStepError: the registration's status is failed; its folder is kept.
    """
    options = RegisterOptions(recipe=named_recipe(recipe), views=views, seed=seed, variant=variant)
    if subject_dir is not None:
        begin_subject(Path(subject_dir), Path(model), Path(out).parent, options)
    start = None if neutral is None else Path(neutral)
    result = register(Path(capture), Path(model), Path(out), options, neutral=start, progress=progress)
    if result.status == "failed":
        raise PermanentStepError(f"registration failed: {result.reason}")
    return {"out": out, "status": result.status, "content_id": read_manifest(Path(out)).content_id}
