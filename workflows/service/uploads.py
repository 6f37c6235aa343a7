"""Uploaded captures: received and unpacked beside, checked by the doctor, then renamed into place at once.

<farm>/captures/SUBJECT/NAME/                 a capture
<farm>/captures/.incoming/SUBJECT@NAME/       an upload in progress, which its process locks
<farm>/service/captures/SUBJECT/NAME.json     what the doctor said
"""

import fcntl
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from pathlib import Path

from registration.errors import InputError
from registration.storage.files import exchange
from registration.storage.records import Record
from workflows.ids import check_id
from workflows.service.archives import digest_of_files, files_of, unpack
from workflows.service.library_process import LibraryProcess
from workflows.service.problems import Problem
from workflows.service.settings import CAPTURES, ServiceSettings

_INCOMING, _LOCK, _ARCHIVE, _UNPACKED = ".incoming", "lock", "archive", "unpacked"
_TOML = "capture.toml"


@dataclass(frozen=True, kw_only=True)
class UploadRecord(Record, kind="gnm-upload", title="record of an upload", fix="upload the capture again"):
    """What is known of an uploaded capture."""

    created: float  # seconds since 1970
    by: str  # name of the token
    digest: str  # of names and contents of the files, `digest_of_files`
    bytes: int  # of the files
    folder: int  # number of the folder on its disk: the record of a folder that was replaced does not count
    subject: str  # as the capture says
    expression: str
    views: int
    warnings: tuple[str, ...] = field(default=())  # of the doctor


@dataclass(frozen=True, kw_only=True)
class Incoming:
    """The folder of an upload in progress."""

    folder: Path
    subject: str
    name: str

    @property
    def archive(self) -> Path:
        """The file to receive."""
        return self.folder / _ARCHIVE

    @property
    def title(self) -> str:
        """What messages call the capture."""
        return f"{self.subject}/{self.name}"


