"""The application of the service: its routes, each with the role that it needs."""

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from starlette.middleware import Middleware

from workflows.service import health, login, problems, prometheus, rendering
from workflows.service.api import actions, events, jobs
from workflows.service.middleware import Guard
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
        state.board.start()
        try:
            yield
        finally:
            state.board.stop()

    app = FastAPI(
        title="gnm-registration",
        version=version("gnm-registration"),
        summary="Submit, follow and decide registrations of a farm.",
        openapi_url=f"{API}/openapi.json",
        docs_url=None,  # they load scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
        middleware=[Middleware(Guard, state=state)],
    )
    app.state.service = state
    problems.install(app)
    for module in (jobs, actions, events):
        app.include_router(module.router, prefix=API)
    for module in (health, prometheus, login, rendering):
        app.include_router(module.router)
    refuse_open_routes(app)
    return app


def refuse_open_routes(app: FastAPI) -> None:
    """Raise RuntimeError if a route asks for no role and is not meant to."""
    for route in app.routes:
        if isinstance(route, APIRoute) and route.path not in OPEN and not role_of(route):
            raise RuntimeError(f"{route.path} asks for no role")


def role_of(route: APIRoute) -> str:
    """Return the role that a route asks for; empty if it is open."""
    return next(iter(_roles(route.dependant)), "")


def _roles(dependant: Dependant) -> Iterator[str]:
    role = getattr(dependant.call, "role", "")
    if role:
        yield role
    for below in dependant.dependencies:
        yield from _roles(below)
