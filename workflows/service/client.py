"""A client of the service for programs and for the command line: `gnmreg ... --server URL`."""

import hashlib
import http.client
import json
import os
import secrets
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote, urlencode, urlsplit

from registration.errors import InputError
from workflows.service.archives import digest_of_files, files_of

API = "/api/v1"
TOKEN = "GNMREG_TOKEN"  # name of the environment variable
TIMEOUT_S = 900.0  # the doctor may take minutes
_CHUNK = 2**20


class ServiceClient:
    """Requests to one service."""

    def __init__(self, url: str, token: str) -> None:
        """`url`: as http://127.0.0.1:8080; `token`: as `gnmreg token create` prints it. Raises InputError."""
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname or parts.username:
            raise _unusable(url, expected="http://HOST:PORT or https://HOST", got=repr(parts.scheme))
        self.url, self._parts, self._token = url.rstrip("/"), parts, token

    def get(self, path: str, **query: Any) -> Any:
        """Return the JSON at a path below /api/v1. Raises InputError as `request`."""
        chosen = {name: value for name, value in query.items() if value is not None}
        return self.request("GET", f"{path}?{urlencode(chosen)}" if chosen else path)

    def post(self, path: str, body: Mapping[str, Any]) -> Any:
        """Send JSON, once: a lost answer is asked for again under the same key. Raises InputError as `request`."""
        headers = {"Idempotency-Key": secrets.token_hex(16), "Content-Type": "application/json"}
        content = json.dumps(body).encode()
        try:
            return self.request("POST", path, content, headers)
        except LostAnswer:
            return self.request("POST", path, content, headers)

    def upload(self, subject: str, name: str, folder: Path, *, replace: bool = False) -> bool:
        """Upload a capture, unless the service has the same one. Return whether it was sent.

        Args:
            subject: name of the subject's folder.
            name: name of the capture's folder.
            folder: the capture.
            replace: another capture of this name.

        Raises:
            InputError: as `request`; another capture has the name.
        """
        path = f"/captures/{quote(subject, safe='')}/{quote(name, safe='')}"
        files = files_of(folder)
        try:
            known = self.get(path)["upload"]
        except ServiceRefusal as refusal:
            if refusal.status != 404:
                raise
        else:
            if known is not None and known["digest"] == digest_of_files({n: _digest(p) for n, p in files.items()}):
                return False
        with tempfile.TemporaryFile() as archive:
            with tarfile.open(fileobj=archive, mode="w") as tar:  # images are compressed already
                for inside, file in files.items():
                    tar.add(file, inside, recursive=False, filter=_plain)
            length = archive.tell()
            archive.seek(0)
            query = "?replace=true" if replace else ""
            self.request("PUT", path + query, archive, {"Content-Length": str(length)})
        return True

    def jobs(self, **query: Any) -> Iterator[dict[str, Any]]:
        """Yield jobs, those that need a look first; `query`: run, state, status, subject, text."""
        offset = 0
        while page := self.get("/jobs", **query, offset=offset, limit=500)["jobs"]:
            yield from page
            offset += len(page)

    def log(self, job: str) -> Iterator[str]:
        """Yield the output of a job, in parts."""
        offset = 0
        while (part := self.get(f"/logs/{quote(job)}", offset=offset))["next_offset"] > offset:
            offset = part["next_offset"]
            yield part["text"]

    def request(
        self, method: str, path: str, body: bytes | IO[bytes] | None = None, headers: Mapping[str, str] | None = None
    ) -> Any:
        """Return the JSON of an answer; None for an empty one. No redirection is followed: the token stays here.

        Raises:
            ServiceRefusal: the service refuses the request; with what, where, expected, got and fix.
            InputError: nothing answers at the URL, or no service. LostAnswer: the connection ended too early.
        """
        secure = self._parts.scheme == "https"
        connect = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        connection = connect(str(self._parts.hostname), self._parts.port, timeout=TIMEOUT_S, blocksize=_CHUNK)
        sent = {"Authorization": f"Bearer {self._token}", "Accept": "application/json", **(headers or {})}
        try:
            try:
                connection.connect()
            except OSError as error:
                raise _unusable(self.url, expected="a service that answers", got=str(error)) from None
            place = f"{self._parts.path.rstrip('/')}{API}{path}"
            try:
                connection.request(method, place, body=body, headers=sent)
            except (BrokenPipeError, ConnectionResetError):
                pass  # a service that refuses a body need not read it: the answer says why
            response = connection.getresponse()
            content = response.read()
        except (http.client.HTTPException, ConnectionError, TimeoutError) as error:
            raise LostAnswer(self.url, error) from None
        finally:
            connection.close()
        kind = response.headers.get_content_type()
        if kind == "application/problem+json":
            raise ServiceRefusal(response.status, json.loads(content), self.url)
        if response.status >= 300 or (content and kind != "application/json"):
            raise _unusable(self.url, expected="a service of gnmreg", got=f"status {response.status}, {kind}")
        return json.loads(content) if content else None


class LostAnswer(InputError):
    """A connection ended before the answer: the request may have been done."""

    def __init__(self, url: str, error: Exception) -> None:
        got, fix = f"{type(error).__name__}: {error}", "repeat the command: what was done is not done twice"
        super().__init__("The service's answer was lost", where=url, expected="an answer", got=got, fix=fix)


class ServiceRefusal(InputError):
    """The service refuses a request."""

    def __init__(self, status: int, problem: Mapping[str, Any], url: str) -> None:
        parts = {name: str(problem.get(name, "")) for name in ("where", "expected", "got", "fix")}
        super().__init__(
            str(problem.get("detail", "The request is refused")), **{**parts, "where": parts["where"] or url}
        )
        self.status = status


def read_token(file: Path | None) -> str:
    """Return the token in a file, or in the environment variable GNMREG_TOKEN. Raises InputError without one."""
    try:
        token = os.environ.get(TOKEN, "") if file is None else file.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("The token cannot be read", where=file, expected="a text file", got=error) from None
    if not token.strip().isascii() or not token.strip().isprintable() or not token.strip():
        fix = "create one with `gnmreg token create` on the service's machine"
        expected = f"a token in the environment variable {TOKEN}, or in --token-file"
        raise InputError("The service needs a token", where=file or TOKEN, expected=expected, got="none", fix=fix)
    return token.strip()


def _plain(info: tarfile.TarInfo) -> tarfile.TarInfo:
    """An entry without owners and times."""
    info.uid = info.gid = 0
    info.uname = info.gname = ""
    info.mtime = 0
    return info


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _unusable(url: str, *, expected: str, got: str) -> InputError:
    fix = "see that `gnmreg serve` runs there, and its --host and --port"
    return InputError("The service cannot be used", where=url, expected=expected, got=got, fix=fix)