class Uploads:
    """The uploaded captures of a farm."""

    def __init__(self, settings: ServiceSettings) -> None:
        """Nothing is read yet."""
        self.folder = settings.folder.resolve() / CAPTURES
        self.limits = settings.uploads
        self._records = settings.state / CAPTURES
        self._incoming = self.folder / _INCOMING
        self._library = LibraryProcess("workflows.service.examining")

    def start(self) -> None:
        """Delete what uploads have left that ended with their process."""
        for path in self._incoming.glob("*") if self._incoming.is_dir() else ():
            with suppress(Problem), self._locked(path):
                pass

    def stop(self) -> None:
        """Stop the doctor."""
        self._library.stop()

    def names(self, subject: str | None = None) -> list[tuple[str, str]]:
        """Return subject and name of all captures, sorted."""
        subjects = [self.folder / subject] if subject is not None else self.folder.glob("[!.]*")
        captures = [path.parent for folder in subjects for path in folder.glob(f"[!.]*/{_TOML}")]
        return sorted((path.parent.name, path.name) for path in captures)

    def find(self, subject: str, name: str) -> Path | None:
        """Return the folder of a capture; None if there is none. Raises Problem for a name that cannot be one."""
        check_name(subject, name)
        path = self.folder / subject / name
        return path if (path / _TOML).is_file() else None

    def record(self, subject: str, name: str) -> UploadRecord | None:
        """Return the record of a capture; None for one that was put there in another way, or changed since."""
        file = self._records / subject / f"{name}.json"
        try:
            record = UploadRecord.read(file) if file.is_file() else None
            folder = (self.folder / subject / name).stat().st_ino
        except (InputError, OSError):
            return None
        return record if record is not None and record.folder == folder else None

    @contextmanager
    def claim(self, subject: str, name: str) -> Iterator[Incoming]:
        """Yield the new folder of an upload, which is deleted in the end.

        Raises:
            Problem: 422 for a name that cannot be used; 409 if the capture is being uploaded or deleted.
        """
        check_name(subject, name)
        folder = self._incoming / f"{subject}@{name}"
        with self._locked(folder):
            yield Incoming(folder=folder, subject=subject, name=name)

    def accept(self, incoming: Incoming, by: str) -> UploadRecord:
        """Unpack and check what was received, then rename it into place; an existing capture is replaced.

        Raises:
            InputError: the archive is refused (`TooLarge` for its size), or holds no capture.
            Problem: 422 if the doctor finds errors.
        """
        unpacked = incoming.folder / _UNPACKED
        digests = unpack(incoming.archive, unpacked, self.limits)
        incoming.archive.unlink()
        root = _root(unpacked, incoming)
        found = self._library.call("examine", folder=str(root), name=incoming.title)
        if found["errors"]:
            raise _refusal(found["errors"])
        prefix = root.relative_to(unpacked).as_posix()
        inside = {name.removeprefix(f"{prefix}/"): digest for name, digest in digests.items()}
        record = UploadRecord(
            created=time.time(),
            by=by,
            digest=digest_of_files(inside),
            bytes=sum(path.stat().st_size for path in files_of(root).values()),
            folder=root.stat().st_ino,
            subject=found["subject"],
            expression=found["expression"],
            views=found["views"],
            warnings=tuple(found["warnings"]),
        )
        target = self.folder / incoming.subject / incoming.name
        target.parent.mkdir(exist_ok=True)
        file = self._records / incoming.subject / f"{incoming.name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        record.write(file)  # before the rename: it counts for this very folder only
        exchange(root, target)
        return record

    def delete(self, incoming: Incoming) -> None:
        """Delete a capture; `incoming`: its claim."""
        target = self.folder / incoming.subject / incoming.name
        os.replace(target, incoming.folder / _UNPACKED)
        (self._records / incoming.subject / f"{incoming.name}.json").unlink(missing_ok=True)
        with suppress(OSError):  # other captures
            target.parent.rmdir()

    @contextmanager
    def _locked(self, folder: Path) -> Iterator[None]:
        """Hold the lock of a folder, which is empty at first and deleted in the end. Raises Problem if it is held."""
        while True:
            folder.mkdir(parents=True, exist_ok=True)
            try:
                descriptor = os.open(folder / _LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
            except FileNotFoundError:  # the last holder deletes the folder now
                continue
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                got = folder.name.replace("@", "/")
                raise _conflict("The capture is being uploaded or deleted", got, fix="wait for the other one") from None
            if _is_same(descriptor, folder / _LOCK):
                break
            os.close(descriptor)
        try:
            for path in folder.iterdir():
                if path.name != _LOCK:
                    _remove(path)
            yield
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(descriptor)


def check_name(subject: str, name: str) -> None:
    """Raise Problem if a capture cannot be called so."""
    try:
        if "/" in subject or "/" in name:
            raise Problem.missing("capture", f"{subject}/{name}", "list them at /api/v1/captures")
        check_id(f"{subject}/{name}")
    except InputError as error:
        raise Problem(
            HTTPStatus.UNPROCESSABLE_ENTITY,
            "The capture cannot be called so",
            where="SUBJECT/NAME",
            expected="two names of letters, digits, '.', '_' and '-', not starting with a dot",
            got=error.got,
            fix="rename the capture",
        ) from None


def refuse_existing(title: str) -> Problem:
    """Return the refusal of an upload whose capture exists."""
    fix = "upload it with ?replace=true, or under another name"
    return _conflict("The capture exists", title, fix=fix)


def refuse_used(title: str, job: str) -> Problem:
    """Return the refusal to change a capture that a job reads."""
    return _conflict("A job that waits or runs reads the capture", title, fix=f"cancel {job} first, or wait")


def _conflict(what: str, title: str, *, fix: str) -> Problem:
    return Problem(HTTPStatus.CONFLICT, what, where="SUBJECT/NAME", got=title, fix=fix)


def _root(unpacked: Path, incoming: Incoming) -> Path:
    """The capture's folder in what was unpacked: that itself, or the only folder in it."""
    found = [path for path in unpacked.iterdir() if path.is_dir()]
    for folder in (unpacked, *(found if len(found) == 1 else ())):
        if (folder / _TOML).is_file():
            return folder
    raise InputError(
        "There is no capture in the archive",
        where=incoming.title,
        expected=f"{_TOML}, or one folder with it",
        got="none",
        fix="import other formats with `gnmreg capture import` first",
    )


def _refusal(errors: list[dict[str, str]]) -> Problem:
    first, *others = errors
    what = first.pop("what")
    more = [InputError(error.pop("what"), **error).line for error in others] or None
    problem = Problem.of_input(InputError(what, **first))
    problem.details.more = more
    return problem


def _is_same(descriptor: int, file: Path) -> bool:
    try:
        return os.fstat(descriptor).st_ino == file.stat().st_ino
    except FileNotFoundError:
        return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
