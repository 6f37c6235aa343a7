"""Refusal of queue rows that this package did not write.

Whoever can write to the database can write any row. DBOS leaves a row that it cannot start in the state "running" as
long as the process lives; here it becomes a failed job with a reason.
"""

import logging
from collections.abc import Mapping
from typing import Any

import dbos._queue
from dbos import DBOS

from workflows.engine.serialization import JobFailed, JsonSerializer, UnreadableRow

log = logging.getLogger("gnmreg")

WORKFLOWS = ("job", "flow")
_UNUSED = ("class_name", "config_name", "authenticated_user", "authenticated_roles", "assumed_role")


def check_row(row: Mapping[str, Any]) -> None:
    """Refuse a row that `QueueClient.submit` cannot have written.

    Args:
        row: the columns of `workflow_status`, and the inputs.

    Raises:
        UnreadableRow: the serialization or the name is another one, the row names a class or a user, or its inputs are
            not those of a job or flow.
    """
    ours = JsonSerializer()
    if row["serialization"] != ours.name():
        raise UnreadableRow(f"its serialization is {_shown(row['serialization'])}, not {ours.name()!r}")
    if row["name"] not in WORKFLOWS:
        raise UnreadableRow(f"its name is {_shown(row['name'])}, not one of {', '.join(WORKFLOWS)}")
    for column in _UNUSED:
        if row.get(column) is not None:
            raise UnreadableRow(f"its {column} is {_shown(row[column])}, expected none")
    if row.get("attributes"):
        raise UnreadableRow(f"its attributes are {_shown(row['attributes'])}, expected none")
    inputs = ours.deserialize(row["inputs"])
    if not isinstance(inputs, dict) or set(inputs) != {"args", "kwargs"}:
        raise UnreadableRow(f"its inputs are {_shown(inputs)}, not an object of args and kwargs")
    args, keywords = inputs["args"], inputs["kwargs"]
    if not isinstance(args, list) or len(args) != 1 or not isinstance(keywords, dict) or set(keywords) != {"queue"}:
        raise UnreadableRow(f"its inputs are {_shown(inputs)}, not a job and its queue")


def refuse_unreadable_rows() -> None:
    """Make this process check each row that it takes from a queue, and end those that `check_row` refuses."""
    original = dbos._queue.execute_dequeued_workflow
    if getattr(original, "checks_rows", False):
        return

    def execute(instance: DBOS, status: Any, owner_xid: str) -> Any:
        try:
            check_row(status)
        except UnreadableRow as error:
            reason = f"the queue's row is not one that gnmreg wrote: {error}"
            log.warning("%s: refused: %s", _shown(status["workflow_uuid"]), reason)
            record = JsonSerializer().serialize(JobFailed({"status": "refused", "reason": reason}))
            instance._sys_db.update_workflow_outcome(
                status["workflow_uuid"], "ERROR", error=record, owner_xid=owner_xid
            )
            return None
        return original(instance, status, owner_xid)

    execute.checks_rows = True  # type: ignore[attr-defined]
    dbos._queue.execute_dequeued_workflow = execute  # type: ignore[assignment]


def _shown(value: Any) -> str:
    return repr(value)[:100]
