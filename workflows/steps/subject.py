"""The captures of a subject, one after the other: a plain loop over the library's public calls; also as a step."""

import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from registration.capture.scan import read_truth
from registration.errors import InputError
from registration.evaluate.evaluation import evaluate_registration
from registration.fit.recipes import load_recipe
from registration.inputs import input_hash, read_schemes, used_cranium
from registration.model import gnm_npz
from registration.options import RegisterOptions
from registration.pipeline import register
from registration.progress import NullProgress, PrefixedProgress, Progress
from registration.report.pictures import RgbImage, data_uri
from registration.report.summary import refresh_report
from registration.storage import hashing
from registration.storage.registration_folder import read_manifest, update_figures
from registration.types import Capture, Registration
from workflows.pages.subject import render_subject_page
from workflows.pages.thumbnail import thumbnail
from workflows.records.headline import brief
from workflows.records.step_results import CaptureResult, CollectResult
from workflows.records.subject import (
    CaptureRow,
    SubjectCaptures,
    SubjectRecord,
    check_subject_out,
    is_subject_folder,
    read_captures,
    write_subject,
)
from workflows.steps.coregistration_page import shown_on_page
from workflows.steps.job_options import from_job
from workflows.steps.own_parts import share_own_parts
from workflows.steps.products import Product


