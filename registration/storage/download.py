"""Downloads over HTTP: of a known size limit, resumed where the server can, checked for completeness."""

import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

_TIMEOUT_S = 30
_ATTEMPTS = 4  # an interrupted transfer is continued so often
_BLOCK_BYTES = 2**18
_AGENT = "gnm-registration"


class DownloadError(Exception):
    """A file could not be downloaded; the message says why."""


def download(
    url: str, to: Path, *, max_bytes: int, progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Write the file at an address to `to`.

    A transfer that breaks off is continued where it ended if the server states a version of the file (an ETag), so
    that parts of two versions are never joined; else it starts again.

    Args:
        url: http or https; redirections are followed.
        to: path of the new file. After an error its content is undefined.
        max_bytes: a larger file is refused.
        progress: called with the bytes that have arrived and their total, 0 if unknown.

    Raises:
        DownloadError: there is no connection, the server refuses, or the file is incomplete or too large.
    """
    to.write_bytes(b"")
    version: str | None = None
    for attempt in range(_ATTEMPTS):
        try:
            version = _transfer(url, to, version, max_bytes, progress)
            return
        except urllib.error.HTTPError as error:
            raise DownloadError(f"{error.code} {error.reason}") from error
        except urllib.error.URLError as error:  # no connection at all
            raise DownloadError(f"{type(error.reason).__name__}: {error.reason}") from error
        except _Interrupted as error:
            version = error.version
            if attempt == _ATTEMPTS - 1:
                raise DownloadError(str(error)) from error
        except (OSError, ValueError, http.client.HTTPException) as error:  # ValueError: no address
            raise DownloadError(f"{type(error).__name__}: {error}") from error


class _Interrupted(Exception):
    def __init__(self, got: str, version: str | None) -> None:
        super().__init__(got)
        self.version = version


def _transfer(
    url: str, to: Path, version: str | None, max_bytes: int, progress: Callable[[int, int], None]
) -> str | None:
    """Transfer what is missing of the file. Raises _Interrupted if it breaks off."""
    have = to.stat().st_size if version is not None else 0
    headers = {"User-Agent": _AGENT, "Accept-Encoding": "identity"}
    if have and version is not None:
        headers |= {"Range": f"bytes={have}-", "If-Range": version}
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S) as response:
        version = response.headers.get("ETag")
        version = None if version is None or version.startswith("W/") else version  # a weak one is not of the bytes
        have = have if response.status == http.HTTPStatus.PARTIAL_CONTENT else 0
        length = response.headers.get("Content-Length")
        total = have + int(length) if length is not None and length.isdigit() else 0
        with to.open("r+b") as file:
            file.truncate(have)
            file.seek(have)
            try:
                while block := response.read(_BLOCK_BYTES):
                    have += file.write(block)
                    if max(have, total) > max_bytes:
                        raise DownloadError(f"{max(have, total)} bytes, more than {max_bytes}")
                    progress(have, total)
            except (http.client.HTTPException, ConnectionError, TimeoutError) as error:
                raise _Interrupted(
                    f"{type(error).__name__} after {have} of {total or 'unknown'} bytes", version
                ) from error
            os.fsync(file.fileno())
        if total and have != total:
            raise _Interrupted(f"{have} of {total} bytes arrived", version)
    return version
