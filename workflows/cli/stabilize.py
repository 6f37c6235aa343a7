"""`gnmreg stabilize` and `stabilize review`."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from workflows.cli.options import OptionalFile, OptionalModel, Port

RunFolder = Positional[Annotated[Path, arg(metavar="RUN")]]
StabilizedFolder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: RUN/stabilized)")]


def stabilize(
    run: RunFolder,
    /,
    decisions: OptionalFile = None,
    model: OptionalModel = None,
    out: StabilizedFolder = None,
    skip_failed: bool = False,
    force: bool = False,
) -> int:
    """Remove head motion from expressions, so that the skull stays fixed.

    Each expression is aligned by itself first, then all subjects' expressions are corrected together.

    Args:
        run: A folder of subject folders that `gnmreg subject` wrote, or one such folder.
        decisions: A log that `gnmreg stabilize review` saved; without one, all flagged components are subtracted.
        model: The head model of the registrations; not needed if it is the first or the official one.
        out: The folder to write.
        skip_failed: Exclude failed registrations.
        force: Stabilize again although the folder holds the result of the same input.
    """
    from registration.progress import console_progress
    from workflows.records.run import Selection, known_model
    from workflows.steps.stabilize import stabilize_run

    with console_progress() as progress:
        outcome = stabilize_run(
            run,
            model_path=model or known_model(run),
            out=out,
            decisions=decisions,
            selection=Selection(skip_failed=skip_failed),
            reuse="none" if force else "same inputs",
            progress=progress,
        )
    figures = outcome.figures
    print(
        f"{figures['samples']} expressions; {figures['residual_median_mm']:.2f} mm median residual of the cranial skin"
    )
    print(f"correction of the second stage: rotation {figures['regional_turn_deg']:.2f} degrees,", end=" ")
    print(f"displacement {figures['regional_rms_mm']:.2f} mm rms")
    print(outcome.out / "index.html")
    return 0


def review(
    run: RunFolder,
    /,
    decisions: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: RUN/decisions.jsonl)")] = None,
    model: OptionalModel = None,
    out: StabilizedFolder = None,
    skip_failed: bool = False,
    port: Port = 8080,
) -> int:
    """Review the components of a stabilized run in the browser.

    The run is stabilized first where necessary. Ctrl-C stops the server.

    Args:
        run: A folder of subject folders that `gnmreg subject` wrote, or one such folder.
        decisions: The log of decisions; an existing one is resumed.
        model: The head model of the registrations; not needed if it is the first or the official one.
        out: The folder of the stabilized set.
        skip_failed: Exclude failed registrations.
        port: Port on this machine's loopback interface; from elsewhere: ssh -L PORT:127.0.0.1:PORT HOST.
    """
    from registration.progress import console_progress
    from workflows.records.run import known_model
    from workflows.web.review import review

    with console_progress() as progress:
        page = review(
            run,
            model_path=model or known_model(run),
            out=out,
            decisions=decisions,
            skip_failed=skip_failed,
            port=port,
            progress=progress,
        )
    print(f"Open {page.url} in a browser; stop with Ctrl-C.", flush=True)
    page.wait()
    return 0
