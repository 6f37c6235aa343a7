"""Serialization of jobs, results and errors in the queue's rows: JSON, which cannot run code when it is read.

A row names the serialization of its values, and DBOS unpickles a value whose row says so. Importing this module, which
every module that imports DBOS does first, takes that away from the process: rows of any other serialization are errors.
"""

import json
from typing import Any, NoReturn

from dbos import Serializer
from dbos._serialization import DBOSPortableJSONSerializer, DefaultSerializer, deserialize_value

APPLICATION = "gnmreg"
_ERROR = "error"


class UnreadableRow(ValueError):
    """A value in the queue's database is not one that this package wrote."""


class JobFailed(Exception):
    """A job or flow failed. Its record has the keys "status", "reason" and others."""

    def __init__(self, record: dict[str, Any]) -> None:
        self.record = record
        super().__init__(f"{record.get('status')}: {record.get('reason')}")


class JsonSerializer(Serializer):
    """Serialize values as JSON, exceptions as {"error": record}."""

    def serialize(self, data: Any) -> str:
        if isinstance(data, BaseException):
            data = {_ERROR: _record(data)}
        return json.dumps(data, allow_nan=False)

    def deserialize(self, serialized_data: str) -> Any:
        """Return the value in a text from an untrusted source. Raises UnreadableRow."""
        value = _parsed(serialized_data)
        if isinstance(value, dict) and set(value) == {_ERROR}:
            return JobFailed(value[_ERROR] if isinstance(value[_ERROR], dict) else {"reason": str(value[_ERROR])})
        return value

    def name(self) -> str:
        return "gnmreg-json"


def _record(error: BaseException) -> dict[str, Any]:
    if isinstance(error, JobFailed):
        return error.record
    return {"status": "failed", "reason": f"{type(error).__name__}: {error}"[:2000]}


def _parsed(text: Any) -> Any:
    try:
        return json.loads(text, parse_constant=_no_number)
    except (TypeError, ValueError, RecursionError) as error:  # also text that is not Unicode, or of another type
        raise UnreadableRow(f"a value is not JSON: {type(error).__name__}: {error}"[:200]) from None


def _no_number(name: str) -> NoReturn:
    raise UnreadableRow(f"{name} is not a number")


def _refuse(self: Serializer, _: Any) -> NoReturn:
    raise UnreadableRow(f"the serialization {self.name()!r} is not used here")


def _only_number(self: Serializer, text: Any) -> Any:
    """The one use of DBOS's own JSON: the time at which a sleep ends."""
    value = _parsed(text)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise UnreadableRow(f"the serialization {self.name()!r} is not used here, except for times")
    return value


def _leave_one_deserializer() -> None:
    """Disable DBOS's pickle, and its own JSON except for numbers, in this process.

    Raises:
        RuntimeError: this release of DBOS has another structure, and would still unpickle rows.
    """
    DefaultSerializer.serialize = DefaultSerializer.deserialize = _refuse  # type: ignore[method-assign, assignment]
    DBOSPortableJSONSerializer.deserialize = _only_number  # type: ignore[method-assign]
    try:
        deserialize_value("gAROLg==", "py_pickle", JsonSerializer())  # None as a pickle
    except UnreadableRow:
        return
    raise RuntimeError("this release of DBOS may unpickle rows: install the one of constraints.txt")


_leave_one_deserializer()
