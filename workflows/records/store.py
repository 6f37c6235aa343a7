"""Storage of artifacts below a folder or a URL of object storage, each under a key.

    <store>/<key>/artifact.json          the record: input hash and the digest of every file
    <store>/<key>/attempt-<uuid>/...     the files of the attempt that the record names
    <store>/<name>.html, <name>.csv      pages and tables about them

An attempt writes only below its own folder and is published by writing the record, which is atomic: two workers that
compute the same artifact do not interfere, and one that dies leaves files that `verify` lists as orphaned.
"""

import hashlib
import os
import posixpath
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import IO, Any

from registration.errors import InputError
from registration.storage.files import atomic_write_text, naming_full_disk
from registration.storage.reading import MAX_TEXT_BYTES, open_file, read_bytes
from registration.storage.records import Record
from workflows.ids import check_id, is_remote, redact, resolve_place
from workflows.records.remote import filesystem

MANIFEST = "artifact.json"
ATTEMPT = "attempt-"
PAGES = (".html", ".csv")  # endings of the files beside the artifacts
_BLOCK = 2**20


@dataclass(frozen=True, kw_only=True)
class StoredFile:
    """A file of an artifact."""

    sha256: str
    bytes: int


@dataclass(frozen=True, kw_only=True)
class Artifact(
    Record,
    kind="gnm-artifact",
    title="artifact",
    fix="`gnmreg store verify` lists damage; delete the record to have the artifact computed again",
):
    """The record of an artifact: `artifact.json`."""

    key: str
    input_hash: str  # of everything that determines the result
    content_id: str  # sha256 over the names and digests of the files
    attempt: str  # the folder of the files, below the key
    files: Mapping[str, StoredFile]  # by name below the attempt
    about: Mapping[str, Any]  # status, headline metrics and the like, small
    version: str = field(default_factory=partial(version, "gnm-registration"))  # of this package

    def brief(self) -> dict[str, Any]:
        """Return what a step reports to the queue."""
        return {"key": self.key, "content_id": self.content_id, "about": dict(self.about)}


@dataclass(frozen=True, kw_only=True)
class VerificationReport:
    """The result of `Store.verify`; names are relative to the store."""

    artifacts: int
    missing: tuple[str, ...] = ()
    altered: tuple[str, ...] = ()
    orphaned: tuple[str, ...] = ()  # files that no record names, including those of running attempts
    unreadable: Mapping[str, str] = field(default_factory=dict)  # record -> reason

    @property
    def is_sound(self) -> bool:
        """Whether all records are readable and all their files unchanged."""
        return not (self.missing or self.altered or self.unreadable)


