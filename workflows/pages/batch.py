"""The HTML page of a batch: its captures, ranked by what needs a look; the images and reports are files beside it."""

from collections.abc import Sequence
from pathlib import PurePosixPath
from urllib.parse import quote

from workflows.pages.base import render
from workflows.pages.registrations import RegistrationLine, figure_texts, seconds_text
from workflows.records.batch import DONE, FAILED, BatchRow, BatchTable
from workflows.records.headline import Headline, verdict_level

PAGE_ROWS = 100  # that are displayed at first: a browser takes seconds to lay out ten thousand
_WIDTH_PX = 54  # of a thumbnail


def render_batch_page(table: BatchTable, *, csv_file: str) -> str:
    """Return the page.

    Args:
        table: its paths are relative to the folder of the page.
        csv_file: the same table as CSV, beside the page.
    """
    headlines = table.headlines
    lines = [_line(row, headlines) for row in table.rows]
    return render(
        "batch.html",
        table=table,
        csv_file=csv_file,
        tiles=_tiles(table.rows),
        headlines=headlines,
        statuses=table.counts(),
        lines=lines,
        to_look_at=sum(bool(line.failed or line.look) for line in lines),
        page_rows=PAGE_ROWS,
    )


def _line(row: BatchRow, headlines: Sequence[Headline]) -> RegistrationLine:
    folders = "/".join(PurePosixPath(row.source).parts[-2:])  # a key has other characters than those of ids replaced
    return RegistrationLine(
        name=row.name,
        label="" if row.source.endswith(f"/{row.name}") else folders,
        status=row.status,
        failed=row.state == FAILED,
        level=verdict_level(row.figures),
        look=row.look,
        reason=row.reason,
        report=row.report,
        thumbnail=quote(row.thumbnail) if row.thumbnail else None,
        width=_WIDTH_PX,
        values=figure_texts(row.figures, headlines),
        seconds=seconds_text(row.seconds),
    )


def _tiles(rows: Sequence[BatchRow]) -> list[tuple[str, str, str]]:
    done = [row for row in rows if row.state == DONE]
    failed = sum(row.state == FAILED for row in rows)
    counts = (
        (len(rows), "captures"),
        (len(done), "registered"),
        (failed, "failed"),
        (sum(bool(row.look) for row in done), "registered, but to be looked at"),
        (len(rows) - len(done) - failed, "not done"),
    )
    return [(f"{count:,}", "", label) for count, label in counts]
