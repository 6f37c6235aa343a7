"""The HTML page of a calibration of the quality gate: ROC curves of each rule and of all together; self-contained."""

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from registration.report.charts import ChartLine, line_charts
from workflows.pages.base import render

_PANEL, _SHOWN = 3, 9  # curves in one panel, and of rules alone in all: more would share colours


@dataclass(frozen=True, kw_only=True)
class RocCurve:
    """Recall of bad registrations against false alarms, over all limits."""

    name: str
    false_alarms: tuple[float, ...]  # shares, increasing
    recall: tuple[float, ...]
    area: float  # below the curve: 0.5 tells nothing, 1 separates all
    usual: str = ""  # median of the good ones, with the unit
    limit: str = ""  # proposed, with the unit
    caught: int = 0  # bad ones above the limit
    alarms: int = 0  # good ones above the limit


@dataclass(frozen=True, kw_only=True)
class CalibrationView:
    """What the page shows."""

    thresholds_id: str
    good: int
    bad: int
    spreads: float
    recall: float
    false_alarms: float
    combined: RocCurve
    rules: tuple[RocCurve, ...]


def render_gate_calibration(view: CalibrationView) -> str:
    """Return the page."""
    ranked = sorted(view.rules, key=lambda rule: -rule.area)
    panels = {"all rules together": [view.combined]}
    panels |= {
        f"rules {first + 1} to {first + _PANEL}": ranked[first : first + _PANEL]
        for first in range(0, min(len(ranked), _SHOWN), _PANEL)
    }
    return render(
        "gate_calibration.html",
        view=view,
        tiles=[
            (f"{100 * view.recall:.0f}", "%", "of the bad ones are not accepted"),
            (f"{100 * view.false_alarms:.0f}", "%", "of the good ones are not accepted"),
            (f"{view.spreads:.1f}", "", "robust spreads above the good ones' median: every limit"),
            (str(view.good), "", "good labels"),
            (str(view.bad), "", "bad labels"),
        ],
        chart=Markup(
            line_charts({title: [_line(c) for c in curves] for title, curves in panels.items()}, "false alarms")
        ),
        rows=_rows(ranked, view.good, view.bad),
    )


def _line(curve: RocCurve) -> ChartLine:
    return ChartLine(name=curve.name, x=curve.false_alarms, y=curve.recall)


def _rows(rules: Sequence[RocCurve], good: int, bad: int) -> list[tuple[str, ...]]:
    return [
        (rule.name, f"{rule.area:.2f}", rule.usual, rule.limit, f"{rule.caught} of {bad}", f"{rule.alarms} of {good}")
        for rule in rules
    ]
