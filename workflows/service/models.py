"""The head models that a service knows: those in the farm's folder, and those that coregistrations built."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.storage.reading import read_json
from workflows.service.problems import Problem
from workflows.service.state import ServiceState

_RECORD = "coregistration.json"  # read as JSON: its type would import the whole library


@dataclass(frozen=True, kw_only=True)
class KnownModel:
    """A head model with the figures of its evaluation, if there are any."""

    id: str
    file: Path
    run: str = ""
    generalization_mm: Mapping[str, float]
    specificity_mm: Mapping[str, float]
    verdict: Mapping[str, Any] | None = None

    def brief(self) -> dict[str, Any]:
        """Return what lists show."""
        return {
            "id": self.id,
            "path": str(self.file),
            "bytes": self.file.stat().st_size,
            "run": self.run,
            "generalization_mm": self.generalization_mm,
            "specificity_mm": self.specificity_mm,
        }


def list_models(state: ServiceState) -> list[KnownModel]:
    """Return all models: those of the farm's folder, then those of coregistrations, RUN/1 after the first round."""
    stored = [
        KnownModel(id=name, file=file, generalization_mm={}, specificity_mm={})
        for name, file in state.places.stored_models()
        if state.places.allows(str(file))
    ]
    return stored + [model for run, folder in _coregistrations(state) for model in _built(state, run, folder)]


def find_model(state: ServiceState, identity: str) -> KnownModel | None:
    """Return the model of an id; None if there is none."""
    return next((model for model in list_models(state) if model.id == identity), None)


def _coregistrations(state: ServiceState) -> Iterator[tuple[str, Path]]:
    """Name and results of the coregistrations in the queue."""
    drivers = [entry.id for entry in state.board.entries.values() if entry.id == entry.run]
    for run, row in sorted(state.reader.rows(drivers).items()):
        arguments = row.spec.get("arguments")
        plan = arguments.get("plan") if isinstance(arguments, dict) else None
        if row.spec.get("flow") == "coregister" and isinstance(plan, str) and state.places.allows(plan):
            yield run, Path(plan).parent


def _built(state: ServiceState, run: str, folder: Path) -> Iterator[KnownModel]:
    file = folder / _RECORD
    record: Any = {}
    with suppress(InputError, Problem):  # none yet, or damaged: the other models are listed
        state.places.check(str(file), "record")
        record = read_json(file, partial(InputError.unreadable, "record", where=run, fix="see the log"))
    record = record if isinstance(record, dict) else {}
    models = record.get("models")
    for name, place in models.items() if isinstance(models, dict) else ():
        number = str(name).removeprefix("model ")
        if number == "0" or not number.isdecimal() or not isinstance(place, str) or not state.places.allows(place):
            continue
        if Path(place).is_file():
            yield KnownModel(
                id=f"{run}/{number}",
                file=Path(place),
                run=run,
                generalization_mm=_curve(record.get("generalization_mm"), name),
                specificity_mm=_curve(record.get("specificity_mm"), name),
                verdict=_verdict(record),
            )


def _curve(curves: Any, name: str) -> dict[str, float]:
    curve = curves.get(name) if isinstance(curves, dict) else None
    items = curve.items() if isinstance(curve, dict) else ()
    return {str(key): float(value) for key, value in items if isinstance(value, int | float)}


def _verdict(record: Mapping[str, Any]) -> Mapping[str, Any] | None:
    verdict = record.get("verdict")
    return verdict if isinstance(verdict, dict) else None
