"""Submission of a subject, its neutral and expressions, as a run of a farm's queue."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from registration.errors import InputError
from registration.model import gnm_npz
from registration.options import RegisterOptions
from registration.storage.records import to_json
from workflows.engine.client import QueueClient
from workflows.engine.jobs import DRIVER, FlowJob
from workflows.engine.reader import QueueReader
from workflows.ids import check_id
from workflows.records.subject import check_subject_out, read_captures
from workflows.steps.job_options import to_job


@dataclass(frozen=True, kw_only=True)
class SubjectRun:
    """The run of a subject, checked.

    Attributes:
        run: its name.
        flow: what is submitted.
        left_out: capture -> why it cannot be read.
    """

    run: str
    flow: FlowJob
    left_out: Mapping[str, str]


def subject_run(
    subject: Path, *, model: Path, out: Path, run: str, options: RegisterOptions, neutral: str | None = None
) -> SubjectRun:
    """Return the run that registers the captures of a subject: the neutral, then each expression from it.

    Args:
        subject: folder of the captures.
        model: file of the head model.
        out: folder of the registrations.
        run: name of the run.
        options: of all registrations.
        neutral: name of the neutral's folder; None: the capture whose expression is "neutral".

    Raises:
        InputError: `read_captures` or `check_subject_out` refuses a folder, or the model or the options cannot be used.
    """
    captures = read_captures(subject, neutral)
    check_subject_out(out, captures)
    gnm_npz.read(model)
    arguments = {
        "subject_dir": str(subject),
        "captures": [capture.root.name for capture in captures.captures],
        "model": str(model),
        "out": str(out),
        "options": to_json(to_job(options)),
    }
    flow = FlowJob(id=check_id(run), flow="subject", arguments=arguments, queue=DRIVER)
    return SubjectRun(run=flow.id, flow=flow, left_out={name: e.line for name, e in captures.broken.items()})


def submit_subject(url: str, subject: SubjectRun) -> None:
    """Put a subject's run into the queue at `url`. The rows of an earlier run of this name are deleted.

    Registrations of the same inputs are not computed again.

    Raises:
        InputError: there is no queue, or a run of this name has not ended, or is another one.
    """
    row = QueueReader(url).rows([subject.run]).get(subject.run)
    if row is not None and row.spec.get("flow") != subject.flow.flow:
        raise InputError(
            "The run is no subject",
            where=subject.run,
            expected="a new name, or that of a subject",
            got="another run",
            fix="choose another name",
        )
    queue = QueueClient(url, known=True)
    try:
        queue.forget(subject.run)
        queue.submit([subject.flow])
    finally:
        queue.close()
