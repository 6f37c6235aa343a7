"""The HTML page of a subject: one row for each capture, with links to the reports beside it."""

from collections.abc import Mapping

from workflows.pages.base import render
from workflows.pages.registrations import RegistrationLine, figure_texts, seconds_text
from workflows.records.headline import present, verdict_level, verdict_reasons
from workflows.records.subject import SubjectRecord

_WIDTH_PX = 110  # of a thumbnail
_FAILED = ("failed", "error")


def render_subject_page(subject: SubjectRecord, thumbnails: Mapping[str, str]) -> str:
    """Return the page; `thumbnails` are data URIs by the name of the row."""
    headlines = present(row.figures for row in subject.rows)
    lines = [
        RegistrationLine(
            name=row.name,
            label="" if row.expression == row.name else row.expression,
            status=row.status,
            failed=row.status in _FAILED,
            level=verdict_level(row.figures),
            look="; ".join(verdict_reasons(row.figures)),
            reason=row.reason,
            report=None if row.folder is None else f"{row.folder}/report.html",
            thumbnail=thumbnails.get(row.name),
            width=_WIDTH_PX,
            values=figure_texts(row.figures, headlines),
            seconds=seconds_text(row.seconds),
        )
        for row in subject.rows
    ]
    return render(
        "subject.html",
        subject=subject,
        headlines=headlines,
        lines=lines,
        usable=sum(row.usable for row in subject.rows),
        waiting=sum(row.status == "waiting" for row in subject.rows),
    )
