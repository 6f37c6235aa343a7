"""Archives from anyone, tar, tar.gz or zip: unpacked into a new folder, within limits, or refused.

Nothing is created but folders and regular files below the folder. Memory does not grow with the archive: headers are
read one by one, and limits apply before anything is read or written.
"""

import errno
import gzip
import hashlib
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from tarfile import BLOCKSIZE, HeaderError, TarInfo
from typing import IO

from registration.errors import InputError
from registration.storage.files import naming_full_disk
from registration.storage.reading import MAX_NAME_BYTES
from registration.terminal import printable
from workflows.service.settings import UploadLimits

MAX_DEPTH, MAX_PATH_BYTES = 16, 1024  # of a name in an archive
_CHUNK = 2**20
_MAX_HEADER = 2**20  # bytes of one extended header of a tar
_FREE_BYTES = 2**20  # that may be unpacked whatever the ratio: text compresses well
_REGULAR, _FOLDER = (b"0", b"\0", b"7"), b"5"  # types of tar headers
_LONG_NAME, _LONG_LINK, _EXTENDED, _GLOBAL = b"L", b"K", b"x", b"g"
_SPARSE = "GNU.sparse"  # begin of keys in an extended header
_BROKEN = (gzip.BadGzipFile, zlib.error, EOFError, zipfile.BadZipFile, struct.error, ValueError, RuntimeError)


class TooLarge(InputError):
    """An archive exceeds a limit."""


@dataclass(frozen=True)
class Member:
    """A folder or file in an archive."""

    name: str
    size: int = 0
    is_folder: bool = False
    read: Callable[[int], bytes] = field(default=lambda count: b"")  # the next bytes of the file, at most so many


def unpack(archive: Path, folder: Path, limits: UploadLimits) -> dict[str, str]:
    """Unpack an archive into a folder that is created.

    Args:
        archive: a tar, tar.gz or zip file.
        folder: must not exist. After an error it holds what was unpacked until then.
        limits: of entries and bytes.

    Returns:
        Name -> sha256 of every file.

    Raises:
        InputError: the file is no such archive, is damaged or incomplete, or has an entry that is neither file nor
            folder, or a name that leaves the folder, occurs twice or cannot be printed.
        TooLarge: a limit is exceeded.
    """
    packed = archive.stat().st_size
    allowed = min(limits.max_unpacked_bytes, max(_FREE_BYTES, int(limits.max_ratio * packed)))
    writer = _Writer(folder, allowed)
    folder.mkdir()
    with archive.open("rb") as stream, _naming_damage():
        start = stream.read(BLOCKSIZE)
        stream.seek(0)
        if start.startswith(b"PK"):
            members = _zip_members(stream, limits)
        elif start.startswith(b"\x1f\x8b"):
            members = _tar_members(_Forward(gzip.GzipFile(fileobj=stream), allowed, limits), limits)
        elif start[257:262] == b"ustar" or not any(start[:1]):
            members = _tar_members(_Forward(stream, allowed, limits), limits)
        else:
            raise _refused("the archive", expected="a tar, tar.gz or zip", got=f"a file that begins with {start[:6]!r}")
        for member in members:
            writer.write(member)
    return writer.digests


def digest_of_files(digests: Mapping[str, str]) -> str:
    """Return the digest of a folder: of the names and sha256 of its files."""
    lines = [f"{name} {digest}\n" for name, digest in sorted(digests.items())]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def files_of(folder: Path) -> dict[str, Path]:
    """Return name -> path of the regular files below a folder, sorted; links are left out."""
    paths = sorted(path for path in folder.rglob("*") if not path.is_symlink() and path.is_file())
    return {path.relative_to(folder).as_posix(): path for path in paths}


