"""Processes that take jobs from the queue: workers run steps in a child, coordinators run flows.

They are crash-only: ending one means killing it, and what it was doing is given to another. So there is one way to
stop, and it is the one that the tests try hardest.
"""

import logging
import os
import signal
import socket
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from dbos import DBOS, DBOSConfig

from registration.errors import InputError
from workflows.engine.child import RETRIED, Outcome, Slot
from workflows.engine.database import ENVIRONMENT, checked_url, prepare
from workflows.engine.jobs import DRIVER, GPU, REBUILD, SUBJECTS, Step, checked
from workflows.engine.liveness import Liveness, Patience
from workflows.engine.scope import Scope
from workflows.engine.serialization import APPLICATION, VERSION, JobFailed, Json
from workflows.ids import check_id, redact, resolve_roots

log = logging.getLogger("gnmreg")

POLL_S = 0.25  # how often a process asks a queue for work
QUEUES = {GPU: 1, REBUILD: 1, SUBJECTS: 64, DRIVER: 1}  # how much of a queue one process takes at a time
ATTEMPTS, BACK_OFF_S, BACK_OFF_FACTOR = 3, 10.0, 3.0
RECOVERIES = 5  # a job that killed so many workers, and one more, is a dead letter
Flow = Callable[..., Awaitable[Any]]


@dataclass(frozen=True, kw_only=True)
class Process:
    """What one process is to do."""

    url: str  # of the queue's database
    queues: tuple[str, ...]
    logs: Path  # each job's log goes to logs/<job id>.log
    names: tuple[str, ...]  # executor ids to choose from; the first whose lock is free
    roots: tuple[str, ...] = ()  # places of jobs must lie below them
    steps: Mapping[str, Step] = field(default_factory=dict)
    flows: Mapping[str, Flow] = field(default_factory=dict)
    modules: tuple[str, ...] = ()  # that a child imports when it starts
    patience: Patience | None = None  # None: what suits the database
    back_off_s: float = BACK_OFF_S


def names(kind: str, count: int = 64) -> tuple[str, ...]:
    """Executor ids for processes of this machine, "host-gpu0" and so on."""
    return tuple(f"{socket.gethostname()}-{kind}{number}" for number in range(count))


def migrate(url: str) -> None:
    """Create or bring up to date the tables of the queue. Any number of processes may do so at a time."""
    url = checked_url(url)
    prepare(url)
    DBOS.migrate(url)


def serve(process: Process) -> NoReturn:
    """Take jobs until SIGTERM or SIGINT; call it in the main thread, it never returns.

    Raises:
        InputError: the database cannot be used, or another process has the place.
    """
    url = checked_url(process.url)
    os.environ.pop(ENVIRONMENT, None)  # children print their environment when they crash
    _quiet()
    migrate(url)
    liveness = Liveness(url, process.patience)
    name = liveness.join(process.names)  # before launch, which takes back what this name was doing before it died
    slot = Slot(modules=process.modules) if process.steps else None
    if slot is not None:
        slot.warm()
    _registered(process, url, slot)
    DBOS(config=_config(url, name))
    DBOS.listen_queues(list(process.queues))
    DBOS.launch()
    for queue, at_a_time in QUEUES.items():
        DBOS.register_queue(queue, worker_concurrency=at_a_time, polling_interval_sec=POLL_S)
    liveness.watch(VERSION, _recover)
    print(f"{name} takes jobs from {', '.join(process.queues)}", flush=True)
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    ended.wait()
    if slot is not None:
        slot.kill()
    print(f"{name} ends", flush=True)
    os._exit(0)


def _recover(name: str) -> None:
    DBOS._recover_pending_workflows([name])


def _config(url: str, name: str) -> DBOSConfig:
    return {
        "name": APPLICATION,
        "system_database_url": url,
        "executor_id": name,
        "application_version": VERSION,  # by default a hash of the code: an edit would strand a backlog
        "sys_db_pool_size": 6,
        "use_listen_notify": False,  # we count rows and wait for no events: a connection less for each process
        "notification_listener_polling_interval_sec": 30.0,
        "serializer": Json(),
        "log_level": "WARNING",
    }


def _registered(process: Process, url: str, slot: Slot | None) -> None:
    """Make the two kinds of workflows known: `job` runs one step, `flow` is a function that makes jobs and waits."""
    roots = resolve_roots(process.roots)

    async def attempt(spec: Any, number: int) -> Outcome:
        assert slot is not None
        try:
            step, arguments = checked(spec, process.steps, roots)
            file = process.logs / f"{check_id(str(DBOS.workflow_id))}.log"
        except InputError as error:
            return {"status": "refused", "reason": f"{error.where}: expected {error.expected}, got {error.got}"}
        if number > 1:
            log.warning("%s: attempt %d", DBOS.workflow_id, number)
        return await slot.run(step.function, arguments, log=file, hard_s=step.hard_s)

    @DBOS.workflow(name="job", max_recovery_attempts=RECOVERIES)
    async def job(spec: Any, queue: str) -> Any:
        for number in range(1, ATTEMPTS + 1):
            options = {"name": f"attempt {number}", "preemptible": True}
            outcome: Outcome = await DBOS.run_step_async(options, attempt, spec, number)  # type: ignore[call-overload]
            if outcome["status"] == "done":
                return outcome
            if outcome["status"] not in RETRIED:
                break
            if number < ATTEMPTS:
                await DBOS.sleep_async(process.back_off_s * BACK_OFF_FACTOR ** (number - 1))
        raise JobFailed({**outcome, "attempts": number})

    @DBOS.workflow(name="flow")
    async def flow(spec: Any, queue: str) -> Any:
        try:
            function, arguments = process.flows[spec["flow"]], dict(spec["arguments"])
        except (KeyError, TypeError) as error:
            raise JobFailed({"status": "refused", "reason": f"there is no such flow: {error}"}) from None
        return await function(Scope(url), **arguments)


class _Redacting(logging.Filter):
    """Passwords in URLs end here, whoever logs them; so do the tracebacks of jobs that failed."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.exc_info and isinstance(record.exc_info[1], JobFailed):  # told in the job's row and log
            return False
        record.msg, record.args = redact(record.getMessage()), None
        if record.exc_info:
            record.exc_text = redact(logging.Formatter().formatException(record.exc_info))
            record.exc_info = None
        return True


def _quiet() -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S"))
    handler.addFilter(_Redacting())
    for name in ("dbos", "gnmreg"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(logging.WARNING)


def known_queues(listened: Sequence[str]) -> tuple[str, ...]:
    """The names of queues as given. Raises InputError for one that does not exist."""
    for name in listened:
        if name not in QUEUES:
            raise InputError(
                "There is no such queue",
                where="--queue",
                expected=", ".join(QUEUES),
                got=name,
                fix="choose among them",
            )
    return tuple(listened)
