"""A job of the farm repeated in the foreground, with its inputs downloaded and an image of every stage."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from registration.errors import InputError
from registration.progress import Progress
from workflows.engine.child import function_of
from workflows.engine.jobs import validate_arguments
from workflows.engine.reader import JobRow
from workflows.ids import is_remote
from workflows.records.remote import fetch_capture, fetch_folder, fetch_model
from workflows.steps.job_options import from_job
from workflows.steps.register import REGISTRATION
from workflows.steps.table import REGISTER, REGISTER_STORED, STEPS

if TYPE_CHECKING:
    from workflows.web.fit_page import FitPage

IMAGES = "stages"
INPUTS = "inputs"


def debug(row: JobRow, out: Path, progress: Progress, *, port: int | None = None) -> "DebugResult":
    """Execute a job's step in this process, with its results below `out`.

    Registrations write an image and the mesh of the fit at its start and after each stage into `out/stages`, and their
    folder to `out/registration`; a capture from a URL is kept in `out/inputs`.

    Args:
        row: the job.
        out: a new or empty folder.
        progress: where to report to.
        port: of a page that shows the fit until it is closed; None: no page.

    Raises:
        InputError: the row is a flow, `out` is not empty, a page is requested for another step than a registration,
            or an error of the step itself.
    """
    if row.kind != "job":
        raise _input_error(row.id, expected="a job", got="a flow: see its jobs with `gnmreg status`")
    if out.exists() and any(out.iterdir()):
        raise _input_error(str(out), expected="a new or empty folder", got="one with files in it")
    _, arguments = validate_arguments(row.spec, STEPS, roots=("/", "s3:/"))  # the operator chose it: any path will do
    name = row.spec["step"]
    if name in (REGISTER, REGISTER_STORED):
        return _register(arguments, out, progress, port)
    if port is not None:
        raise _input_error(row.id, expected="a registration", got=f"the step {name!r}, which --view cannot show")
    step = STEPS[name]
    if "out" not in step.path_arguments:
        raise _input_error(row.id, expected="a step with a product of its own", got=f"{name!r}, which writes elsewhere")
    changed = {"out": str(out / "product")}
    return DebugResult(summary=str(function_of(step.function)(**{**arguments, **changed}, progress=progress)))


@dataclass(frozen=True, kw_only=True)
class DebugResult:
    """The step's result, and the page if there is one."""

    summary: str  # the result as text
    page: "FitPage | None" = None


def _register(arguments: Mapping[str, Any], out: Path, progress: Progress, port: int | None) -> DebugResult:
    from registration.pipeline import register

    location = str(arguments["capture"])
    if is_remote(location):
        copy = out / INPUTS / PurePosixPath(location).name
        progress.message(f"downloading {location}")
        fetch_folder(location, copy)
        location = str(copy)
    neutral = arguments.get("neutral")
    with ExitStack() as on_failure, fetch_capture(location) as capture:
        model = fetch_model(str(arguments["model"]))
        page = None if port is None else _page(out / IMAGES, capture, model, port, progress)
        if page is not None:
            on_failure.callback(page.close)
        result = register(
            capture,
            model,
            out / REGISTRATION,
            from_job(arguments.get("options")),
            neutral=None if neutral is None else Path(neutral),
            pictures=out / IMAGES,
            progress=progress,
        )
        on_failure.pop_all()  # the page stays open
    return DebugResult(summary=f"{result.status}: {result.reason}", page=page)


def _page(stages: Path, capture: Path, model: Path, port: int, progress: Progress) -> "FitPage":
    from registration.capture.native import read_capture
    from registration.model import gnm_npz, regions
    from workflows.web.fit_page import FitPage

    page = FitPage(stages, read_capture(capture), regions.exterior(gnm_npz.read(model)), port)
    progress.message(f"open {page.url} in a browser")
    return page


def _input_error(where: str, *, expected: str, got: str) -> InputError:
    return InputError(
        "The job cannot be debugged", where=where, expected=expected, got=got, fix="choose another job or folder"
    )