class _Writer:
    """Creates the files of an archive below a folder."""

    def __init__(self, folder: Path, allowed: int) -> None:
        self._folder, self._left = folder, allowed
        self._allowed = allowed
        self._folders: set[tuple[str, ...]] = {()}
        self.digests: dict[str, str] = {}

    def write(self, member: Member) -> None:
        parts = _checked_parts(member.name)
        if not parts and member.is_folder:
            return  # the folder itself
        name = "/".join(parts)
        if not parts or name in self.digests or (parts in self._folders and not member.is_folder):
            raise _refused(member.name, expected="each name once", got="a name that occurs twice")
        if member.size > self._left:
            raise self._too_large()
        for depth in range(1, len(parts) + member.is_folder):
            self._make(parts[:depth])
        if not member.is_folder:
            with naming_full_disk(self._folder / name):
                self.digests[name] = self._copy(member, self._folder / name)

    def _make(self, parts: tuple[str, ...]) -> None:
        if parts in self._folders:
            return
        if "/".join(parts) in self.digests:
            raise _refused("/".join(parts), expected="each name once", got="a file and a folder of one name")
        with naming_full_disk(self._folder):
            self._folder.joinpath(*parts).mkdir()
        self._folders.add(parts)

    def _copy(self, member: Member, file: Path) -> str:
        digest = hashlib.sha256()
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
        with os.fdopen(descriptor, "wb") as target:
            while part := member.read(_CHUNK):
                self._left -= len(part)
                if self._left < 0:
                    raise self._too_large()
                digest.update(part)
                target.write(part)
        return digest.hexdigest()

    def _too_large(self) -> TooLarge:
        return _too_large("unpacked bytes", self._allowed)


def _checked_parts(name: str) -> tuple[str, ...]:
    """The parts of a name in an archive, without "."."""
    path = PurePosixPath(name)
    wrong = ""
    if path.is_absolute():
        wrong = "an absolute name"
    elif ".." in path.parts:
        wrong = 'a name with ".."'
    elif not name.isprintable() or "\\" in name:
        wrong = "a name with control characters or backslashes"
    elif len(path.parts) > MAX_DEPTH or len(name.encode()) > MAX_PATH_BYTES:
        wrong = "a longer name"
    elif any(len(part.encode()) > MAX_NAME_BYTES for part in path.parts):
        wrong = "a longer name"
    if wrong:
        raise _refused(name, expected="printable names inside the capture's folder, at most 1024 bytes", got=wrong)
    return path.parts


class _Forward:
    """Bytes of a stream from its begin to its end, of bounded number."""

    def __init__(self, stream: IO[bytes] | gzip.GzipFile, allowed: int, limits: UploadLimits) -> None:
        self._stream = stream
        self._left = allowed + limits.max_entries * 8 * BLOCKSIZE  # headers and padding
        self._allowed = allowed

    def read(self, count: int) -> bytes:
        """Return so many bytes. Raises InputError if there are fewer."""
        part = self._stream.read(count)
        self._left -= len(part)
        if self._left < 0:
            raise _too_large("unpacked bytes", self._allowed)
        if len(part) < count:
            raise _refused("the archive", expected="a complete archive", got="one that ends too early")
        return part


def _tar_members(stream: _Forward, limits: UploadLimits) -> Iterator[Member]:
    """The entries of a tar: POSIX, GNU and old ones. Headers are read as `tarfile` does, but of bounded size."""
    extended: dict[str, str] = {}
    entries = headers = 0
    while any(header := stream.read(BLOCKSIZE)):  # the end is marked by a block of zeros
        try:
            info = TarInfo.frombuf(header, "utf-8", "surrogateescape")
        except HeaderError:
            raise _refused("the archive", expected="tar headers", got="a damaged header") from None
        size = int(extended.get("size", info.size))
        headers += 1
        if headers > 4 * limits.max_entries:
            raise _too_large("entries", limits.max_entries)
        if info.type in (_LONG_NAME, _LONG_LINK, _EXTENDED, _GLOBAL):
            if not 0 <= info.size <= _MAX_HEADER:
                raise _too_large("bytes of a header", _MAX_HEADER)
            content = stream.read(_padded(info.size))[: info.size]
            if info.type == _LONG_NAME:
                extended["path"] = content.rstrip(b"\0").decode("utf-8", "surrogateescape")
            elif info.type == _EXTENDED:
                extended |= _records(content)
            continue
        name, extended, sparse = extended.get("path", info.name), {}, any(k.startswith(_SPARSE) for k in extended)
        entries += 1
        if entries > limits.max_entries:
            raise _too_large("entries", limits.max_entries)
        if info.type not in (*_REGULAR, _FOLDER) or sparse:
            raise _refused(name, expected="files and folders", got=_kind(info.type))
        is_folder = info.type == _FOLDER or name.endswith("/")  # old tars mark folders so
        if size < 0 or (is_folder and size):
            raise _refused(name, expected="a folder without content", got=f"{size} bytes")
        file = _TarFile(stream, size)
        yield Member(name=name, size=size, is_folder=is_folder, read=file.read)
        file.skip()


