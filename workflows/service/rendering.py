"""Pages of the service: templates with everything escaped, and their static files."""

from functools import cache
from importlib.resources import files
from pathlib import PurePosixPath
from typing import Any

from fastapi import APIRouter
from jinja2 import Environment, PackageLoader, StrictUndefined
from starlette.responses import Response

from workflows.service.problems import Problem

router = APIRouter(include_in_schema=False)
_TYPES = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("workflows.service"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, **context: Any) -> str:
    """Return a page: a template of `workflows/service/templates` with these values, all of them escaped."""
    return _environment().get_template(template).render(context)


@router.get("/static/{path:path}")
def static(path: str) -> Response:
    """Return a file of `workflows/service/static`."""
    name = PurePosixPath(path)
    file = files("workflows.service").joinpath("static", name.name)
    if len(name.parts) != 1 or name.suffix not in _TYPES or not file.is_file():
        raise Problem.missing("file", path)
    return Response(file.read_bytes(), media_type=_TYPES[name.suffix], headers={"Cache-Control": "max-age=3600"})
