"""A job of the farm once more, in the foreground: its inputs fetched, every stage drawn."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.progress import Progress
from workflows.engine.reads import Row
from workflows.farm_steps import REGISTRATION
from workflows.jobs import STEPS, checked
from workflows.places import capture_here, fetch_folder, is_remote, local_path, model_here
from workflows.slot import function_of

PICTURES = "stages"
INPUTS = "inputs"


def debug(row: Row, out: Path, progress: Progress) -> str:
    """Run a job's step again here, with its results below `out` instead of where they belong. Returns what came of it.

    Registrations leave a picture of the fit at its start and after each stage in `out/stages`, and their folder in
    `out/registration`; a capture from a URL is kept in `out/inputs`.

    Raises:
        InputError: no job but a flow, `out` holds something, or whatever the step itself refuses.
    """
    if row.kind != "job":
        raise _wrong(row.id, expected="a job", got="a flow: see its jobs with `gnmreg status`")
    if out.exists() and any(out.iterdir()):
        raise _wrong(str(out), expected="a new or empty folder", got="one that holds something")
    checked(row.spec, STEPS, roots=("/", "s3:/"))  # of the right form; a person asked for it, so any place will do
    name, arguments = row.spec["step"], row.spec["arguments"]
    if name in ("register", "register stored"):
        return _register(arguments, out, progress)
    step = STEPS[name]
    changed = {"out": str(out / "product")} if "out" in step.places else {}
    return str(function_of(step.function)(**{**arguments, **changed}, progress=progress))


def _register(arguments: Mapping[str, Any], out: Path, progress: Progress) -> str:
    from registration.register import register

    place = str(arguments["capture"])
    if is_remote(place):
        progress.note(f"fetching {place}")
        fetch_folder(place, out / INPUTS / local_path(place).name)
        place = str(out / INPUTS / local_path(place).name)
    neutral = arguments.get("neutral")
    with capture_here(place) as capture:
        result = register(
            capture,
            model_path=model_here(str(arguments["model"])),
            out=out / REGISTRATION,
            neutral=None if neutral is None else Path(neutral),
            pictures=out / PICTURES,
            progress=progress,
            **{key: arguments[key] for key in ("recipe", "views", "seed", "variant") if key in arguments},
        )
    return f"{result.status}: {result.reason}"


def _wrong(where: str, *, expected: str, got: str) -> InputError:
    return InputError("This cannot be debugged", where=where, expected=expected, got=got, fix="choose another")
