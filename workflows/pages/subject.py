"""The HTML page of a subject: one row for each capture, with links to the reports beside it."""

from collections.abc import Mapping

from workflows.pages.base import render
from workflows.records.subject import SubjectRecord


def render_subject_page(subject: SubjectRecord, thumbnails: Mapping[str, str]) -> str:
    """Return the page; `thumbnails` are data URIs by the name of the row."""
    return render(
        "subject.html",
        subject=subject,
        thumbnails=thumbnails,
        usable=sum(row.usable for row in subject.rows),
        waiting=sum(row.status == "waiting" for row in subject.rows),
    )
