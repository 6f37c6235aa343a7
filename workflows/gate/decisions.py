"""The log of persons' decisions at the gate: `FARM/gate/decisions.jsonl`, append-only, chained and signed.

    <farm>/gate/decisions.jsonl   one entry a line; each holds the sha256 of the line before it and a signature
    <farm>/gate/key               Ed25519 private key, PEM, readable by its owner only; made at the first decision
    <farm>/gate/key.pub           the public key, PEM
    <farm>/gate/lock              the lock of writers

An entry is written in one call and flushed to the disk. A line that a crash has left unfinished was never confirmed to
anybody: readers refuse it, `repair` puts it aside.
"""

import fcntl
import hashlib
import json
import os
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Literal

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from registration.errors import InputError
from registration.storage.files import atomic_file, naming_full_disk
from registration.storage.reading import open_file, read_bytes
from registration.storage.records import Record
from workflows.gate.rules import FOLDER, Level

LOG, KEY, PUBLIC_KEY, LOCK = "decisions.jsonl", "key", "key.pub", "lock"
START = "0" * 64  # the previous hash of the first entry
MAX_BYTES = 2**30  # of a log: more than a million decisions
MAX_REASON = 2000  # letters
Choice = Literal["accept", "reject", "undo"]


@dataclass(frozen=True, kw_only=True)
class DecisionEntry(
    Record,
    title="log of the gate's decisions",
    fix="restore the file from a backup: an entry is never changed or removed",
):
    """A line of the log."""

    sequence: int  # from 1
    time: str  # UTC
    who: str
    content_id: str  # of the registration
    name: str  # of the registration when it was decided, for people
    decision: Choice
    reason: str
    thresholds: str  # content id of the thresholds at the time
    verdict: Level  # of the rules at the time
    previous: str  # sha256 of the line before
    signature: str = ""  # Ed25519, hexadecimal, over all the other fields

    def signed_bytes(self) -> bytes:
        """Return what the signature is over."""
        return _canonical(replace(self, signature=""))

    def line(self) -> bytes:
        """Return the line of the log, without its end."""
        return _canonical(self)


@dataclass(frozen=True, kw_only=True)
class Head:
    """The last entry of a log, by which a copy that lacks entries at its end is recognized."""

    sequence: int = 0
    sha256: str = START


@dataclass(frozen=True, kw_only=True)
class Ruling:
    """What is decided about a registration, as `DecisionLog.append` takes it."""

    content_id: str
    name: str
    decision: Choice
    reason: str
    who: str
    thresholds: str
    verdict: Level


