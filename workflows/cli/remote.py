"""Commands that talk to a service instead of a farm's queue: `--server URL` (docs/service.md)."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from workflows.cli.options import NOT_SET, OptionalFile

if TYPE_CHECKING:
    from registration.options import RegisterOptions
    from workflows.cli.coregister import RoundOptions
    from workflows.service.client import ServiceClient

MAX_JOBS = 100  # that are listed


@dataclass(frozen=True, kw_only=True)
class ServerOptions:
    """A service to talk to, instead of a farm's queue.

    Attributes:
        server: URL of a service that `gnmreg serve` runs. Its token is in the environment variable GNMREG_TOKEN.
        token_file: A file with the token instead.
    """

    server: Annotated[str | None, arg(metavar="URL", help_behavior_hint=NOT_SET)] = None
    token_file: OptionalFile = None

    def client(self) -> "ServiceClient":
        """Return the client. Raises InputError for a URL or token that cannot be used."""
        from workflows.service.client import ServiceClient, read_token

        return ServiceClient(self.server or "", read_token(self.token_file))


@dataclass(frozen=True, kw_only=True)
class UploadOptions(ServerOptions):
    """A service to submit to, instead of a farm's queue.

    Attributes:
        replace: With --server: replace uploaded captures of the same names that have other contents.
    """

    replace: bool = False


NO_SERVER, NO_UPLOAD = ServerOptions(), UploadOptions()


def batch(
    server: UploadOptions, captures: Sequence[str], model: str, out: str, run: str | None, fit: "RegisterOptions"
) -> int:
    """Submit a batch; captures of this machine that the service does not see are uploaded first."""
    from workflows.farm.batch import expand
    from workflows.ids import redact
    from workflows.service.client import ServiceRefusal

    client = server.client()
    roots = tuple(client.get("/places")["roots"])
    words, failed = list[str](), list[str]()
    for word in (word for typed in captures for word in expand(typed)):
        folder = Path(word).resolve()
        if "://" in word or not (folder / "capture.toml").is_file() or _is_below(folder, roots):
            words.append(word if "://" in word or not folder.exists() else str(folder))
            continue
        subject, name = folder.parts[-2:]
        try:
            sent = client.upload(subject, name, folder, replace=server.replace)
        except ServiceRefusal as refusal:
            failed.append(f"bad input, left out: {redact(word)}: {refusal.line}")
            continue
        print(f"{subject}/{name}: {'uploaded' if sent else 'is there already'}", flush=True)
        words.append(f"{subject}/{name}")
    for line in failed:
        print(line, file=sys.stderr)
    if not words:
        return 2
    body = {"captures": words, "model": _absolute(model), "out": out, "run": run, "options": _options(fit)}
    done = client.post("/batches", body)
    return 1 if _say(done) or failed else 0


def coregister(
    server: ServerOptions, dataset: str, model: str, out: str, rounds: "RoundOptions", fit: "RegisterOptions"
) -> int:
    """Submit a coregistration of a dataset that the service sees."""
    from dataclasses import asdict

    places = {"dataset": _absolute(dataset), "model": _absolute(model), "out": out}
    body = {**places, "run": Path(out).name, "options": _options(fit)}
    done = server.client().post("/coregistrations", {**body, **_rounds(asdict(rounds))})
    return 1 if _say(done) else 0


def status(server: ServerOptions, run: str | None, listed: dict[str, Any] | None, limit: int | None) -> int:
    """Print runs with their counts, or jobs."""
    client = server.client()
    if listed is not None:
        number = 0
        for number, job in enumerate(client.jobs(run=run, **listed), 1):
            if limit != 0 and number > (limit or MAX_JOBS):
                break
            print(f"{job['id']}  {job['state']}  {job['status']}" + (f"  {job['reason']}" if job["reason"] else ""))
        return 0
    for shown in client.get("/runs") if run is None else [client.get(f"/runs/{run}")]:
        counts = ", ".join(f"{count} {state}" for state, count in sorted(shown["counts"].items())) or "no jobs yet"
        print(
            f"{shown['id']}: {shown['kind'] or 'jobs'}: {counts}" + (f"; {shown['reason']}" if shown["reason"] else "")
        )
    return 0


def logs(server: ServerOptions, job: str) -> int:
    """Print a job's state and its output."""
    from urllib.parse import quote

    client = server.client()
    shown = client.get(f"/jobs/{quote(job)}")
    print(f"{shown['id']}: {shown['state']}" + (f" on {shown['executor']}" if shown["executor"] else ""))
    if shown["reason"]:
        print(f"{shown['status']}: {shown['reason']}")
    for part in client.log(job):
        print(part, end="")
    return 0


def act(server: ServerOptions, action: str, run: str, done: str, **body: Any) -> int:
    """Cancel or retry a run or a part of it, and print how many jobs that were."""
    print(f"{server.client().post(f'/{action}', {'run': run, **body})['count']} {done}")
    return 0


def _say(done: dict[str, Any]) -> bool:
    """Print what is in the queue now; return whether something was left out."""
    print(f"{done['run']}: {done['total']} captures are in the queue: {done['new']} new,", end=" ")
    print(f"{done['again']} again, {done['waiting']} waiting or running already\n{done['out']}", flush=True)
    for name, reason in done["left_out"].items():
        print(f"bad input: {name}: {reason}", file=sys.stderr)
    return bool(done["left_out"])


def _options(fit: "RegisterOptions") -> dict[str, Any]:
    """Registration options as the API takes them: those that differ from the defaults."""
    from dataclasses import fields

    from registration.options import RegisterOptions

    default = RegisterOptions()
    names = [item.name for item in fields(RegisterOptions)]
    return {name: getattr(fit, name) for name in names if getattr(fit, name) != getattr(default, name)}


def _rounds(rounds: dict[str, Any]) -> dict[str, Any]:
    """Options of rounds as the API takes them."""
    from registration.errors import InputError

    held_out = rounds.pop("held_out")
    if (thresholds := rounds.pop("gate_thresholds")) is not None:
        raise InputError(
            "Thresholds of the gate cannot be sent",
            where="--gate-thresholds",
            expected="those of the farm",
            got=thresholds,
            fix="save them as gate/thresholds.json in the farm's folder",
        )
    try:
        fraction = None if held_out is None else float(held_out)
    except ValueError:
        fix = "tag the subjects' neutrals with held_out = true"
        raise InputError(
            "A list of held-out subjects cannot be sent",
            where="--held-out",
            expected="a fraction",
            got=held_out,
            fix=fix,
        ) from None
    return {**rounds, "components": list(rounds["components"]), "held_out": fraction}


def _absolute(place: str) -> str:
    """A path of this machine in full, which the service may see, too; else the word as it is: a name, or a URL."""
    return str(Path(place).resolve()) if Path(place).exists() else place


def _is_below(folder: Path, roots: Sequence[str]) -> bool:
    return any(folder.is_relative_to(root) for root in roots if root.startswith("/"))
