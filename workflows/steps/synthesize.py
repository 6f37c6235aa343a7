"""`gnmreg dataset synth`: a population of synthetic subjects as a dataset; one seed is one population."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from coregister.synthetic import expressions, subject
from coregister.synthetic.capture import Studio, check_studio
from registration.errors import InputError
from registration.progress import NullProgress, Progress
from registration.storage.hashing import to_jsonable, versions
from workflows.processes import run_parallel
from workflows.records.dataset import HELD_OUT, MANIFEST, DatasetRecord
from workflows.records.subject import NEUTRAL

MOST = 1000  # subjects of one seed, so that populations of two seeds share nobody


@dataclass(frozen=True, kw_only=True)
class Population:
    """What a dataset is made from, resolved."""

    subjects: int
    expressions: tuple[str, ...] = ()  # beside the neutral
    seed: int = 0
    held_out: int = 0  # of the subjects, the last ones
    studio: Studio = Studio()  # its seed is each subject's own

    @property
    def seeds(self) -> dict[str, int]:
        """Folder name -> the seed that draws this subject."""
        return {f"synth_{seed:04d}": seed for seed in range(MOST * self.seed, MOST * self.seed + self.subjects)}

    @property
    def held(self) -> tuple[str, ...]:
        names = tuple(self.seeds)
        return names[len(names) - self.held_out :]


def synth_dataset(
    out: Path, population: Population, *, jobs: int = 1, progress: Progress | None = None
) -> DatasetRecord:
    """Render a population into `out`: people of any adult age and build, by `subject.synthesize_capture`.

    `out/SUBJECT/EXPRESSION` are captures, each whole or not there; called again it goes on where it was interrupted.
    `out/dataset.json` tells the seeds, who is held out, and whether all is there. Held-out subjects' captures have the
    tag `held_out`. Returns what `dataset.json` holds.

    Raises:
        InputError: settings out of range, unknown expressions, a folder that holds anything but this dataset, before
            anything is drawn; captures that could not be made, after all others were tried.
    """
    progress, out = progress or NullProgress(), Path(out)
    _check(population)
    record = _make_record(population)
    _check_out(out, record)
    calls: dict[str, dict[str, Any]] = {}
    for name, seed in population.seeds.items():
        for act in (NEUTRAL, *population.expressions):
            root = out / name / act
            if not root.exists():
                tags = {HELD_OUT: True} if name in population.held else {}
                studio = replace(population.studio, seed=seed)
                settings = {"seed": seed, "expression": act, "tags": tags, "studio": studio}
                calls[f"{name}, {act}"] = {"root": root, **settings}
    out.mkdir(parents=True, exist_ok=True)
    if calls:
        _write(out, record)
    lost = {}
    for done, (name, trouble) in enumerate(run_parallel(photograph, calls, jobs), 1):
        progress.update(done, len(calls), name)
        if trouble:
            lost[name] = trouble
    if lost:
        first, reason = next(iter(lost.items()))
        raise InputError(
            f"{len(lost)} of {len(calls)} captures could not be made",
            where=first,
            expected="a capture",
            got=reason,
            fix="run the same command again: it makes what is missing",
        )
    return _write(out, replace(record, complete=True))


def photograph(**settings: Any) -> str:
    """One capture. Returns its trouble, "" if there was none."""
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
        held_out=population.held,
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
    acts = population.expressions
    if NEUTRAL in acts or len(set(acts)) < len(acts):
        raise _input_error(
            "The expressions are not each once", "expressions", "names beside the neutral", ", ".join(acts)
        )
    if not 1 <= population.subjects <= MOST:
        raise _input_error("The number of subjects is out of range", "subjects", f"1 to {MOST}", population.subjects)
    if population.seed < 0:
        raise _input_error("The seed is out of range", "seed", "a whole number from 0", population.seed)
    if not 0 <= population.held_out <= population.subjects:
        expected = f"0 to {population.subjects}"
        raise _input_error("More are held out than there are", "held-out", expected, population.held_out)


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
