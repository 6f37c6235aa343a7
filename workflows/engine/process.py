"""Processes that take jobs from the queue: workers run steps in a child, coordinators run flows.

They are crash-only: to stop a process is to kill it, and its jobs are given to others. So there is one way to stop,
and the tests exercise it most.
"""

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from dbos import DBOS, DBOSConfig

from registration.errors import InputError
from workflows.engine.child import RETRIED, StepOutcome, StepProcess
from workflows.engine.coverage import Coverage, create_workers_table, publish_worker, take_covered_jobs_only
from workflows.engine.database import SECRETS, checked_url, prepare, with_environments_password
from workflows.engine.jobs import DRIVER, GPU, REBUILD, SUBJECTS, VERSION, Step, validate_arguments
from workflows.engine.liveness import Liveness, LivenessTimeouts
from workflows.engine.log_output import configure_logging
from workflows.engine.row_check import refuse_unreadable_rows
from workflows.engine.scope import FlowScope
from workflows.engine.serialization import APPLICATION, JobFailed, JsonSerializer
from workflows.ids import check_id, resolve_roots

log = logging.getLogger("gnmreg")

POLL_S = 0.25  # between two queries of a process for work
PRESENCE_S = 2.0  # between two looks at what this process says of itself
QUEUES = {GPU: 1, REBUILD: 1, SUBJECTS: 64, DRIVER: 1}  # jobs of a queue that one process runs at a time
ATTEMPTS, BACK_OFF_S, BACK_OFF_FACTOR = 3, 10.0, 3.0
RECOVERIES = 5  # a job that killed more workers than this is dead: it is not run again
Flow = Callable[..., Awaitable[Any]]


@dataclass(frozen=True, kw_only=True)
class EngineProcess:
    """Configuration of one process."""

    url: str  # of the queue's database
    queues: tuple[str, ...]
    logs: Path  # each job's log goes to logs/<job id>.log
    names: tuple[str, ...]  # possible executor ids; the first whose lock is free is taken
    roots: tuple[str, ...] = ()  # paths and URLs of jobs must lie below them
    steps: Mapping[str, Step] = field(default_factory=dict)
    flows: Mapping[str, Flow] = field(default_factory=dict)
    modules: tuple[str, ...] = ()  # imported by a child when it starts
    timeouts: LivenessTimeouts | None = None  # None: the default of the database
    back_off_s: float = BACK_OFF_S


def names(kind: str, count: int = 64) -> tuple[str, ...]:
    """Return executor ids for processes of this machine, "host-gpu0" and so on."""
    return tuple(f"{socket.gethostname()}-{kind}{number}" for number in range(count))


def migrate(url: str) -> None:
    """Create or update the tables of the queue. Several processes may do so at the same time.

    Raises:
        InputError: the database cannot be used.
    """
    url = checked_url(url)
    prepare(url)
    DBOS.migrate(url)
    create_workers_table(url)


def serve(process: EngineProcess) -> NoReturn:
    """Take jobs until SIGTERM or SIGINT. Call it in the main thread; it never returns.

    Raises:
        InputError: the database cannot be used, or another process has the executor id.
    """
    url = with_environments_password(checked_url(process.url))
    for name in SECRETS:
        os.environ.pop(name, None)  # children print their environment when they crash
    configure_logging()
    migrate(url)
    liveness = Liveness(url, process.timeouts)
    name = liveness.join(process.names)  # before launch, which recovers this executor id's jobs
    child = StepProcess(modules=process.modules) if process.steps else None
    if child is not None:
        child.warm()
    _register_workflows(process, url, child, name)
    refuse_unreadable_rows()
    coverage = Coverage(url, process.steps, resolve_roots(process.roots)) if process.steps else None
    if coverage is not None:
        take_covered_jobs_only(coverage, url)
    DBOS(config=_config(url, name))
    DBOS.listen_queues(list(process.queues))
    DBOS.launch()
    for queue, at_a_time in QUEUES.items():
        DBOS.register_queue(queue, worker_concurrency=at_a_time, polling_interval_sec=POLL_S)
    liveness.watch(VERSION, _recover)
    presence = threading.Thread(target=_say_presence, args=(url, name, process.queues, coverage), daemon=True)
    presence.start()
    print(f"{name} takes jobs from {', '.join(process.queues)}", flush=True)
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    ended.wait()
    if child is not None:
        child.kill()
    print(f"{name} ends", flush=True)
    os._exit(0)


def _say_presence(url: str, name: str, queues: tuple[str, ...], coverage: Coverage | None) -> None:
    """Keep what `gnmreg status` says of this process up to date."""
    said: dict[str, Any] | None = None
    while True:
        about = {"queues": list(queues), "left": coverage.left if coverage is not None else []}
        if about != said:
            try:
                publish_worker(url, name, about)
                said = about
            except Exception as error:  # the server may be restarting
                first, *_ = str(error).splitlines() or [repr(error)]
                log.warning("cannot tell the queue about this process now: %s", first)
        time.sleep(PRESENCE_S)


def _recover(name: str) -> None:
    DBOS._recover_pending_workflows([name])


def _config(url: str, name: str) -> DBOSConfig:
    return {
        "name": APPLICATION,
        "system_database_url": url,
        "executor_id": name,
        "application_version": VERSION,  # DBOS's default is a hash of the code: an edit would strand the waiting jobs
        "sys_db_pool_size": 6,
        "use_listen_notify": False,  # flows count rows instead of waiting for events: one connection fewer per process
        "notification_listener_polling_interval_sec": 30.0,
        "serializer": JsonSerializer(),
        "log_level": "WARNING",
    }


def _register_workflows(process: EngineProcess, url: str, child: StepProcess | None, name: str) -> None:
    """Register the two kinds of workflows: `job` runs one step, `flow` runs a function that submits jobs and waits."""
    roots = resolve_roots(process.roots)

    async def attempt(spec: Any, number: int) -> StepOutcome:
        assert child is not None
        try:
            step, arguments = validate_arguments(spec, process.steps, roots)
            file = process.logs / f"{check_id(str(DBOS.workflow_id))}.log"
        except InputError as error:
            return {"status": "refused", "reason": f"{error.where}: expected {error.expected}, got {error.got}"}
        if number > 1:
            log.warning("%s: attempt %d", DBOS.workflow_id, number)
        about = {"job": DBOS.workflow_id, "attempt": number, "step": spec["step"], "executor": name}
        log.info("job begins", extra=about)
        title = f"attempt {number} of {ATTEMPTS} on {name}"
        outcome = await child.run(step.function, arguments, log=file, timeout_s=step.timeout_s, title=title)
        shown = {key: outcome.get(key) for key in ("status", "reason", "seconds")}
        log.info("job ends", extra={**about, **shown})
        return outcome

    @DBOS.workflow(name="job", max_recovery_attempts=RECOVERIES)
    async def job(spec: Any, queue: str) -> Any:
        for number in range(1, ATTEMPTS + 1):
            options = {"name": f"attempt {number}", "preemptible": True}
            outcome: StepOutcome = await DBOS.run_step_async(options, attempt, spec, number)  # type: ignore[call-overload]
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
        return await function(FlowScope(url), **arguments)


def check_queues(queues: Sequence[str]) -> tuple[str, ...]:
    """Return the names of queues. Raises InputError for one that does not exist."""
    for name in queues:
        if name not in QUEUES:
            raise InputError(
                "There is no such queue",
                where="--queue",
                expected=", ".join(QUEUES),
                got=name,
                fix="choose one of these",
            )
    return tuple(queues)