class Store:
    """Artifacts below one folder or URL (`s3://bucket/prefix`)."""

    def __init__(self, url: str | Path) -> None:
        """Nothing is read or created yet. Raises InputError for a URL that cannot be used."""
        self.url = resolve_place(str(url), "store")
        self._fs, root = filesystem(self.url)
        self._root = root.rstrip("/")
        self.local = None if is_remote(self.url) else Path(root)

    def find(self, key: str) -> Artifact | None:
        """Return the published artifact of a key, or None.

        Raises:
            InputError: the record is malformed, or names a file outside its attempt.
        """
        path = self._path(key, MANIFEST)
        where = f"{self.url}/{key}/{MANIFEST}"
        if self.local is not None:
            if not os.path.lexists(path):
                return None
            content = read_bytes(Path(path), partial(Artifact.invalid, where))
        else:
            try:
                if (size := self._fs.size(path) or 0) > MAX_TEXT_BYTES:
                    raise Artifact.invalid(where, expected=f"at most {MAX_TEXT_BYTES} bytes", got=size)
                content = self._fs.cat_file(path)
            except FileNotFoundError:
                return None
        return _checked(content, where=where, key=key)

    def read(self, artifact: Artifact, name: str) -> bytes:
        """Return the content of a text file of an artifact, of at most `MAX_TEXT_BYTES`.

        Raises:
            InputError: the artifact names no such file, or it is missing, larger, or altered.
        """
        where = f"{self.url}/{artifact.key}/{artifact.attempt}/{name}"
        stored, path = artifact.files.get(name), self._path(artifact.key, artifact.attempt, name)
        if stored is None or stored.bytes > MAX_TEXT_BYTES:
            raise Artifact.invalid(
                where, expected="a text file of the artifact", got="none" if stored is None else "a larger one"
            )
        if self.local is not None:
            content = read_bytes(Path(path), partial(Artifact.invalid, where))
        else:
            try:
                content = self._fs.cat_file(path)
            except FileNotFoundError:
                raise Artifact.invalid(where, expected="a file of the artifact", got="no such file") from None
        if hashlib.sha256(content).hexdigest() != stored.sha256:
            raise Artifact.invalid(where, expected=f"sha256 {stored.sha256}", got="other content")
        return bytes(content)

    def open(self, artifact: Artifact, name: str) -> IO[bytes]:
        """Open a file of an artifact for reading; it can be positioned.

        Raises:
            InputError: the artifact names no such file, it is missing, or a link leads it out of the store.
        """
        where, path = f"{self.url}/{artifact.key}/{name}", self._path(artifact.key, artifact.attempt, name)
        refuse = partial(Artifact.invalid, where)
        if name not in artifact.files:
            raise refuse(expected="a file of the artifact", got="none")
        if self.local is not None:
            if os.path.realpath(path) != path:
                raise refuse(expected="a file in the store", got="a link")
            return open_file(Path(path), refuse)
        try:
            stream: IO[bytes] = self._fs.open(path, "rb")
        except FileNotFoundError:
            raise refuse(expected="a file of the artifact", got="no such file") from None
        return stream

    def produce(self, key: str, *, input_hash: str, make: Callable[[Path], Mapping[str, Any]]) -> Artifact:
        """Return the artifact of a key: the published one if it has this input hash, else a new one.

        Args:
            key: of the artifact.
            input_hash: of everything that determines the artifact.
            make: writes the files into the empty folder that it is given, and returns the record's `about`.

        Raises:
            InputError: the key is invalid, or the published record malformed.
        """
        published = self.find(check_id(key))
        if published is not None and published.input_hash == input_hash and self._is_complete(published):
            return published
        attempt = f"{ATTEMPT}{uuid.uuid4().hex}"
        if self.local is not None:
            folder = self.local / key / attempt
            try:
                with naming_full_disk(folder):
                    folder.mkdir(parents=True)
                    about = make(folder)
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)
                raise
            return self._publish(key, attempt, input_hash, folder, about)
        with tempfile.TemporaryDirectory(prefix="gnmreg-") as name:
            about = make(Path(name))
            for file in _files(Path(name)):
                self._fs.put_file(str(file), self._path(key, attempt, file.relative_to(name).as_posix()))
            return self._publish(key, attempt, input_hash, Path(name), about)

    def keys(self, below: str = "") -> Iterator[str]:
        """Yield the keys of the published artifacts at and below a key, sorted."""
        for name in sorted(self._names(below)):
            if posixpath.basename(name) == MANIFEST and not _in_attempt(name):
                yield posixpath.dirname(name)

    def require(self) -> None:
        """Raise InputError if there is no such folder or nothing below the URL, or it cannot be read."""
        try:
            got = "" if self._fs.isdir(self._root) else "a file" if self._fs.exists(self._root) else "nothing"
        except Exception as error:  # whatever the client of object storage raises
            got = redact(f"{type(error).__name__}: {error}".splitlines()[0])
        if got:
            raise InputError(
                "There is no store",
                where=self.url,
                expected="a folder, or a URL below which there are files",
                got=got,
                fix="correct the path or URL; keys of object storage come from the environment",
            )

    def verify(self) -> VerificationReport:
        """Read every file of the store and compare it with the records.

        Raises:
            InputError: a local store that is no folder.
        """
        if self.local is not None:
            self.require()
        names, missing, altered, unreadable = set(self._names()), [], [], {}
        manifests = {name for name in names if posixpath.basename(name) == MANIFEST and not _in_attempt(name)}
        known = set(manifests)
        for manifest in sorted(manifests):
            key = posixpath.dirname(manifest)
            try:
                artifact = self.find(key)
            except InputError as error:
                unreadable[manifest] = f"expected {error.expected}, got {error.got}"
                continue
            for name, stored in artifact.files.items() if artifact else ():
                path = posixpath.join(key, artifact.attempt, name) if artifact else ""
                known.add(path)
                if path not in names:
                    missing.append(path)
                elif self._digest_of(path) != stored.sha256:
                    altered.append(path)
        return VerificationReport(
            artifacts=len(manifests),
            missing=tuple(missing),
            altered=tuple(altered),
            orphaned=tuple(sorted(name for name in names - known if not _is_page(name))),
            unreadable=unreadable,
        )

    def tidy(self, older_than_s: float = 24 * 3600.0) -> int:
        """Delete the files of attempts that were not published or are superseded, and return their number.

        Younger files are kept: they may belong to a running job.
        """
        deleted = 0
        for name in self.verify().orphaned:
            if _in_attempt(name) and time.time() - self._written(name) > older_than_s:
                self._fs.rm_file(self._path(name))
                deleted += 1
        if self.local is not None:
            _remove_empty(self.local)
        return deleted

    def write_page(self, name: str, text: str) -> None:
        """Write a page or table about the artifacts beside them, in one write.

        Raises:
            InputError: the name is not that of a page.
            OSError: the store cannot be written to.
        """
        if not _is_page(name):
            raise InputError("The page cannot be written", where=name, expected="NAME.html or NAME.csv", got=name)
        if self.local is not None:
            self.local.mkdir(parents=True, exist_ok=True)
        self._write(self._path(name), text)

    def delete(self, below: str) -> int:
        """Delete all artifacts at and below a key, records first, and return their number."""
        keys = list(self.keys(check_id(below)))
        for key in keys:
            self._fs.rm_file(self._path(key, MANIFEST))
        if self._fs.exists(self._path(below)):
            self._fs.rm(self._path(below), recursive=True)
        return len(keys)

    def retire(self, run: str, keep: int) -> list[str]:
        """Delete the artifacts of a run's iterations (`it00`, `it01` ...) except the last `keep`; return their keys."""
        parts = {key.split("/")[1] for key in self.keys(run) if key.startswith(f"{run}/it")}
        old = sorted(parts)[: len(parts) - keep] if keep > 0 else []
        for part in old:
            self.delete(f"{run}/{part}")
        return [f"{run}/{part}" for part in old]

    def _publish(self, key: str, attempt: str, input_hash: str, folder: Path, about: Mapping[str, Any]) -> Artifact:
        files = {
            file.relative_to(folder).as_posix(): StoredFile(sha256=_digest(file.open("rb")), bytes=file.stat().st_size)
            for file in _files(folder)
        }
        artifact = Artifact(
            key=key,
            input_hash=input_hash,
            content_id=_content_id(files),
            attempt=attempt,
            files=files,
            about=dict(about),
        )
        self._write(self._path(key, MANIFEST), redact(artifact.to_text()))
        return artifact

    def _write(self, path: str, text: str) -> None:
        """Write a file atomically: object storage shows whole objects only, a folder needs a rename."""
        if self.local is None:
            self._fs.pipe_file(path, text.encode())
            return
        atomic_write_text(Path(path), text)

    def _is_complete(self, artifact: Artifact) -> bool:
        """Whether all files exist with their length; `verify` checks digests too."""
        try:
            return all(
                self._fs.size(self._path(artifact.key, artifact.attempt, name)) == stored.bytes
                for name, stored in artifact.files.items()
            )
        except FileNotFoundError:
            return False

    def _digest_of(self, name: str) -> str:
        """sha256 of a file; empty if it is no regular file that can be read."""
        if self.local is None:
            return _digest(self._fs.open(self._path(name), "rb"))
        try:
            return _digest(open_file(Path(self._path(name)), partial(Artifact.invalid, name)))
        except InputError:
            return ""

    def _names(self, below: str = "") -> Iterator[str]:
        self._fs.invalidate_cache()
        for path in self._fs.find(self._path(below)):
            yield path.removeprefix(self._root).lstrip("/")

    def _written(self, name: str) -> float:
        modified = self._fs.modified(self._path(name))
        return float(modified.timestamp())

    def _path(self, *parts: str) -> str:
        return "/".join((self._root, *(part for part in parts if part)))


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _digest(stream: Any) -> str:
    """sha256 of a stream of bytes, which is closed."""
    digest = hashlib.sha256()
    with stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _is_page(name: str) -> bool:
    return "/" not in name and name.endswith(PAGES)


