"""Routes of results: their files by content id, with ranges; models and their evaluation."""

import re
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import PurePosixPath
from typing import IO, Annotated, Any

from fastapi import APIRouter, Depends, Header, Response
from pydantic import BaseModel, Field
from starlette.responses import StreamingResponse

from workflows.service.access import need
from workflows.service.artifacts import find_result
from workflows.service.middleware import SANDBOX
from workflows.service.models import find_model, list_models
from workflows.service.problems import RESPONSES, Problem
from workflows.service.state import Service

router = APIRouter(tags=["results"], dependencies=[Depends(need("viewer"))], responses=RESPONSES)
_CHUNK = 2**18
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".json": "application/json",
    ".csv": "text/csv; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
    ".mtl": "text/plain; charset=utf-8",
    ".obj": "text/plain; charset=utf-8",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".webp": "image/webp",
    ".webm": "video/webm",
    ".glb": "model/gltf-binary",
}
_FILE: dict[int | str, dict[str, Any]] = {
    status: {"description": text, "content": {"*/*": {"schema": {"type": "string", "format": "binary"}}}}
    for status, text in ((200, "the file"), (206, "a part of it"))
}


class ArtifactFile(BaseModel):
    """A file of a result."""

    name: str
    bytes: int
    type: str


class ArtifactDetails(BaseModel):
    """A published result."""

    content_id: str
    job: str
    about: dict[str, Any] = Field(description="status, reason and headline figures")
    files: list[ArtifactFile]


class Model(BaseModel):
    """A head model."""

    id: str = Field(description="to submit with")
    path: str
    bytes: int
    run: str = Field(description="of the coregistration that built it; empty for others")
    generalization_mm: dict[str, float] = Field(description="number of components -> error on held-out subjects")
    specificity_mm: dict[str, float]


class ModelDetails(Model):
    """A head model, with what the coregistration decided after its round."""

    verdict: dict[str, Any] | None


@router.get("/models")
def models(state: Service) -> list[Model]:
    """List the models in the farm's folder, and those that coregistrations built."""
    return [Model(**model.brief()) for model in list_models(state)]


@router.get("/models/{model:path}")
def model(state: Service, model: str) -> ModelDetails:
    """Show a model."""
    found = find_model(state, model)
    if found is None:
        raise Problem.missing("model", model, "list them at /api/v1/models")
    return ModelDetails(**found.brief(), verdict=None if found.verdict is None else dict(found.verdict))


@router.get("/artifacts/{content_id}")
def artifact(state: Service, content_id: str) -> ArtifactDetails:
    """List the files of a result."""
    found = find_result(state, content_id)
    files = [ArtifactFile(name=name, bytes=file.size, type=_type(name)) for name, file in sorted(found.files.items())]
    return ArtifactDetails(content_id=content_id, job=found.job, about=dict(found.about), files=files)


@router.get("/artifacts/{content_id}/{path:path}", response_class=StreamingResponse, responses=_FILE)
def artifact_file(
    state: Service, content_id: str, path: str, range_: Annotated[str, Header(alias="Range", max_length=200)] = ""
) -> Response:
    """Return a file of a result, or a range of it."""
    found = find_result(state, content_id)
    file = found.files.get(path)
    if file is None:
        raise Problem.missing("file of the artifact", path, f"list them at /api/v1/artifacts/{content_id}")
    headers = {"Accept-Ranges": "bytes", "ETag": f'"{content_id}"'}
    headers["Cache-Control"] = "private, max-age=31536000, immutable" if found.is_final else "private, no-cache"
    kind = _type(path)
    headers |= SANDBOX if kind.startswith("text/html") else {}
    start, end = _range(range_, file.size)
    status = HTTPStatus.OK
    if (start, end) != (0, file.size):
        status = HTTPStatus.PARTIAL_CONTENT
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{file.size}"
    headers["Content-Length"] = str(end - start)
    return StreamingResponse(_parts(file.open(), start, end), status, headers, media_type=kind)


def _parts(stream: IO[bytes], start: int, end: int) -> Iterator[bytes]:
    with stream:
        stream.seek(start)
        while start < end and (part := stream.read(min(_CHUNK, end - start))):
            start += len(part)
            yield part


def _range(text: str, size: int) -> tuple[int, int]:
    """The first byte and the one after the last; the whole file for a header of several ranges, or another unit."""
    match = _RANGE.fullmatch(text.strip())
    if match is None or match[0] == "bytes=-":
        return 0, size
    first, last = match[1], match[2]
    start = int(first) if first else max(0, size - int(last))
    end = min(size, int(last) + 1) if first and last else size
    if first and last and int(last) < int(first):
        return 0, size
    if start >= size or start >= end:
        headers = {"Content-Range": f"bytes */{size}"}
        got, status = text[:200], HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
        raise Problem(status, "The range is not in the file", expected=f"0-{size - 1}", got=got, headers=headers)
    return start, end


def _type(name: str) -> str:
    return _TYPES.get(PurePosixPath(name).suffix, "application/octet-stream")
