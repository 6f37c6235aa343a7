"""Routes for what runs services: is it alive, can it answer."""

import time

from fastapi import APIRouter
from starlette.responses import JSONResponse

from workflows.service.state import Service

router = APIRouter(tags=["health"])
SILENT_S = 30.0  # after which a database that does not answer makes the service unready


@router.get("/healthz")
def alive() -> dict[str, str]:
    """Answer, if the process does."""
    return {"status": "alive"}


@router.get("/readyz")
def ready(state: Service) -> JSONResponse:
    """Answer 200 if the queue's database answered lately, else 503."""
    silent_s = time.time() - state.board.answered
    if silent_s > SILENT_S:
        return JSONResponse({"status": "not ready", "queue_silent_s": round(silent_s)}, 503)
    return JSONResponse({"status": "ready"})