def _in_attempt(name: str) -> bool:
    return any(part.startswith(ATTEMPT) for part in posixpath.dirname(name).split("/"))


def _content_id(files: Mapping[str, StoredFile]) -> str:
    lines = [f"{name} {stored.sha256}\n" for name, stored in sorted(files.items())]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _checked(content: bytes, *, where: str, key: str) -> Artifact:
    """The record in a file. Others may write into a store, so its names are checked like any other untrusted input."""
    artifact = replace(Artifact.from_text(content, where=where), key=key)
    for name in artifact.files:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or not path.parts or "\0" in name:
            raise Artifact.invalid(where, expected="names inside the attempt's folder", got=repr(name))
    if not artifact.attempt.startswith(ATTEMPT) or "/" in artifact.attempt:
        raise Artifact.invalid(where, expected=f'an attempt named "{ATTEMPT}..."', got=repr(artifact.attempt))
    if _content_id(artifact.files) != artifact.content_id:
        raise Artifact.invalid(where, expected=f"content id {artifact.content_id}", got="other files")
    return artifact


def _remove_empty(root: Path) -> None:
    for folder in sorted((path for path in root.rglob(f"{ATTEMPT}*") if path.is_dir()), reverse=True):
        for below in sorted((path for path in folder.rglob("*") if path.is_dir()), reverse=True):
            if not any(below.iterdir()):
                below.rmdir()
        if not any(folder.iterdir()):
            folder.rmdir()
