"""The HTML page of a batch: its captures, ranked by what needs a look; the images and reports are files beside it."""

from collections.abc import Sequence

from workflows.pages.base import render
from workflows.records.batch import DONE, FAILED, BatchRow, BatchTable
from workflows.records.headline import Headline, headline_value

MISSING = "–"
PAGE_ROWS = 100  # that are displayed at first: a browser takes seconds to lay out ten thousand


def render_batch_page(table: BatchTable, *, csv_file: str) -> str:
    """Return the page.

    Args:
        table: its paths are relative to the folder of the page.
        csv_file: the same table as CSV, beside the page.
    """
    headlines = table.headlines
    return render(
        "batch.html",
        table=table,
        csv_file=csv_file,
        tiles=_tiles(table.rows),
        headlines=headlines,
        counts=table.counts(),
        rows=[{"row": row, "values": _values(row, headlines), "seconds": _seconds(row)} for row in table.rows],
        page_rows=PAGE_ROWS,
        missing=MISSING,
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


def _values(row: BatchRow, headlines: Sequence[Headline]) -> list[str]:
    values = [(headline_value(row.figures, headline), headline.digits) for headline in headlines]
    return [MISSING if value is None else f"{value:.{digits}f}" for value, digits in values]


def _seconds(row: BatchRow) -> str:
    return MISSING if row.seconds is None else f"{row.seconds:.0f}"
