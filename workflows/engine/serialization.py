"""Serialization of jobs, results and errors in the queue's rows: JSON, which cannot run code when it is read."""

import json
from typing import Any

from dbos import Serializer

APPLICATION = "gnmreg"
VERSION = "wf-2"  # change it only with the structure of a workflow: workers take jobs of their own version only
_ERROR = "error"


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
        value = json.loads(serialized_data)
        return JobFailed(value[_ERROR]) if isinstance(value, dict) and set(value) == {_ERROR} else value

    def name(self) -> str:
        return "gnmreg-json"


def _record(error: BaseException) -> dict[str, Any]:
    if isinstance(error, JobFailed):
        return error.record
    return {"status": "failed", "reason": f"{type(error).__name__}: {error}"[:2000]}