class DecisionLog:
    """The log in a folder. Several processes and threads may append at the same time."""

    def __init__(self, folder: Path) -> None:
        """Nothing is read or created yet. `folder`: `FARM/gate`."""
        self.folder = Path(folder)
        self.file = self.folder / LOG
        self._entries: list[DecisionEntry] = []  # verified before
        self._offset, self._head = 0, Head()
        self._guard = threading.RLock()  # of these

    @classmethod
    def of_farm(cls, farm: Path) -> "DecisionLog":
        """Return the log of a farm's folder."""
        return cls(Path(farm) / FOLDER)

    def exists(self) -> bool:
        """Return whether anything was decided yet."""
        return os.path.lexists(self.file)

    def append(self, ruling: Ruling) -> DecisionEntry:
        """Append a decision, signed, and flush it to the disk; the key pair is made if there is none.

        Raises:
            InputError: the log is damaged, a part of the decision is empty or too long, or there is nothing to undo.
        """
        _check(ruling)
        with self._guard, self._locked():
            key = self._private_key()
            entries = self._take(self._new_bytes() if self.exists() else b"")
            if ruling.decision == "undo" and ruling.content_id not in current(entries):
                raise InputError(
                    "There is no decision to undo",
                    where=ruling.name,
                    expected="a decision that is not undone yet",
                    got="none",
                    fix="see `gnmreg gate verdicts`",
                )
            entry = DecisionEntry(
                sequence=self._head.sequence + 1,
                time=datetime.now(UTC).isoformat(timespec="milliseconds"),
                previous=self._head.sha256,
                **vars(ruling),
            )
            entry = replace(entry, signature=key.sign(entry.signed_bytes()).hex())
            self._write(entry.line() + b"\n")
            self._take(self._new_bytes())
        return entry

    def read(self) -> tuple[DecisionEntry, ...]:
        """Return all entries, verified: the chain, the numbers, the signatures, and that every undo has its decision.

        Entries that this object has verified before are not read again; `verify` reads everything.

        Raises:
            InputError: the log is damaged; the message says where, and how to repair a line that is not finished.
        """
        with self._guard:
            if not self.exists() and not self._offset:
                return ()
            content = self._new_bytes()
            if content and not content.endswith(b"\n"):
                with self._locked(fcntl.LOCK_SH):  # a writer may be at work
                    content = self._new_bytes()
            return self._take(content)

    def _new_bytes(self) -> bytes:
        """What was added to the log since it was read."""
        with open_file(self.file, partial(DecisionEntry.invalid, self.file), max_bytes=MAX_BYTES) as stream:
            size = stream.seek(0, os.SEEK_END)
            if size < self._offset:
                raise DecisionEntry.invalid(self.file, expected=f"at least {self._offset} bytes", got=f"{size}")
            stream.seek(self._offset)
            return stream.read(size - self._offset)

    def _take(self, content: bytes) -> tuple[DecisionEntry, ...]:
        """Verify new bytes of the log; return all entries."""
        if content:
            entries, self._head = _verified(content, self._head, self.file, self._public_key())
            self._entries += entries
            current(self._entries, self.file)
            self._offset += len(content)
        return tuple(self._entries)

    def verify(self) -> Head:
        """Read and check the whole log again, and return its head. Raises as `read`."""
        with self._guard:
            self._entries, self._offset, self._head = [], 0, Head()
            self.read()
            return self._head

    @property
    def head(self) -> Head:
        """The last entry that was read."""
        return self._head

    def repair(self) -> Path | None:
        """Put an unfinished last line aside into a file of its own, whose path is returned; None: there is none.

        Raises:
            InputError: the log is damaged in another way.
        """
        if not self.exists():
            return None
        with self._locked():
            content = read_bytes(self.file, partial(DecisionEntry.invalid, self.file), max_bytes=MAX_BYTES)
            whole = content.rfind(b"\n") + 1
            if whole == len(content):
                return None
            _verified(content[:whole], Head(), self.file, self._public_key())
            aside = self.file.with_name(f"{LOG}.unfinished-{hashlib.sha256(content[whole:]).hexdigest()[:8]}")
            with atomic_file(aside) as temporary:
                temporary.write_bytes(content[whole:])
            os.truncate(self.file, whole)
        return aside

    @contextmanager
    def _locked(self, kind: int = fcntl.LOCK_EX) -> Iterator[None]:
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / LOCK).open("a") as lock:
            fcntl.flock(lock, kind)
            yield

    def _write(self, line: bytes) -> None:
        with naming_full_disk(self.file):
            descriptor = os.open(self.file, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                before = os.fstat(descriptor).st_size
                try:
                    written = os.write(descriptor, line)
                    if written < len(line):
                        os.write(descriptor, line[written:])  # raises on a full disk
                    os.fsync(descriptor)
                except OSError:
                    os.ftruncate(descriptor, before)
                    raise
            finally:
                os.close(descriptor)

    def _private_key(self) -> Ed25519PrivateKey:
        file = self.folder / KEY
        if not os.path.lexists(file):
            if self.exists():
                raise _key_error(file, "the key that signed the log's entries", "no such file")
            _make_keys(self.folder)
        refuse = partial(_key_error, file)
        try:
            key = serialization.load_pem_private_key(read_bytes(file, refuse, max_bytes=4096), None)
        except (ValueError, TypeError, UnsupportedAlgorithm) as error:
            raise refuse(expected="an Ed25519 private key as PEM", got=type(error).__name__) from None
        if not isinstance(key, Ed25519PrivateKey):
            raise refuse(expected="an Ed25519 private key as PEM", got="another kind of key")
        if os.stat(file).st_mode & 0o077:
            raise refuse(expected="a file that only its owner can read", got="one that others can read")
        return key

    def _public_key(self) -> Ed25519PublicKey:
        return read_public_key(self.folder / PUBLIC_KEY)


def read_log(file: Path, key: Path | None = None) -> tuple[DecisionEntry, ...]:
    """Return the verified entries of a log anywhere, such as a copy.

    Args:
        file: the log.
        key: the public key; None: `key.pub` beside the log.

    Raises:
        InputError: as `DecisionLog.read`.
    """
    content = read_bytes(Path(file), partial(DecisionEntry.invalid, file), max_bytes=MAX_BYTES)
    if not content:
        return ()
    entries, _ = _verified(content, Head(), file, read_public_key(key or Path(file).with_name(PUBLIC_KEY)))
    current(entries, file)
    return tuple(entries)


def current(entries: Iterable[DecisionEntry], where: object = LOG) -> dict[str, DecisionEntry]:
    """Return content id -> the decision that holds: an undo restores what held before the last decision.

    Raises:
        InputError: an undo without a decision. `where` names the log.
    """
    stacks: dict[str, list[DecisionEntry]] = {}
    for entry in entries:
        stack = stacks.setdefault(entry.content_id, [])
        if entry.decision != "undo":
            stack.append(entry)
        elif stack:
            stack.pop()
        else:
            place = f"{where}, line {entry.sequence}"
            raise DecisionEntry.invalid(place, expected="a decision that can be undone", got="undo")
    return {content_id: stack[-1] for content_id, stack in stacks.items() if stack}


def read_public_key(file: Path) -> Ed25519PublicKey:
    """Read the public key of a log. Raises InputError if there is none."""
    refuse = partial(_key_error, file)
    try:
        key = serialization.load_pem_public_key(read_bytes(Path(file), refuse, max_bytes=4096))
    except (ValueError, UnsupportedAlgorithm) as error:
        raise refuse(expected="an Ed25519 public key as PEM", got=type(error).__name__) from None
    if not isinstance(key, Ed25519PublicKey):
        raise refuse(expected="an Ed25519 public key as PEM", got="another kind of key")
    return key


def _canonical(entry: DecisionEntry) -> bytes:
    return json.dumps(entry.to_json(), sort_keys=True, separators=(",", ":")).encode("ascii")


def _verified(content: bytes, head: Head, file: object, key: Ed25519PublicKey) -> tuple[list[DecisionEntry], Head]:
    """The entries in these bytes of a log, which follow the entry `head`, and the last of them."""
    *lines, rest = content.split(b"\n")
    if rest:
        raise InputError(
            "The last line of the log of the gate's decisions is not finished",
            where=f"{file}, line {head.sequence + len(lines) + 1}",
            expected="complete lines",
            got=f"{len(rest)} bytes of a line, as after a crash while it was written",
            fix="`gnmreg gate verify --repair` puts them aside; no decision that was confirmed is lost",
        )
    entries = []
    for line in lines:
        place = f"{file}, line {head.sequence + 1}"
        entry = DecisionEntry.from_text(line, where=place)
        if entry.sequence != head.sequence + 1:
            raise DecisionEntry.invalid(place, expected=f"entry {head.sequence + 1}", got=f"entry {entry.sequence}")
        if entry.previous != head.sha256:
            got = "that of another line: one was changed, removed or added"
            raise DecisionEntry.invalid(place, expected="the hash of the line before", got=got)
        try:
            key.verify(bytes.fromhex(entry.signature), entry.signed_bytes())
        except (InvalidSignature, ValueError):
            raise DecisionEntry.invalid(place, expected="a signature of the log's key", got="another") from None
        entries.append(entry)
        head = Head(sequence=entry.sequence, sha256=hashlib.sha256(line).hexdigest())
    return entries, head


def _make_keys(folder: Path) -> None:
    """Write the public key, then the private key, which only its owner may read at any time."""
    key = Ed25519PrivateKey.generate()
    public = key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with atomic_file(folder / PUBLIC_KEY) as temporary:
        temporary.write_bytes(public)
    with atomic_file(folder / KEY) as temporary:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(private)


def _key_error(file: object, expected: object, got: object) -> InputError:
    fix = "restore the key that was made with the log; without it no decision can be added to this log"
    return InputError.unreadable("key of the gate's decisions", where=file, expected=expected, got=got, fix=fix)


def _check(ruling: Ruling) -> None:
    limits: Mapping[str, int] = {"content_id": 200, "name": 1000, "who": 200, "reason": MAX_REASON}
    for name, most in limits.items():
        value = getattr(ruling, name)
        if len(value) > most or (not value.strip() and name != "reason"):
            raise InputError(
                "The decision cannot be recorded",
                where=name,
                expected=f"1 to {most} letters" if name != "reason" else f"at most {most} letters",
                got=f"{len(value)} letters",
            )
