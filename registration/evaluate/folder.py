"""`gnmreg evaluate`: evaluate a registration folder, and store the metrics if the capture is the one registered."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from registration.capture.native import read_capture
from registration.doctor.scan_frame import require_frames
from registration.evaluate.console_table import print_metrics
from registration.evaluate.evaluation import RegistrationEvaluation, evaluate_registration
from registration.evaluate.verdict import judge
from registration.storage.hashing import hash_capture, hash_fields
from registration.storage.registration_folder import load_registration, update_figures
from registration.types import Capture, Registration


def evaluate_folder(
    registration_dir: Path,
    capture_dir: Path,
    neutral_dir: Path | None = None,
    neutral_capture_dir: Path | None = None,
) -> RegistrationEvaluation:
    """Evaluate a registration folder, print its metrics, and add them to its manifest.

    The manifest is not changed if the capture is another one than that which was registered, or the neutral not that
    which belongs to it; the differences are printed.

    Args:
        registration_dir: the registration folder.
        capture_dir: the folder of its capture, with a scan.
        neutral_dir: registration folder of the subject's neutral, for drift.
        neutral_capture_dir: the folder of the neutral's capture; needed with `neutral_dir`.

    Returns:
        The evaluation.

    Raises:
        InputError: as `evaluate_registration`, a folder cannot be read, or a scan or a ground truth is in another unit
            or frame than the cameras.
    """
    registration, capture = load_registration(registration_dir), read_capture(capture_dir)
    neutral = load_registration(neutral_dir) if neutral_dir else None
    neutral_capture = read_capture(neutral_capture_dir) if neutral_capture_dir else None
    require_frames(capture)
    evaluation = evaluate_registration(registration, capture, neutral=neutral, neutral_capture=neutral_capture)
    foreign = differences(registration, capture, neutral, neutral_capture)
    if not foreign:
        # A figure that was stored before, such as the drift, is kept and so is not missing.
        unmeasured = {k: why for k, why in evaluation.metrics["unmeasured"].items() if k not in registration.figures}
        figures = {**evaluation.metrics, "unmeasured": unmeasured}
        verdict = judge(registration.status, {**registration.figures, **figures}).figure
        update_figures(registration_dir, {**figures, "verdict": verdict})
    print_metrics(evaluation.metrics, title=f"{capture.subject} {capture.expression}: {registration.status}")
    console = Console()
    for line in foreign:
        console.print(f"warning: {escape(line)}", highlight=False, soft_wrap=True)
    if foreign:
        kept = f"nothing was stored: {registration_dir} keeps its figures"
        console.print(escape(kept), highlight=False, soft_wrap=True)
    return evaluation


def differences(
    registration: Registration, capture: Capture, neutral: Registration | None, neutral_capture: Capture | None
) -> list[str]:
    """Say how the inputs of an evaluation differ from those of the registration, one line each; empty if they do not.

    Args:
        registration: with the digests of its inputs.
        capture: that it is compared with.
        neutral: registration that the drift is measured from, if any.
        neutral_capture: its capture.
    """
    lines = []
    shown = registration.figures.get("subject", capture.subject)
    if shown != capture.subject:
        lines.append(f"the registration shows {shown}, the capture {capture.subject}")
    if not is_capture_of(registration, capture):
        lines.append(
            f"{capture.root} is not the capture that was registered, or it has changed: its cameras, images, "
            "landmarks, tags or scan differ"
        )
    if neutral is None or neutral_capture is None:
        return lines
    if not is_capture_of(neutral, neutral_capture):
        lines.append(f"{neutral_capture.root} is not the capture of the neutral registration, or it has changed")
    if neutral_capture.subject != capture.subject:
        lines.append(f"the neutral shows {neutral_capture.subject}, the capture {capture.subject}")
    if (start := registration.inputs.get("neutral")) is not None and start != hash_fields(neutral):
        lines.append("the registration started from another neutral registration than the given one")
    if neutral.inputs.get("model") != registration.inputs.get("model"):
        lines.append("the neutral was registered with another model")
    return lines


def is_capture_of(registration: Registration, capture: Capture) -> bool:
    """Return whether a registration was made from a capture: of its views those that were selected.

    A scan or a ground truth that was added since makes no difference, because the fit does not use them.
    """
    names = registration.config.get("views") or [view.name for view in capture.views]
    views = tuple(view for view in capture.views if view.name in names)
    candidates = [replace(capture, views=views)]
    if capture.scan is not None:
        candidates += [replace(one, scan=None) for one in candidates]
    if capture.ground_truth is not None:
        candidates += [replace(one, ground_truth=None) for one in candidates]
    registered = registration.inputs.get("capture")
    return any(hash_capture(candidate) == registered for candidate in candidates)
