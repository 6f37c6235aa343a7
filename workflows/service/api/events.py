"""A stream of the queue's changes as server-sent events [WHATWG HTML, 9.2]; a viewer that reconnects misses none."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable

from fastapi import APIRouter, Depends, Request
from starlette.responses import StreamingResponse

from workflows.service.access import need
from workflows.service.board import Board, Change
from workflows.service.problems import RESPONSES
from workflows.service.state import Service

router = APIRouter(tags=["events"], dependencies=[Depends(need("viewer"))], responses=RESPONSES)
PING_S = 15.0  # between two comments of a silent stream: proxies close those that say nothing
_BATCH = 500  # changes that are sent at once


@router.get("/events", response_class=StreamingResponse)
async def events(state: Service, request: Request, run: str | None = None) -> StreamingResponse:
    """Stream changes of jobs.

    Events are `job` (a job's new state), `deleted` (its id) and `reset` (some changes are lost: load the list again).
    With the header Last-Event-ID the stream continues after that event.
    """
    after, token = request.headers.get("Last-Event-ID", ""), request.state.identity.token.id
    content = stream(state.board, run, after, lambda: state.tokens.by_id(token) is not None)
    return StreamingResponse(content, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})


async def stream(board: Board, run: str | None, after: str, allowed: Callable[[], bool]) -> AsyncIterator[str]:
    """Yield the events after one, then those to come.

    Args:
        board: of the service.
        run: only jobs of this run or part; None: all.
        after: id of the last event that the viewer has; empty: only what is to come.
        allowed: whether the viewer's token is still valid; the stream ends when it is not, or the board stops.
    """
    changed, loop = asyncio.Event(), asyncio.get_running_loop()

    def wake() -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(changed.set)

    board.listen(wake)
    try:
        epoch, _, number = after.partition("-")
        known = int(number) if epoch == board.epoch and number.isdecimal() else None
        cursor = board.number if known is None else known
        yield "retry: 1000\n\n"
        if after and known is None:
            yield _event(board, cursor, "reset", {})
        while allowed() and not board.stopped:
            changes = board.changes_after(cursor)
            if changes is None:
                cursor = board.number
                yield _event(board, cursor, "reset", {})
                continue
            for start in range(0, len(changes), _BATCH):
                part = changes[start : start + _BATCH]
                yield "".join(_text(board, change) for change in part if _concerns(change, run))
                cursor = part[-1].number
            changed.clear()
            if board.number == cursor:
                try:
                    await asyncio.wait_for(changed.wait(), PING_S)
                except TimeoutError:
                    yield ": waiting\n\n"
    finally:
        board.ignore(wake)


def _concerns(change: Change, run: str | None) -> bool:
    return run is None or change.id == run or change.id.startswith(f"{run}/")


def _text(board: Board, change: Change) -> str:
    if change.entry is None:
        return _event(board, change.number, "deleted", {"id": change.id})
    return _event(board, change.number, "job", change.entry.brief())


def _event(board: Board, number: int, kind: str, data: dict[str, object]) -> str:
    return f"id: {board.epoch}-{number}\nevent: {kind}\ndata: {json.dumps(data)}\n\n"
