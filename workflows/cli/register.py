"""`gnmreg register`, `subject` and `evaluate`: registrations and their evaluation."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from registration.options import RegisterOptions
from workflows.cli.options import Folder, ModelFile, OptionalCapture, OptionalRegistration
from workflows.cli.scan_options import ScanOptions

_DEFAULTS, _NO_SCAN = RegisterOptions(), ScanOptions()


def register(
    capture: Positional[Annotated[Path | None, arg(metavar="[CAPTURE]", help_behavior_hint="")]] = None,
    /,
    *,
    model: ModelFile,
    out: Folder,
    neutral: OptionalRegistration = None,
    force: bool = False,
    scan: ScanOptions = _NO_SCAN,
    fit: RegisterOptions = _DEFAULTS,
) -> int:
    """Fit the head model to one capture, or to a scan, and write the registered mesh.

    Args:
        capture: The capture folder; none with --scan.
        model: The head model, a GNM NPZ file.
        out: The registration folder to write; one that gnmreg wrote before is replaced.
        neutral: Start from this registration of the same subject's neutral and keep its identity.
        force: Register again although the folder holds the result of the same input.
        scan: A scan without photographs instead of a capture.
        fit: How the capture is registered.
    """
    from registration.evaluate.console_table import print_assessment
    from registration.pipeline import register
    from registration.progress import console_progress

    scan.check(capture)
    with console_progress() as progress:
        if capture is None:
            capture, fit = scan.capture(model, out, fit, progress)
        result = register(capture, model, out, fit, neutral=neutral, force=force, progress=progress)
    print_assessment(result.figures)
    for warning in result.figures.get("cameras", {}).get("warnings", []):
        print(f"warning: {warning}")
    print(f"{result.status}: {result.reason}\n{out}")
    return 1 if result.status == "failed" else 0


def subject(
    subject: Positional[Annotated[Path, arg(metavar="SUBJECT")]],
    /,
    model: ModelFile,
    out: Folder,
    neutral: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint='(default: the one labelled "neutral")')
    ] = None,
    force: bool = False,
    fit: RegisterOptions = _DEFAULTS,
) -> int:
    """Register all captures of a subject: the neutral, then the expressions.

    Every expression starts from the neutral's registration. Run again, the command resumes.

    Args:
        subject: The folder whose sub-folders are the captures.
        model: The head model, a GNM NPZ file.
        out: The folder to write: a registration for each capture, subject.json and index.html.
        neutral: The neutral's sub-folder.
        force: Register again although the folder holds the results of the same input.
        fit: How the captures are registered.
    """
    from registration.progress import console_progress
    from workflows.steps.subject import register_subject

    with console_progress() as progress:
        result = register_subject(subject, model, out, fit, neutral=neutral, force=force, progress=progress)
    for row in result.rows:
        print(f"{row.name}: {row.status}: {row.reason}")
    print(out / "index.html")
    usable = sum(row.usable for row in result.rows)
    return 0 if usable == len(result.rows) else 1 if usable else 2


def evaluate(
    registration: Positional[Annotated[Path, arg(metavar="REG")]],
    /,
    capture: Annotated[Path, arg(metavar="CAPTURE")],
    neutral: OptionalRegistration = None,
    neutral_capture: OptionalCapture = None,
) -> int:
    """Compare a registration with its capture's scan and ground truth.

    The metrics are printed, and stored with the registration if the capture is the one that was registered.

    Args:
        registration: The registration folder.
        capture: The capture that it registers.
        neutral: The same subject's neutral registration: adds the surface's drift against it.
        neutral_capture: The capture of that neutral registration.
    """
    from registration.evaluate.folder import evaluate_folder
    from registration.report.summary import refresh_report

    evaluate_folder(registration, capture, neutral, neutral_capture)
    refresh_report(registration)
    return 0
