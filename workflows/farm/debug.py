"""A job of the farm once more, in the foreground: its inputs fetched, every stage drawn."""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from registration.errors import InputError
from registration.progress import Progress
from workflows.engine.child import function_of
from workflows.engine.jobs import validate_arguments
from workflows.engine.reader import JobRow
from workflows.records.remote import fetch_capture, fetch_folder, fetch_model, is_remote, local_path
from workflows.steps.job_options import from_job
from workflows.steps.register import REGISTRATION
from workflows.steps.table import REGISTER, REGISTER_STORED, STEPS

if TYPE_CHECKING:
    from workflows.web.fit_page import FitPage

PICTURES = "stages"
INPUTS = "inputs"


def debug(row: JobRow, out: Path, progress: Progress, *, port: int | None = None) -> "Debugged":
    """Run a job's step again here, with its results below `out` instead of where they belong.

    Registrations leave a picture and the mesh of the fit at its start and after each stage in `out/stages`, and their
    folder in `out/registration`; a capture from a URL is kept in `out/inputs`. With `port`, a page shows the fit there
    while it runs, and until it is closed.

    Raises:
        InputError: no job but a flow, `out` holds something, a page of what is no registration, or whatever the step
            itself refuses.
    """
    if row.kind != "job":
        raise _wrong(row.id, expected="a job", got="a flow: see its jobs with `gnmreg status`")
    if out.exists() and any(out.iterdir()):
        raise _wrong(str(out), expected="a new or empty folder", got="one that holds something")
    validate_arguments(row.spec, STEPS, roots=("/", "s3:/"))  # the operator chose it: any path will do
    name, arguments = row.spec["step"], row.spec["arguments"]
    if name in (REGISTER, REGISTER_STORED):
        return _register(arguments, out, progress, port)
    if port is not None:
        raise _wrong(row.id, expected="a registration, to be viewed", got=f"the step {name!r}: leave out --view")
    step = STEPS[name]
    changed = {"out": str(out / "product")} if "out" in step.path_arguments else {}
    return Debugged(told=str(function_of(step.function)(**{**arguments, **changed}, progress=progress)))


@dataclass(frozen=True, kw_only=True)
class Debugged:
    """What came of it, and the page if there is one."""

    told: str
    page: "FitPage | None" = None


def _register(arguments: Mapping[str, Any], out: Path, progress: Progress, port: int | None) -> Debugged:
    from registration.pipeline import register

    place = str(arguments["capture"])
    if is_remote(place):
        progress.note(f"fetching {place}")
        fetch_folder(place, out / INPUTS / local_path(place).name)
        place = str(out / INPUTS / local_path(place).name)
    neutral = arguments.get("neutral")
    with ExitStack() as until_done, fetch_capture(place) as capture:
        model = fetch_model(str(arguments["model"]))
        page = None if port is None else _page(out / PICTURES, capture, model, port, progress)
        if page is not None:
            until_done.callback(page.close)
        result = register(
            capture,
            model,
            out / REGISTRATION,
            from_job(arguments.get("options")),
            neutral=None if neutral is None else Path(neutral),
            pictures=out / PICTURES,
            progress=progress,
        )
        until_done.pop_all()  # the page stays
    return Debugged(told=f"{result.status}: {result.reason}", page=page)


def _page(stages: Path, capture: Path, model: Path, port: int, progress: Progress) -> "FitPage":
    from registration.capture.native import read_capture
    from registration.model import gnm_npz, regions
    from workflows.web.fit_page import FitPage

    page = FitPage(stages, read_capture(capture), regions.exterior(gnm_npz.read(model)), port)
    progress.note(f"open {page.url} in a browser")
    return page


def _wrong(where: str, *, expected: str, got: str) -> InputError:
    return InputError("This cannot be debugged", where=where, expected=expected, got=got, fix="choose another")