def register_subject(
    subject_dir: Path,
    model: Path,
    out: Path,
    options: RegisterOptions = RegisterOptions(),  # noqa: B008  frozen
    *,
    neutral: str | None = None,
    force: bool = False,
    leave: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> SubjectRecord:
    """Register all captures of a subject: the neutral, then every expression from it, each by `register`.

    Every registration goes into the folder of `out` that has its capture's name; a registration of the same inputs is
    kept. `out/subject.json` and `out/index.html` are replaced after every capture. A capture that fails does not stop
    the others, but without a neutral no expression is tried.

    Args:
        subject_dir: its sub-folders that hold a capture.toml are the captures.
        model: a GNM NPZ file, as for `register`.
        out: the folder of the subject's registrations.
        options: of each registration.
        neutral: the name of the neutral's sub-folder; None: the one whose expression is "neutral".
        force: register again even if there is a registration of the same inputs.
        leave: captures that are not to be tried -> the reason; their rows are errors.
        progress: where to report to.

    Returns:
        The record with the status of each capture.

    Raises:
        InputError: `read_captures` or `check_subject_out` refuses a folder, there is no such recipe, or the model or
            a landmark file cannot be read; nothing is computed or written.
    """
    progress = progress or NullProgress()
    subject_dir, model, out = Path(subject_dir), Path(model), Path(out)
    captures, initial = _prepare(subject_dir, model, out, options, neutral)
    register_one = partial(register, model=model, options=options, force=force)
    writer = _SubjectWriter(initial, out)
    _register_captures(captures.captures, register_one, writer, leave or {}, progress)
    _share_own_parts(captures.captures, model, options, writer, progress)
    return writer.subject


@shown_on_page(often=True)
def collect_subject(
    *,
    subject_dir: str,
    model: str,
    out: str,
    options: Mapping[str, Any] | None = None,
    leave: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the folder that `gnmreg subject` writes, from registrations that other jobs have computed.

    Captures that have no registration yet are registered, except those of `leave`; errors are tried again each time.

    Args:
        subject_dir: folder of the captures.
        model: file of the model.
        out: folder of the subject's registrations.
        options: a `RegisterOptions` as JSON.
        leave: captures that are not to be tried -> the reason.
        progress: where to report to.

    Returns:
        A `CollectResult` as JSON.

    Raises:
        InputError: as `register_subject`.
    """
    chosen, folder = from_job(options), Path(out)
    captures = read_captures(Path(subject_dir))
    data = gnm_npz.read(Path(model))
    schemes = read_schemes(Path(model), data, chosen.landmark_files)
    cranium = used_cranium(Path(model), data, chosen)
    inputs = {
        capture.root.name: input_hash(capture, data, schemes, None, chosen, cranium) for capture in captures.captures
    }
    inputs |= {name: error.line for name, error in captures.broken.items()}
    product = Product(folder, hashing.input_hash(inputs, {"subject": captures.subject}), CollectResult)
    existing = product.find()
    if existing is not None and _contents(folder, existing.contents) == existing.contents:
        return replace(existing, out=out).to_json()
    record = register_subject(Path(subject_dir), Path(model), folder, chosen, leave=leave, progress=progress)
    result = CollectResult(
        input_hash=product.input_hash,
        out=out,
        rows={row.name: CaptureResult(status=row.status, reason=row.reason, usable=row.usable) for row in record.rows},
        contents=_contents(folder, [row.name for row in record.rows if row.folder]),
        seconds=sum(row.seconds or 0 for row in record.rows),
    )
    if all(row.folder or row.status == "skipped" for row in record.rows):
        product.write(result)
    return result.to_json()


def _contents(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Content ids of those of the registrations of these names that exist."""
    return {
        name: read_manifest(folder / name).content_id for name in names if (folder / name / "manifest.json").is_file()
    }


def start_subject(subject_dir: Path, model: Path, out: Path, options: RegisterOptions) -> None:
    """Write the record of a subject without registrations, unless there is one: it marks `out` as a subject's folder.

    Raises:
        InputError: as `register_subject`.
    """
    _, initial = _prepare(subject_dir, model, out, options, None)
    if not is_subject_folder(out):
        _SubjectWriter(initial, out)


def _prepare(
    subject_dir: Path, model: Path, out: Path, options: RegisterOptions, neutral: str | None
) -> tuple[SubjectCaptures, SubjectRecord]:
    """Check everything; return the captures and the record before the first is registered."""
    load_recipe(options.recipe)
    captures = read_captures(subject_dir, neutral)
    check_subject_out(out, captures)
    data = gnm_npz.read(model)
    read_schemes(model, data, options.landmark_files)
    used_cranium(model, data, options)
    initial = SubjectRecord(
        subject=captures.subject,
        model=gnm_npz.content_hash(data),
        recipe=options.recipe_name,
        neutral=captures.captures[0].root.name,
        rows=_initial_rows(captures),
    )
    return captures, initial


class _SubjectWriter:
    """A subject's record, which is written after every change, with the page."""

    def __init__(self, subject: SubjectRecord, out: Path):
        self.subject, self.out = subject, out
        self._thumbnails: dict[str, str] = {}  # row -> image as a data URI
        self._save()

    def row(self, capture: Capture) -> CaptureRow:
        return next(row for row in self.subject.rows if row.name == capture.root.name)

    def put(self, row: CaptureRow, thumbnail: RgbImage | None = None) -> None:
        if thumbnail is not None:
            self._thumbnails[row.name] = data_uri(thumbnail)
        rows = tuple(row if old.name == row.name else old for old in self.subject.rows)
        self.subject = replace(self.subject, rows=rows)
        self._save()

    def _save(self) -> None:
        write_subject(self.subject, self.out, render_subject_page(self.subject, self._thumbnails))


@dataclass(frozen=True, kw_only=True)
class _Neutral:
    registration: Registration
    capture: Capture
    folder: Path


def _register_captures(
    captures: tuple[Capture, ...],
    register_one: Callable[..., Registration],
    writer: _SubjectWriter,
    leave: Mapping[str, str],
    progress: Progress,
) -> None:
    """Register the first capture, the neutral, then every other one from it; `register_one` has model and options."""
    neutral: _Neutral | None = None
    for number, capture in enumerate(captures, 1):
        row = writer.row(capture)
        if row.name in leave:
            writer.put(replace(row, status="error", reason=leave[row.name]))
            continue
        if number > 1 and neutral is None:
            reason = f"the neutral failed: {writer.row(captures[0]).reason}"
            writer.put(replace(row, status="skipped", reason=reason))
            continue
        named = PrefixedProgress(progress, f"{row.name} ({number} of {len(captures)})")
        named.message("registering")
        row, result = _register_row(row, capture, writer.out / row.name, register_one, neutral, named)
        image = None if result is None else _attempt(partial(thumbnail, result), named)[0]
        writer.put(row, image)
        named.message(f"{row.status}: {row.reason}")
        if number == 1 and result is not None and row.usable:
            neutral = _Neutral(registration=result, capture=capture, folder=writer.out / row.name)


def _share_own_parts(
    captures: tuple[Capture, ...], model: Path, options: RegisterOptions, writer: _SubjectWriter, progress: Progress
) -> None:
    """Give all usable registrations the teeth and eyes that they show together, and measure those again."""
    data = gnm_npz.read(model)
    usable = {writer.out / row.name: capture for capture in captures if (row := writer.row(capture)).usable}
    action = partial(share_own_parts, usable, data, read_schemes(model, data, options.landmark_files))
    shared, failure = _attempt(action, progress)
    changed = shared or {}
    if failure:
        progress.message(f"teeth and eyes stay those of each capture alone: {failure}")
    for folder, registration in changed.items():
        capture = usable[folder]
        progress.message(f"{folder.name}: teeth and eyes of all captures")
        if capture.scan is not None and capture is captures[0]:
            _attempt(partial(_measured_again, registration, capture, folder), progress)
        elif capture is not captures[0]:
            first = writer.out / captures[0].root.name
            neutral = _Neutral(registration=changed[first], capture=captures[0], folder=first)
            without = replace(registration, figures={k: v for k, v in registration.figures.items() if k != "drift"})
            _attempt(partial(_with_drift, without, capture, folder, neutral), progress)
        writer.put(replace(writer.row(capture), figures=brief(read_manifest(folder).figures)))


def _measured_again(registration: Registration, capture: Capture, folder: Path) -> None:
    update_figures(folder, evaluate_registration(registration, capture).metrics)
    refresh_report(folder)


def _register_row(
    row: CaptureRow,
    capture: Capture,
    folder: Path,
    register_one: Callable[..., Registration],
    neutral: _Neutral | None,
    progress: Progress,
) -> tuple[CaptureRow, Registration | None]:
    """Register a capture; return its row and its registration if there is one."""
    initial = neutral.folder if neutral else None
    action = partial(register_one, capture.root, out=folder, neutral=initial, progress=progress)
    result, reason = _attempt(action, progress)
    if result is None:
        return replace(row, status="error", reason=reason), None
    reason = result.reason
    if neutral is not None:
        evaluated, failure = _attempt(partial(_with_drift, result, capture, folder, neutral), progress)
        result = evaluated or result
        reason += f"; the drift could not be measured: {failure}" if failure else ""
    row = replace(
        row,
        status=result.status,
        reason=reason,
        figures=brief(result.figures),
        seconds=sum(result.seconds.values()),
        folder=folder.name,
    )
    return row, result


def _with_drift(result: Registration, capture: Capture, folder: Path, neutral: _Neutral) -> Registration:
    """Add the evaluation's metrics to the registration and its manifest, if the two ground truths can be compared.

    Existing metrics are kept if they are newer than the neutral.
    """
    if not _comparable(capture, neutral.capture) or not np.isfinite(result.vertices).all():
        return result
    written, start = ((path / "manifest.json").stat().st_mtime_ns for path in (folder, neutral.folder))
    if "drift" in result.figures and written >= start:
        return result
    evaluation = evaluate_registration(result, capture, neutral=neutral.registration, neutral_capture=neutral.capture)
    update_figures(folder, evaluation.metrics)
    refresh_report(folder)
    return replace(result, figures=read_manifest(folder).figures)


def _comparable(capture: Capture, neutral: Capture) -> bool:
    """Whether both have a scan and ground truths of one topology."""
    truths = [c.ground_truth for c in (capture, neutral) if c.scan is not None]
    shapes = [read_truth(truth).shape for truth in truths if truth is not None]
    return len(shapes) == 2 and shapes[0] == shapes[1]


T = TypeVar("T")


def _attempt(action: Callable[[], T], progress: Progress) -> tuple[T | None, str]:
    """The action's result, or None and the reason of its failure, which must not stop the other captures."""
    try:
        return action(), ""
    except InputError as error:
        return None, error.line
    except Exception as error:
        progress.message(traceback.format_exc())
        first, *_ = str(error).splitlines() or [""]  # the log has the traceback
        return None, f"{type(error).__name__}: {first}"


def _initial_rows(captures: SubjectCaptures) -> tuple[CaptureRow, ...]:
    """A row for each capture, the neutral's first; unreadable ones are errors."""
    rows = [CaptureRow(name=capture.root.name, expression=capture.expression) for capture in captures.captures]
    broken = [
        CaptureRow(name=name, expression="", status="error", reason=error.line)
        for name, error in captures.broken.items()
    ]
    return (*rows, *broken)
