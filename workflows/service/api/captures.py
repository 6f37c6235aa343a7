"""Routes of uploaded captures: upload, list, show, delete."""

from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, cast

from anyio import CapacityLimiter, open_file
from anyio.to_thread import run_sync
from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, Field
from starlette.requests import ClientDisconnect

from registration.storage.files import naming_full_disk
from workflows.engine.reader import INTERRUPTED, RUNNING, WAITING
from workflows.service.access import need
from workflows.service.api.jobs import Limit, Offset
from workflows.service.archives import TooLarge, files_of
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service, ServiceState
from workflows.service.uploads import Incoming, UploadRecord, refuse_existing, refuse_used

router = APIRouter(tags=["captures"], responses=RESPONSES)
_VIEWER, _OPERATOR = Depends(need("viewer")), Depends(need("operator"))
_BUFFER = 2**20  # bytes that are written at once
_CHUNK = 500  # rows read at once
_UNPACKING = 2  # uploads that are unpacked and checked at the same time
_BODY = {
    "requestBody": {
        "description": "a tar, tar.gz or zip of the capture's folder",
        "required": True,
        "content": {
            kind: {"schema": {"type": "string", "format": "binary"}}
            for kind in ("application/x-tar", "application/gzip", "application/zip", "application/octet-stream")
        },
    }
}


class CaptureBrief(BaseModel):
    """A capture in a list."""

    subject: str
    name: str
    expression: str = Field(default="", description="empty for captures that were not uploaded")
    views: int = 0
    bytes: int = 0
    created: float | None = None
    warnings: int = Field(default=0, description="of the doctor")


class CapturePage(BaseModel):
    """A part of a list."""

    total: int
    offset: int
    captures: list[CaptureBrief]


class CaptureFile(BaseModel):
    """A file of a capture."""

    name: str
    bytes: int


class CaptureDetails(BaseModel):
    """A capture: its files, and what the doctor said when it was uploaded."""

    subject: str
    name: str
    path: str = Field(description="of its folder, for machines that share it")
    files: list[CaptureFile]
    upload: dict[str, Any] | None = Field(description="None: it was put there in another way, or changed since")


@router.get("/captures", dependencies=[_VIEWER])
def captures(
    state: Service,
    subject: Annotated[str | None, Query(max_length=100, pattern="^[A-Za-z0-9][A-Za-z0-9._-]*$")] = None,
    offset: Offset = 0,
    limit: Limit = 100,
) -> CapturePage:
    """List the uploaded captures."""
    names = state.uploads.names(subject)
    shown = [_brief(state, *pair) for pair in names[offset : offset + limit]]
    return CapturePage(total=len(names), offset=offset, captures=shown)


@router.get("/captures/{subject}/{name}", dependencies=[_VIEWER])
def capture(state: Service, subject: str, name: str) -> CaptureDetails:
    """Show a capture: its files and the doctor's warnings."""
    folder = _require(state, subject, name)
    files = [CaptureFile(name=key, bytes=path.stat().st_size) for key, path in files_of(folder).items()]
    record = state.uploads.record(subject, name)
    shown = None if record is None else {key: value for key, value in record.to_json().items() if key != "folder"}
    return CaptureDetails(subject=subject, name=name, path=str(folder), files=files, upload=shown)


@router.put("/captures/{subject}/{name}", status_code=201, dependencies=[_OPERATOR], openapi_extra=_BODY)
async def upload(state: Service, request: Request, subject: str, name: str, replace: bool = False) -> CaptureDetails:
    """Upload a capture as a tar, tar.gz or zip stream; it is there when the doctor has accepted it."""
    uploads = state.uploads
    with uploads.claim(subject, name) as incoming:
        if (folder := uploads.find(subject, name)) is not None:
            if not replace:
                raise refuse_existing(incoming.title)
            await run_sync(_refuse_used, state, folder, incoming)
        await _receive(request, incoming.archive, uploads.limits.max_bytes)
        await run_sync(_accept, state, incoming, request.state.identity.name, limiter=_limiter(request))
    return await run_sync(capture, state, subject, name)


