"""Tokens of people and programs: random, with roles; only their hashes are kept."""

import fcntl
import hashlib
import os
import re
import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from registration.errors import InputError
from registration.storage.records import Record

Role = Literal["viewer", "operator", "reviewer"]
ROLES: tuple[Role, ...] = get_args(Role)
FILE = "tokens.json"
_PREFIX = "gnmreg"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@ -]{0,63}")
_DAY_S = 24 * 3600.0


@dataclass(frozen=True, kw_only=True)
class Token:
    """A token as it is kept: without its secret.

    Attributes:
        id: part of the token that names it.
        name: of the person or program, for logs.
        roles: what it may do; each includes `viewer`.
        sha256: of the secret. A secret of 256 random bits needs no slow hash: there is nothing to guess.
        created: seconds since 1970.
        expires: seconds since 1970; None: never.
    """

    id: str
    name: str
    roles: tuple[Role, ...]
    sha256: str
    created: float
    expires: float | None = None

    def allows(self, role: Role) -> bool:
        """Return whether the token has a role."""
        return role == "viewer" or role in self.roles


@dataclass(frozen=True, kw_only=True)
class TokenFile(Record, kind="gnm-tokens", title="file of tokens", fix="create tokens with `gnmreg token create`"):
    """The tokens of a farm."""

    tokens: tuple[Token, ...] = ()


class Tokens:
    """The tokens of a farm, read again whenever their file changes."""

    def __init__(self, state: Path) -> None:
        """`state`: folder of the service's state; it is created, for its owner only, with the first token."""
        self._file = state / FILE
        self._read: tuple[tuple[int, int], TokenFile] | None = None

    def all(self) -> tuple[Token, ...]:
        """Return the tokens. Raises InputError for a damaged file."""
        try:
            stat = self._file.stat()
        except FileNotFoundError:
            return ()
        stamp = stat.st_mtime_ns, stat.st_ino
        if self._read is None or self._read[0] != stamp:
            self._read = stamp, TokenFile.read(self._file)
        return self._read[1].tokens

    def create(self, name: str, roles: Sequence[Role], *, days: float | None = None) -> str:
        """Add a token and return it: it is shown this once.

        Raises:
            InputError: the name, a role or the number of days cannot be used, or the name exists.
        """
        if not _NAME.fullmatch(name):
            expected = "up to 64 letters, digits, spaces and . _ @ -"
            raise InputError("The token needs a name", where="--name", expected=expected, got=name or "nothing")
        if unknown := [role for role in roles if role not in ROLES] or not roles:
            raise InputError("There is no such role", where="--role", expected=", ".join(ROLES), got=unknown)
        if days is not None and not 0 < days <= 36_500:
            raise InputError("The token cannot last so long", where="--days", expected="1 to 36500", got=days)
        identity, secret, now = secrets.token_hex(4), secrets.token_urlsafe(32), time.time()
        token = Token(
            id=identity,
            name=name,
            roles=tuple(dict.fromkeys(roles)),
            sha256=_hash(secret),
            created=now,
            expires=None if days is None else now + days * _DAY_S,
        )
        with self._locked() as tokens:
            if any(known.name == name for known in tokens):
                fix = "revoke it first, or choose another name"
                raise InputError("The token exists", where="--name", expected="a new name", got=name, fix=fix)
            self._write((*tokens, token))
        return f"{_PREFIX}_{identity}_{secret}"

    def revoke(self, name: str) -> None:
        """Remove the token of a name. Raises InputError if there is none."""
        with self._locked() as tokens:
            kept = tuple(token for token in tokens if token.name != name)
            if len(kept) == len(tokens):
                known = ", ".join(token.name for token in tokens) or "none"
                raise InputError("There is no such token", where="NAME", expected=known, got=name)
            self._write(kept)

    def find(self, text: str) -> Token | None:
        """Return the valid token that a request gave; None if there is none."""
        prefix, _, rest = text.partition("_")
        identity, _, secret = rest.partition("_")
        token = self.by_id(identity) if prefix == _PREFIX else None
        matches = secrets.compare_digest(token.sha256 if token else _hash(""), _hash(secret))
        return token if token is not None and matches else None

    def by_id(self, identity: str) -> Token | None:
        """Return the token of an id that has not expired or been revoked."""
        token = next((token for token in self.all() if token.id == identity), None)
        expired = token is not None and token.expires is not None and token.expires < time.time()
        return None if expired else token

    @contextmanager
    def _locked(self) -> Iterator[tuple[Token, ...]]:
        self._file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(self._file.with_suffix(".lock"), os.O_CREAT | os.O_RDWR, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield self.all()
        finally:
            os.close(descriptor)

    def _write(self, tokens: tuple[Token, ...]) -> None:
        before = os.umask(0o077)
        try:
            replace(TokenFile(), tokens=tokens).write(self._file)
        finally:
            os.umask(before)
        self._read = None


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
