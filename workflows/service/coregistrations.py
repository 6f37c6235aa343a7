"""The coregistrations of a farm: their records, read from the folders that the queue's rows name."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

from registration.errors import InputError
from registration.storage.records import read_json
from workflows.ids import is_remote
from workflows.records.round_files import MANIFEST, PLAN, model_name
from workflows.service.problems import Problem
from workflows.service.results import arguments_of
from workflows.service.state import ServiceState

_WRONG_SHAPE = (KeyError, TypeError, AttributeError, ValueError, IndexError)


@dataclass(frozen=True, kw_only=True)
class Coregistration:
    """A coregistration that the queue knows."""

    run: str
    folder: Path
    record: Mapping[str, Any]  # entries of `coregistration.json`

    def model_of_round(self, number: int) -> Path:
        """Return the model that a round's captures were registered with. Raises Problem for an unknown round."""
        try:
            return Path(self.record["models"][model_name(number)])
        except _WRONG_SHAPE:
            raise Problem.missing("round", f"it{number:02d}", "see the coregistration's page") from None


def coregistration(state: ServiceState, run: str) -> Coregistration:
    """Return a coregistration.

    Raises:
        Problem: 404 if there is none of this name, it lies outside the folders of the service, or it has no record yet.
    """
    row = state.reader.rows([run]).get(run)
    if row is None or row.spec.get("flow") != "coregister":
        raise Problem.missing("coregistration", run, "see the overview")
    try:
        plan = state.places.of_row(arguments_of(row).get("plan"), "plan")
        if is_remote(plan) or Path(plan).name != PLAN:
            raise Problem.missing("plan", run)
        folder = Path(plan).parent
        record = read_json(folder / MANIFEST, title="coregistration's record")
    except InputError as error:
        raise Problem.of_input(error, HTTPStatus.NOT_FOUND) from None
    if not isinstance(record, dict) or not isinstance(record.get("plan"), dict):
        raise malformed(run)
    return Coregistration(run=run, folder=folder, record=record)


def coregistrations(state: ServiceState) -> Iterator[Coregistration]:
    """Yield those whose record can be read, the newest first."""
    drivers = [entry for entry in state.board.entries.values() if "/" not in entry.id and entry.times.kind == "flow"]
    rows = state.reader.rows([entry.id for entry in drivers])
    for entry in sorted(drivers, key=lambda driver: -driver.times.created):
        if entry.id in rows and rows[entry.id].spec.get("flow") == "coregister":
            try:
                yield coregistration(state, entry.id)
            except Problem:
                continue


def malformed(run: str) -> Problem:
    """Return the refusal of a record that somebody has changed."""
    fix = "run `gnmreg coregister` again"
    return Problem(HTTPStatus.UNPROCESSABLE_ENTITY, "The coregistration's record cannot be read", where=run, fix=fix)