@router.delete("/captures/{subject}/{name}", status_code=204, dependencies=[_OPERATOR])
def delete(state: Service, subject: str, name: str) -> Response:
    """Delete a capture that no waiting or running job reads."""
    folder = _require(state, subject, name)
    with state.uploads.claim(subject, name) as incoming:
        _refuse_used(state, folder, incoming)
        _require(state, subject, name)
        state.uploads.delete(incoming)
    return Response(status_code=204)


async def _receive(request: Request, file: Path, most: int) -> None:
    """Write the body of a request into a file. Raises Problem: 413 if it is too long, 400 if it is cut."""
    stated = request.headers.get("Content-Length", "0")
    received = int(stated) if stated.isdecimal() else 0
    if received > most:
        raise _too_long(most, stated)
    received, parts = 0, bytearray()
    with naming_full_disk(file):
        async with await open_file(file, "xb") as target:
            try:
                async for part in request.stream():
                    parts += part
                    received += len(part)
                    if received > most:
                        raise _too_long(most, "more")
                    if len(parts) >= _BUFFER:
                        await target.write(bytes(parts))
                        parts.clear()
            except ClientDisconnect:
                raise Problem(HTTPStatus.BAD_REQUEST, "The upload was cut", where="body", fix="send it again") from None
            await target.write(bytes(parts))


def _accept(state: ServiceState, incoming: Incoming, by: str) -> UploadRecord:
    try:
        return state.uploads.accept(incoming, by)
    except TooLarge as error:
        raise Problem.of_input(error, HTTPStatus.REQUEST_ENTITY_TOO_LARGE) from None


def _limiter(request: Request) -> CapacityLimiter:
    """At most two uploads are unpacked at once: other requests need the threads."""
    app = request.app.state
    if not hasattr(app, "unpacking"):
        app.unpacking = CapacityLimiter(_UNPACKING)  # belongs to the event loop
    return cast(CapacityLimiter, app.unpacking)


def _refuse_used(state: ServiceState, folder: Path, incoming: Incoming) -> None:
    """Raise Problem if a waiting or running job reads a capture."""
    for job, path in _read_by_jobs(state):
        if Path(path) == folder or folder.parent == Path(path):
            raise refuse_used(incoming.title, job)


def _read_by_jobs(state: ServiceState) -> Iterator[tuple[str, str]]:
    """Id of each active job, and the paths among its arguments."""
    active = [
        entry.id for entry in state.board.entries.values() if entry.times.state in (WAITING, RUNNING, INTERRUPTED)
    ]
    for start in range(0, len(active), _CHUNK):
        for identity, row in state.reader.rows(active[start : start + _CHUNK]).items():
            arguments = row.spec.get("arguments")
            for value in arguments.values() if isinstance(arguments, dict) else ():
                if isinstance(value, str) and value.startswith("/"):
                    yield identity, value


def _require(state: ServiceState, subject: str, name: str) -> Path:
    folder = state.uploads.find(subject, name)
    if folder is None:
        raise Problem.missing("capture", f"{subject}/{name}", "list them at /api/v1/captures")
    return folder


def _brief(state: ServiceState, subject: str, name: str) -> CaptureBrief:
    record = state.uploads.record(subject, name)
    if record is None:
        return CaptureBrief(subject=subject, name=name)
    return CaptureBrief(
        subject=subject,
        name=name,
        expression=record.expression,
        views=record.views,
        bytes=record.bytes,
        created=record.created,
        warnings=len(record.warnings),
    )


def _too_long(most: int, got: str) -> Problem:
    return Problem(
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
        "The upload is too large",
        where="body",
        expected=f"at most {most} bytes",
        got=got,
        fix="send fewer or smaller files",
    )
