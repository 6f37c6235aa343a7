"""Serve, a coordinator and two workers as separate processes, killed in turn, on SQLite and on a real PostgreSQL.

Light steps stand in for registrations: `make test-durability`. A viewer follows the events all the time, as a browser
does: it connects again after every end, with the id of the last event.
"""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from tests.conftest import ROOT
from tests.workflows.farm.harness import Farm
from workflows.engine.jobs import DRIVER, FlowJob, Job
from workflows.service.tokens import Tokens

pytestmark = pytest.mark.durability
JOBS = 40


class Serve:
    """The command `gnmreg serve`, started again whenever it ends, as a supervisor does."""

    def __init__(self, farm: Farm) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.token = Tokens(farm.folder / "service").create("viewer", ["viewer"])
        self._farm, self._end = farm, False
        self._process = self._start()
        self._thread = threading.Thread(target=self._supervise)
        self._thread.start()

    def kill(self) -> None:
        self._process.kill()

    def get(self, path: str) -> tuple[int, bytes]:
        """The answer to a request; status 0: nobody answers."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        try:
            connection.request("GET", path, headers={"Authorization": f"Bearer {self.token}"})
            response = connection.getresponse()
            return response.status, response.read()
        except OSError:
            return 0, b""
        finally:
            connection.close()

    def close(self) -> None:
        self._end = True
        self._process.send_signal(signal.SIGTERM)
        assert self._process.wait(30.0) == -signal.SIGTERM  # once requests have ended
        self._thread.join()

    def _start(self) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", "workflows.cli", "serve", "--folder", str(self._farm.folder)]
        command += ["--port", str(self.port), "--db", "GNMREG_DB"]
        with (self._farm.folder / "serve.out").open("ab") as out:
            environment = {**os.environ, "GNMREG_DB": self._farm.url}
            return subprocess.Popen(command, cwd=ROOT, stdout=out, stderr=out, env=environment)

    def _supervise(self) -> None:
        while not self._end:
            if self._process.poll() is not None and not self._end:
                self._process = self._start()
            time.sleep(0.2)


class Viewer:
    """A reader of events that connects again, and loads the list again when it is asked to."""

    def __init__(self, serve: Serve) -> None:
        self.states: dict[str, str] = {}
        self.connections = 0
        self._serve, self._end, self._last = serve, False, ""
        self._thread = threading.Thread(target=self._follow)
        self._thread.start()

    def close(self) -> None:
        self._end = True
        self._thread.join()

    def _follow(self) -> None:
        while not self._end:
            try:
                self._read()
            except (OSError, http.client.HTTPException):
                time.sleep(0.2)

    def _read(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self._serve.port, timeout=2)
        headers = {"Authorization": f"Bearer {self._serve.token}", "Last-Event-ID": self._last}
        connection.request("GET", "/api/v1/events?run=run", headers=headers)
        stream = connection.getresponse()
        if stream.status != 200:
            raise OSError(stream.status)
        self.connections += 1
        if not self._last:
            self._load()  # after the connection: what changes meanwhile is an event
        event: dict[str, str] = {}
        while not self._end:
            raw = stream.readline()
            if not raw.endswith(b"\n"):
                raise OSError("the stream has ended, perhaps within an event, which does not count then")
            name, _, value = raw.decode().rstrip("\n").partition(": ")
            if name:
                event[name] = value
            elif event:
                self._take(event)
                event = {}

    def _take(self, event: dict[str, str]) -> None:
        self._last = event.get("id", self._last)
        if event.get("event") == "job":
            entry = json.loads(event["data"])
            self.states[entry["id"]] = entry["state"]
        elif event.get("event") == "reset":
            self._load()

    def _load(self) -> None:
        status, body = self._serve.get("/api/v1/jobs?run=run&limit=500")
        if status not in (200, 404):  # 404: there is no such run yet
            self._last = ""  # load it with the next connection
            raise OSError(status)
        self.states |= {job["id"]: job["state"] for job in json.loads(body).get("jobs", ())}


def work(farm: Farm, number: int) -> Job:
    identity = f"run/s{number:02d}"
    arguments = {"store": f"{farm.folder}/store", "key": identity, "seconds": 1.0, "trace": str(farm.trace)}
    return Job(id=identity, step="work", arguments=arguments)


def test_each_process_is_killed_in_turn_and_nothing_is_lost(farm: Farm) -> None:
    farm.start("w0", "w1", "c0")
    serve = Serve(farm)
    farm.wait_until(lambda: serve.get("/readyz")[0] == 200, what="serve to answer")
    viewer = Viewer(serve)
    try:
        farm.wait_until(lambda: viewer.connections == 1, what="the viewer to connect")
        farm.queue.submit([work(farm, number) for number in range(JOBS)])
        farm.queue.submit([FlowJob(id="run", flow="batch", queue=DRIVER)])
        for name in ("serve", "w0", "c0", "serve", "w1"):
            time.sleep(3.0)
            if name == "serve":
                serve.kill()
                back_s = farm.wait_until(lambda: serve.get("/api/v1/runs")[0] == 200, what="serve to come back")
                print(f"serve answers again after {back_s:.1f} s")
            else:
                farm.kill(name)
                farm.start(name)
        farm.wait_for_end("run")
        ids = {work(farm, number).id for number in range(JOBS)}
        assert {farm.job(identity)["state"] for identity in ids} == {"done"}
        assert farm.lines("end").total() <= JOBS + 2  # the two jobs in flight may have been repeated
        assert {line.split()[1] for line in farm.lines("end")} == ids
        unseen = lambda: sorted(identity for identity in ids if viewer.states.get(identity) != "done")  # noqa: E731
        try:
            farm.wait_until(lambda: not unseen(), within_s=20.0, what="the viewer to have seen every end")
        except AssertionError:
            raise AssertionError([(name, viewer.states.get(name)) for name in unseen()]) from None
        assert viewer.connections >= 3
    finally:
        viewer.close()
        serve.close()
