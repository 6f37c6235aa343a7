"""A queue whose rows pretend what workers did: captures that are done, failed, at work, or wait."""

import json
import random
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from workflows.engine.client import QueueClient
from workflows.engine.database import checked_url, engine, table
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.engine.liveness import FileLocks

EXPRESSIONS = ("neutral", "smile", "jaw_open", "brows_up", "lips_funnel")
ATTEMPT = "attempt-0"
FAILURES = (
    {
        "status": "bad input",
        "what": "The mask is empty",
        "where": "view cam03, masks/cam03.png",
        "expected": "some pixels of the subject",
        "got": "none",
        "fix": "draw the mask again",
        "reason": "The mask is empty: view cam03; expected some pixels of the subject, got none; draw the mask again",
    },
    {"status": "died", "reason": "its process was killed by SIGKILL", "attempts": 3},
    {"status": "timed out", "reason": "took longer than 10800 s and was killed"},
)


@dataclass(frozen=True, kw_only=True)
class Shares:
    """Fractions of the captures; the rest waits."""

    done: float = 0.6
    failed: float = 0.03
    running: int = 4  # captures


def fill(url: str, folder: Path, run: str, captures: int, *, shares: Shares = Shares(), seed: int = 0) -> list[str]:  # noqa: B008
    """Put a batch into the queue at `url`, whose captures are in all states; return the ids of its jobs.

    Args:
        url: of the queue, which `migrate` created.
        folder: of the results, which need not exist.
        run: name of the run.
        captures: number of them.
        shares: of the states.
        seed: of what is random.
    """
    chance, client = random.Random(seed), QueueClient(url)
    jobs = [_job(run, number, folder) for number in range(captures)]
    client.submit([FlowJob(id=run, flow="batch", queue=DRIVER), *jobs])
    client.close()
    ids = [job.id for job in jobs]
    done, failed = round(shares.done * captures), round(shares.failed * captures)
    now, changes = time.time(), []
    for number, identity in enumerate(ids[: done + failed]):
        end = now - (done + failed - number) * 60_000 / max(done, 1)
        times = {"started_at_epoch_ms": 1000 * (end - 30), "completed_at": 1000 * end, "executor_id": "lab-gpu0"}
        if number < done:
            changes.append({"id": identity, "status": "SUCCESS", **times, "output": result_text(chance), "error": None})
        else:
            error = json.dumps({"error": FAILURES[int(chance.random() ** 2 * len(FAILURES))]})
            changes.append({"id": identity, "status": "ERROR", **times, "output": None, "error": error})
    for number, identity in enumerate(ids[done + failed : done + failed + shares.running]):
        times = {"started_at_epoch_ms": 1000 * (now - 20), "completed_at": None, "executor_id": f"lab-gpu{number}"}
        changes.append({"id": identity, "status": "PENDING", **times, "output": None, "error": None})
    write(url, changes)
    return ids


def result_text(chance: random.Random) -> str:
    """Return the outcome of a registration as a row has it."""
    bad = chance.random() < 0.05
    verdict = {"level": "look", "reasons": ["normals are off in the images"]} if bad else {"level": "good"}
    scan = {"mean_mm": chance.lognormvariate(-1.9, 0.2), "median_mm": 0.1, "p95_mm": chance.lognormvariate(-0.6, 0.2)}
    about = {
        "status": "stopped" if bad and chance.random() < 0.5 else "converged",
        "reason": "vertices moved by 0.003 mm over the last tenth of the last stage",
        "figures": {
            "verdict": verdict,
            "residuals": {"overall": _residuals(chance, bad)},
            "scan_to_mesh": {"face": scan},
        },
        "seconds": 28.5,
        "thumbnail": True,
    }
    content = f"{chance.getrandbits(256):064x}"
    result = {"key": "", "content_id": content, "about": about, "attempt": ATTEMPT, "made": True}
    return json.dumps({"status": "done", "reason": "", "seconds": 30.0, "result": result})


def write_manifests(folder: Path, keys: Iterable[str], seed: int = 0) -> None:
    """Write the manifests of registrations that jobs have published; six views each.

    Args:
        folder: of the results.
        keys: of the jobs below it, SUBJECT/CAPTURE.
        seed: of what is random.
    """
    chance = random.Random(seed)
    for key in keys:
        views = {f"cam{view:02d}": _residuals(chance, bad=False) for view in range(6)}
        figures = {"residuals": {"overall": _residuals(chance, bad=chance.random() < 0.05), "views": views}}
        manifest = {"content_id": f"{chance.getrandbits(256):064x}", "status": "converged", "figures": figures}
        place = folder / key / ATTEMPT / "registration" / "manifest.json"
        place.parent.mkdir(parents=True)
        place.write_text(json.dumps(manifest))


def write(url: str, changes: Iterable[dict[str, Any]]) -> None:
    """Change rows: id, status, started_at_epoch_ms, completed_at, executor_id, output, error; in one transaction."""
    query = sa.text(
        f"UPDATE {table(url, 'workflow_status')} SET status = :status, started_at_epoch_ms = :started_at_epoch_ms, "
        "completed_at = :completed_at, executor_id = :executor_id, output = :output, error = :error, "
        "updated_at = :now WHERE workflow_uuid = :id"
    )
    values = [{"now": int(1000 * time.time()), **_whole(change)} for change in changes]
    database = engine(checked_url(url))
    with database.begin() as connection:
        connection.execute(query, values)
    database.dispose()


def pretend_workers(url: str, names: Sequence[str]) -> list[FileLocks]:
    """Return the locks by which processes of these names live as long as this one, or until they are collected."""
    locks = [FileLocks(url) for _ in names]
    for lock, name in zip(locks, names, strict=True):
        lock.take(name)
    return locks


def _residuals(chance: random.Random, bad: bool) -> dict[str, float]:
    return {
        "silhouette_px": chance.lognormvariate(-0.9, 0.25),
        "normals_deg": chance.lognormvariate(1.1, 0.2) * (3 if bad else 1),
        "colour_levels": chance.lognormvariate(1.6, 0.2),
        "landmarks_px": chance.lognormvariate(0.7, 0.3),
    }


def _whole(change: dict[str, Any]) -> dict[str, Any]:
    return {key: int(value) if isinstance(value, float) else value for key, value in change.items()}


def _job(run: str, number: int, folder: Path) -> Job:
    subject, expression = f"subject_{number // len(EXPRESSIONS):05d}", EXPRESSIONS[number % len(EXPRESSIONS)]
    arguments = {
        "capture": f"/data/captures/{subject}/{expression}",
        "model": "/data/model.npz",
        "store": str(folder),
        "key": f"{subject}/{expression}",
        "options": {"type": "RegisterOptions", "recipe": "draft", "seed": 0},
    }
    return Job(id=f"{run}/{subject}/{expression}", step="register_stored", arguments=arguments)
