"""Pictures and reports of jobs, for the pages: a report runs in a sandbox, without the service's origin."""

import re
from base64 import b64decode
from binascii import Error as Base64Error
from dataclasses import dataclass
from functools import lru_cache, partial
from html import unescape
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Depends
from fastapi import Path as PathParameter
from starlette.responses import Response

from registration.errors import InputError
from registration.storage.reading import read_bytes
from workflows.engine.reader import JobRow
from workflows.service.access import need
from workflows.service.api.jobs import find_entry
from workflows.service.middleware import SANDBOX
from workflows.service.problems import Problem
from workflows.service.results import JobResults, results_of
from workflows.service.state import Service, ServiceState

router = APIRouter(include_in_schema=False, dependencies=[Depends(need("viewer"))])
MAX_PAGE_BYTES = 256 * 2**20  # of a report
_KEEP = {"Cache-Control": "private, max-age=86400, immutable"}  # an address names the content
_IMAGE = re.compile(rb'<img\b[^>]*?\balt="([^"]*)"[^>]*?\bsrc="data:image/(jpeg|png);base64,([A-Za-z0-9+/=]+)"')


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A picture of a report."""

    caption: str  # its alternative text
    kind: str  # jpeg or png
    content: bytes


def picture_url(job: str, number: int, version: str) -> str:
    """Return the address of a picture of a job's report."""
    return f"/files/picture/{number}/{quote(job)}?v={quote(version[:16])}"


def thumbnail_url(job: str, version: str) -> str:
    """Return the address of a job's thumbnail."""
    return f"/files/thumbnail/{quote(job)}?v={quote(version[:16])}"


def report_url(job: str, version: str) -> str:
    """Return the address of a job's report."""
    return f"/files/report/{quote(job)}?v={quote(version[:16])}"


@router.get("/files/thumbnail/{job:path}")
def thumbnail(state: Service, job: str) -> Response:
    """Return a picture of the head."""
    found = results(state, job).thumbnail
    if found is None:
        raise Problem.missing("picture", job)
    return Response(_read(state, found, 4 * 2**20), media_type="image/jpeg", headers=_KEEP)


@router.get("/files/report/{job:path}")
def report(state: Service, job: str) -> Response:
    """Return the report of a registration."""
    content = _read(state, results(state, job).report)
    return Response(content, media_type="text/html", headers={**_KEEP, **SANDBOX})


@router.get("/files/picture/{number}/{job:path}")
def picture(state: Service, job: str, number: Annotated[int, PathParameter(ge=0, le=10_000)]) -> Response:
    """Return a picture of a report."""
    found = pictures(state, results(state, job).report)
    if number >= len(found):
        raise Problem.missing("picture", f"{number}")
    return Response(found[number].content, media_type=f"image/{found[number].kind}", headers=_KEEP)


def results(state: ServiceState, job: str) -> JobResults:
    """Return where the files of a job are. Raises Problem, 404, if it has none."""
    found = results_of(state, row_of(state, job))
    if found is None:
        raise Problem.missing("result", job)
    return found


def row_of(state: ServiceState, job: str) -> JobRow:
    """Return the row of a job on the board. Raises Problem, 404, if there is none."""
    find_entry(state, job)
    row = state.reader.rows([job]).get(job)
    if row is None:
        raise Problem.missing("job", job, "see the overview")
    return row


def pictures(state: ServiceState, report: Path) -> tuple[Picture, ...]:
    """Return the pictures of a report, in its order; none if there is no report that can be read."""
    try:
        stamp = report.stat()
        return _pictures(state, report, stamp.st_mtime_ns, stamp.st_size)
    except (OSError, Problem):
        return ()


@lru_cache(maxsize=4)
def _pictures(state: ServiceState, report: Path, written_ns: int, size: int) -> tuple[Picture, ...]:
    found = []
    for alt, kind, content in _IMAGE.findall(_read(state, report)):
        try:
            found.append(Picture(caption=unescape(alt.decode()), kind=kind.decode(), content=b64decode(content)))
        except (Base64Error, UnicodeDecodeError):
            continue
    return tuple(found)


def _read(state: ServiceState, file: Path, max_bytes: int = MAX_PAGE_BYTES) -> bytes:
    """The content of a result's file, which must not lead elsewhere by a link. Raises Problem."""
    refuse = partial(InputError, "The file cannot be read", where=file.name, fix="see the job's log")
    try:
        place = state.places.of_row(str(file), file.name)
        return read_bytes(Path(place), refuse, max_bytes=max_bytes)
    except (InputError, Problem):
        raise Problem.missing("file", file.name, "see the job's log") from None
