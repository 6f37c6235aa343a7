"""The application of the service: its routes, each with the role that it needs."""

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any

from fastapi import Depends, FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute, RouteContext, iter_route_contexts
from starlette.middleware import Middleware

from workflows.service import health, login, problems, prometheus, rendering
from workflows.service.access import need
from workflows.service.api import actions, artifacts, captures, events, gate, jobs, reviews, subjects, submissions
from workflows.service.middleware import Guard
from workflows.service.pages import all as pages
from workflows.service.pages.base import for_people
from workflows.service.settings import ServiceSettings
from workflows.service.state import ServiceState

API = "/api/v1"
OPEN = frozenset({"/healthz", "/readyz", "/login", "/static/{path:path}"})  # routes that need no token


def create_app(settings: ServiceSettings) -> FastAPI:
    """Return the application.

    Args:
        settings: of the service; the queue must exist.

    Raises:
        RuntimeError: a route has no role and is not one of `OPEN`.
    """
    state = ServiceState(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        state.start()
        try:
            yield
        finally:
            state.stop()

    app = FastAPI(
        title="gnm-registration",
        version=version("gnm-registration"),
        summary="Submit, follow and decide registrations of a farm.",
        openapi_url=None,  # it would be open to all
        docs_url=None,  # they load scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
        middleware=[Middleware(Guard, state=state)],
    )
    app.state.service = state
    problems.install(app, for_people)
    for module in (jobs, subjects, actions, events, captures, submissions, reviews, gate, artifacts):
        app.include_router(module.router, prefix=API)
    for module in (health, prometheus, login, rendering, pages):
        app.include_router(module.router)

    @app.get(f"{API}/openapi.json", dependencies=[Depends(need("viewer"))], include_in_schema=False)
    def description() -> dict[str, Any]:
        """Describe the API."""
        return app.openapi()

    refuse_open_routes(app)
    return app


def refuse_open_routes(app: FastAPI) -> None:
    """Raise RuntimeError if a route asks for no role and is not meant to."""
    for route in iter_route_contexts(app.routes):
        if route.path not in OPEN and not role_of(route):
            raise RuntimeError(f"{route.path} asks for no role")


def role_of(route: RouteContext) -> str:
    """Return the role that a route asks for, that of its router or a higher one of its own; empty if it is open."""
    roles = list(_roles(route.dependant)) if isinstance(route.original_route, APIRoute) else []
    return next((role for role in roles if role != "viewer"), roles[0] if roles else "")


def _roles(dependant: Dependant) -> Iterator[str]:
    role = getattr(dependant.call, "role", "")
    if role:
        yield role
    for below in dependant.dependencies:
        yield from _roles(below)
