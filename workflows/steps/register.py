"""The steps that register one capture. A worker's child calls them with JSON arguments."""

import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from registration.capture.native import read_capture
from registration.inputs import input_hash, read_schemes, used_cranium
from registration.model import gnm_npz
from registration.pipeline import register
from registration.progress import NullProgress, Progress
from registration.report.pictures import jpeg
from registration.storage import hashing
from registration.storage.registration_folder import read_manifest
from registration.types import Registration
from workflows.engine.jobs import PermanentStepError
from workflows.pages.thumbnail import thumbnail
from workflows.records.headline import brief
from workflows.records.remote import fetch_capture, fetch_model
from workflows.records.store import Store
from workflows.steps.coregistration_page import shown_on_page
from workflows.steps.job_options import from_job
from workflows.steps.subject import start_subject

REGISTRATION = "registration"  # the folder within an attempt
REPORT, THUMBNAIL = f"{REGISTRATION}/report.html", "thumbnail.jpg"  # within an attempt


def register_stored(
    *,
    capture: str,
    model: str,
    store: str,
    key: str,
    options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Register a capture and publish the folder in a store; an artifact of the same inputs is returned at once.

    Args:
        capture: folder or URL.
        model: file or URL, with its landmark schemes next to it.
        store: folder or URL of the store.
        key: of the artifact in the store.
        options: a `RegisterOptions` as JSON.
        progress: where to report to.

    Returns:
        The artifact's key, content id, status and attempt, and whether this call made it.

    Raises:
        InputError: as `register`, or an input cannot be fetched.
        PermanentStepError: the registration's status is failed; it is published nevertheless, for inspection.
    """
    chosen = from_job(options)
    file = fetch_model(model)
    data = gnm_npz.read(file)
    schemes = read_schemes(file, data, chosen.landmark_files)
    cranium = used_cranium(file, data, chosen)
    made = False
    with fetch_capture(capture) as folder:
        digest = input_hash(read_capture(folder), data, schemes, None, chosen, cranium)

        def make(attempt: Path) -> dict[str, Any]:
            nonlocal made
            made = True
            result = register(folder, file, attempt / REGISTRATION, chosen, progress=progress)
            about = {
                "status": result.status,
                "reason": result.reason,
                "figures": brief(result.figures),
                "seconds": sum(result.seconds.values()),
                "stages": dict(result.seconds),
                "thumbnail": _write_thumbnail(result, attempt / THUMBNAIL, progress or NullProgress()),
            }
            return hashing.to_jsonable(about)

        artifact = Store(store).produce(key, input_hash=digest, make=make)
    if artifact.about.get("status") == "failed":
        raise PermanentStepError(f"registration failed: {artifact.about.get('reason')}")
    return {**artifact.brief(), "attempt": artifact.attempt, "made": made}


def _write_thumbnail(result: Registration, file: Path, progress: Progress) -> bool:
    """Write a picture of the head, and return whether there is one: a failure must not cost the registration."""
    try:
        image = thumbnail(result)
        if image is None:
            return False
        file.write_bytes(jpeg(image))
    except Exception:
        progress.message(traceback.format_exc())
        return False
    return True


@shown_on_page(often=True)
def register_capture(
    *,
    capture: str,
    model: str,
    out: str,
    neutral: str | None = None,
    subject_dir: str | None = None,
    options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Register one capture of a subject into the folder `out`.

    Args:
        capture: its folder.
        model: file of the model.
        out: folder of the registration.
        neutral: folder of the neutral's registration; None: this capture is the neutral.
        subject_dir: folder of the subject's captures: the subject's record is created first. For the neutral.
        options: a `RegisterOptions` as JSON.
        progress: where to report to.

    Returns:
        The registration's folder, status and content id.

    Raises:
        InputError: as `register`.
        PermanentStepError: the registration's status is failed; its folder is kept.
    """
    chosen = from_job(options)
    if subject_dir is not None:
        start_subject(Path(subject_dir), Path(model), Path(out).parent, chosen)
    start = None if neutral is None else Path(neutral)
    result = register(Path(capture), Path(model), Path(out), chosen, neutral=start, progress=progress)
    if result.status == "failed":
        raise PermanentStepError(f"registration failed: {result.reason}")
    return {"out": out, "status": result.status, "content_id": read_manifest(Path(out)).content_id}