class _TarFile:
    """The content of one file in a tar."""

    def __init__(self, stream: _Forward, size: int) -> None:
        self._stream, self.left, self._padding = stream, size, _padded(size) - size

    def read(self, count: int) -> bytes:
        part = self._stream.read(min(count, self.left))
        self.left -= len(part)
        return part

    def skip(self) -> None:
        while self.left:
            self.read(_CHUNK)
        self._stream.read(self._padding)


def _zip_members(file: IO[bytes], limits: UploadLimits) -> Iterator[Member]:
    if (count := _zip_count(file, limits)) > limits.max_entries:
        raise _too_large("entries", limits.max_entries, str(count))
    with zipfile.ZipFile(file) as archive:
        for info in archive.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)
            if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise _refused(info.orig_filename, expected="files and folders", got="a link or device")
            if info.flag_bits & 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                got = "encryption or another compression"
                raise _refused(info.orig_filename, expected="files stored or deflated", got=got)
            if info.is_dir():
                yield Member(name=info.orig_filename, is_folder=True)
                continue
            with archive.open(info) as stream:
                yield Member(name=info.orig_filename, size=info.file_size, read=stream.read)


def _zip_count(file: IO[bytes], limits: UploadLimits) -> int:
    """Entries of a zip's central directory, which is not read whole: its headers are counted where it says they lie.

    `zipfile` reads the whole directory, by its size, so that the size is limited, too.
    """
    record = zipfile._EndRecData(file)  # type: ignore[attr-defined]  # the very record that ZipFile will use
    if record is None:
        raise _refused("the archive", expected="a complete zip", got="one without a directory")
    stated, size, location = record[3], record[5], record[9]
    most = limits.max_entries * (46 + MAX_PATH_BYTES)
    if stated > limits.max_entries or size > most or size > location:
        return max(int(stated), limits.max_entries + 1)
    end = location - (76 if record[0] == b"PK\x06\x06" else 0)  # zip64 has two more records there
    position, count = end - size, 0
    while position < end and count <= limits.max_entries:
        file.seek(position)
        header = file.read(46)
        if header[:4] != b"PK\x01\x02":
            raise zipfile.BadZipFile("a damaged directory")
        position += 46 + sum(struct.unpack("<3H", header[28:34]))
        count += 1
    file.seek(0)
    return count


@contextmanager
def _naming_damage() -> Iterator[None]:
    """Turn what readers of archives raise into an `InputError`."""
    try:
        yield
    except _BROKEN as error:
        got = printable(f"{type(error).__name__}: {error}")[:200]
        raise _refused("the archive", expected="an undamaged, complete archive", got=got) from None
    except OSError as error:
        if error.errno != errno.EINVAL:  # of a position before the file's begin
            raise
        raise _refused("the archive", expected="an undamaged, complete archive", got="a wrong position") from None


def _records(content: bytes) -> dict[str, str]:
    """Those of the records `LENGTH KEY=VALUE` of an extended header that matter here. Raises ValueError."""
    found: dict[str, str] = {}
    position = 0
    while position < len(content):
        blank = content.index(b" ", position, position + 20)
        end = position + int(content[position:blank])
        if end <= blank or content[end - 1 : end] != b"\n":
            raise ValueError("a damaged extended header")
        key, _, value = content[blank + 1 : end - 1].partition(b"=")
        if key in (b"path", b"size") or key.startswith(_SPARSE.encode()):
            found[key.decode("utf-8", "replace")] = value.decode("utf-8", "surrogateescape")
        position = end
    return found


def _kind(code: bytes) -> str:
    names = {b"1": "a hard link", b"2": "a symbolic link", b"3": "a device", b"4": "a device", b"6": "a named pipe"}
    return names.get(code, "an entry of another kind")


def _padded(size: int) -> int:
    return -(-size // BLOCKSIZE) * BLOCKSIZE


def _refused(where: str, *, expected: str, got: str) -> InputError:
    fix = "pack the capture's folder with `tar -czf capture.tar.gz -C CAPTURE .`"
    return InputError("The archive is refused", where=where[:200], expected=expected, got=got, fix=fix)


def _too_large(what: str, most: int, got: str = "more") -> TooLarge:
    return TooLarge(
        "The archive is too large", where="the archive", expected=f"at most {most} {what}", got=got, fix="send less"
    )
