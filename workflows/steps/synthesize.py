"""`gnmreg dataset synth`: a dataset of synthetic subjects; a seed determines the subjects."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from coregister.synthetic import expressions, subject
from coregister.synthetic.capture import Studio, check_studio
from registration.errors import InputError, check_seed
from registration.progress import NullProgress, Progress
from registration.storage.hashing import to_jsonable, versions
from workflows.processes import run_parallel
from workflows.records.dataset import HELD_OUT, MANIFEST, DatasetRecord
from workflows.records.subject import NEUTRAL

MAX_SUBJECTS = 1000  # of one seed, so that populations of two seeds have no subject in common


@dataclass(frozen=True, kw_only=True)
class Population:
    """The settings of a synthetic dataset."""

    subjects: int
    expressions: tuple[str, ...] = ()  # besides the neutral
    seed: int = 0
    held_out: int = 0  # of the subjects, the last ones
    studio: Studio = Studio()  # its seed is replaced by each subject's

    @property
    def seeds(self) -> dict[str, int]:
        """Folder name -> seed of the subject."""
        return {
            f"synth_{seed:04d}": seed
            for seed in range(MAX_SUBJECTS * self.seed, MAX_SUBJECTS * self.seed + self.subjects)
        }

    @property
    def held_out_names(self) -> tuple[str, ...]:
        """Folder names of the held-out subjects."""
        names = tuple(self.seeds)
        return names[len(names) - self.held_out :]


def synth_dataset(
    out: Path, population: Population, *, jobs: int = 1, progress: Progress | None = None
) -> DatasetRecord:
    """Render captures of synthetic subjects into the folder `out`: `out/SUBJECT/EXPRESSION`, and `out/dataset.json`.

    Every capture is written atomically; a repeated call resumes. Captures of held-out subjects have the tag `held_out`.

    Args:
        out: folder of the dataset.
        population: its settings.
        jobs: number of captures that are rendered in parallel.
        progress: where to report to.

    Returns:
        The content of `dataset.json`.

    Raises:
        InputError: settings are out of range, an expression is unknown, or the folder holds anything but this dataset,
            before anything is rendered; or captures failed, after all others were tried.
    """
    progress, out = progress or NullProgress(), Path(out)
    _check(population)
    if jobs < 1:
        raise _input_error("The number of jobs is out of range", "jobs", "at least 1", jobs)
    record = _make_record(population)
    _check_out(out, record)
    calls: dict[str, dict[str, Any]] = {}
    for name, seed in population.seeds.items():
        for expression in (NEUTRAL, *population.expressions):
            root = out / name / expression
            if not root.exists():
                tags = {HELD_OUT: True} if name in population.held_out_names else {}
                studio = replace(population.studio, seed=seed)
                settings = {"seed": seed, "expression": expression, "tags": tags, "studio": studio}
                calls[f"{name}, {expression}"] = {"root": root, **settings}
    out.mkdir(parents=True, exist_ok=True)
    if calls:
        _write(out, record)
    failures = {}
    for done, (name, failure) in enumerate(run_parallel(render_subject, calls, jobs), 1):
        progress.update(done, len(calls), name)
        if failure:
            failures[name] = failure
    if failures:
        first, reason = next(iter(failures.items()))
        raise InputError(
            f"{len(failures)} of {len(calls)} captures could not be rendered",
            where=first,
            expected="a capture",
            got=reason,
            fix="run the same command again: it renders missing captures",
        )
    return _write(out, replace(record, complete=True))


def render_subject(**settings: Any) -> str:
    """Render one capture of a subject. Returns the reason of its failure, "" for none."""
    try:
        subject.synthesize_capture(**settings)
    except InputError as error:
        return error.line
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _make_record(population: Population) -> DatasetRecord:
    """The record of a dataset of which captures are still missing."""
    return DatasetRecord(
        complete=False,
        categories={name: expressions.expression_by_name(name).category for name in population.expressions},
        seeds=population.seeds,
        held_out=population.held_out_names,
        expressions=population.expressions,
        studio=to_jsonable(population.studio),
        versions=versions(),
    )


def _write(out: Path, record: DatasetRecord) -> DatasetRecord:
    """Write the record if it differs from the one in the folder: an existing dataset keeps its file."""
    file = out / MANIFEST
    if not file.is_file() or DatasetRecord.read(file) != record:
        record.write(file)
    return record


def _check(population: Population) -> None:
    check_studio(Path("/nowhere/at/all"), population.studio)
    for name in population.expressions:
        expressions.expression_by_name(name)
    names = population.expressions
    if NEUTRAL in names or len(set(names)) < len(names):
        raise _input_error(
            "The expressions are not each once", "expressions", "different names, without the neutral", ", ".join(names)
        )
    if not 1 <= population.subjects <= MAX_SUBJECTS:
        raise _input_error(
            "The number of subjects is out of range", "subjects", f"1 to {MAX_SUBJECTS}", population.subjects
        )
    check_seed(population.seed)
    check_seed(MAX_SUBJECTS * (population.seed + 1) - 1)  # the seeds of its subjects
    if not 0 <= population.held_out <= population.subjects:
        expected = f"0 to {population.subjects}"
        raise _input_error("More subjects are held out than there are", "held-out", expected, population.held_out)


def _check_out(out: Path, record: DatasetRecord) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    file = out / MANIFEST
    existing = DatasetRecord.read(file) if DatasetRecord.is_ours(file) else None
    if existing is None or replace(existing, complete=record.complete, versions=record.versions) != record:
        raise InputError.output_folder(
            out,
            expected="a new or empty folder, or one with a dataset of the same settings",
            got="other contents" if existing is None else "another dataset",
            fix="choose another folder, or the arguments that the dataset was made with",
        )


def _input_error(what: str, where: object, expected: object, got: object) -> InputError:
    return InputError(what, where=where, expected=expected, got=got, fix="change it")
