"""The ranking of a batch's captures and its CSV file."""

import csv
import io
from dataclasses import replace
from typing import Any

from workflows.records.batch import BatchRow, BatchTable, ranked
from workflows.records.headline import brief


def a_row(name: str, state: str = "done", mean_mm: float | None = None, **changes: Any) -> BatchRow:
    figures = {} if mean_mm is None else {"scan_to_mesh": {"face": {"mean_mm": mean_mm, "points": 7}}}
    status = changes.pop("status", "converged" if state == "done" else state)
    return BatchRow(
        name=name, source=f"/data/{name}", job=f"june/{name}", state=state, status=status, figures=figures, **changes
    )


def read_csv(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_what_needs_a_look_comes_first() -> None:
    usual = [a_row(f"usual{n}", mean_mm=0.2 + 0.001 * n) for n in range(9)]
    rows = ranked(
        [
            a_row("later", "waiting"),
            a_row("cut off", "interrupted"),
            *usual,
            a_row("no figure"),
            a_row("halved", mean_mm=0.2, status="stopped"),
            a_row("off", mean_mm=1.0),
            a_row("broken", "failed", status="died"),
            a_row("empty", "failed", status="bad input"),
        ]
    )
    names = [row.name for row in rows]
    assert names[:4] == ["empty", "broken", "off", "halved"]
    assert names[4:] == [*(f"usual{n}" for n in reversed(range(9))), "no figure", "cut off", "later"]
    looks = {row.name: row.look for row in rows if row.look}
    assert looks == {
        "off": "scan to mesh, mean 1.000 mm, usually 0.204 mm",
        "halved": "it was stopped before it converged",
    }


def test_verdicts_are_reasons_to_look() -> None:
    def judged(name: str, level: str) -> BatchRow:
        return replace(a_row(name), figures={"verdict": {"level": level, "reasons": [f"it is {level}"]}})

    rows = ranked([judged("fine", "good"), judged("doubtful", "look"), judged("off", "wrong"), judged("odd", "?")])
    assert [(row.name, row.look) for row in rows] == [
        ("off", "it is wrong"),
        ("doubtful", "it is look"),
        ("fine", ""),
        ("odd", ""),
    ]
    read = read_csv(BatchTable(run="june", written="", rows=rows).to_csv())
    assert [row["verdict"] for row in read] == ["wrong", "look at it", "good", ""]


def test_residuals_in_the_images_are_columns() -> None:
    """Of captures without a scan."""
    overall = {"silhouette_px": 0.7, "normals_deg": 2.5, "landmarks_px": 1.25}
    rows = ranked([replace(a_row("a"), figures={"residuals": {"overall": overall, "views": {}}})])
    (read,) = read_csv(BatchTable(run="june", written="", rows=rows).to_csv())
    assert {name: float(read[name]) for name in overall} == overall and "scan_to_mesh_face_mean_mm" not in read
    assert brief({"residuals": {"overall": overall, "views": {"cam00": overall}}}) == {
        "residuals": {"overall": overall}
    }


def test_figures_of_few_captures_are_not_compared() -> None:
    assert not any(row.look for row in ranked([a_row("a", mean_mm=0.2), a_row("b", mean_mm=9.0)]))


def test_equal_figures_need_no_look() -> None:
    assert not any(row.look for row in ranked([a_row(f"{n}", mean_mm=0.2) for n in range(20)]))


def test_the_csv_file_names_units_and_holds_no_formulas() -> None:
    rows = ranked(
        [
            a_row("ann/rest", mean_mm=0.25, seconds=12.5, report="ann/rest/attempt-1/registration/report.html"),
            a_row("bob/rest", "failed", status="bad input", reason='=1+1\x1b[2J, \u202e\n"quoted"'),
        ]
    )
    read = read_csv(BatchTable(run="june", written="", rows=rows).to_csv())
    assert list(read[0]) == [
        *("capture", "state", "status", "verdict", "needs_a_look", "reason"),
        *("scan_to_mesh_face_mean_mm", "registration_s", "report", "source", "job"),
    ]
    assert [row["capture"] for row in read] == ["bob/rest", "ann/rest"]
    assert read[0]["reason"] == '\'=1+1 [2J,   "quoted"' and read[0]["scan_to_mesh_face_mean_mm"] == ""
    assert float(read[1]["scan_to_mesh_face_mean_mm"]) == 0.25 and float(read[1]["registration_s"]) == 12.5


def test_a_batch_without_captures_is_a_table_without_rows() -> None:
    assert read_csv(BatchTable(run="june", written="", rows=ranked([])).to_csv()) == []


def test_figures_of_other_types_are_left_out() -> None:
    face = {"mean_mm": "0.2", "median_mm": float("nan"), "p95_mm": True}
    assert brief({"scan_to_mesh": {"face": face}, "drift": [1]}) == {}
    assert brief({"scan_to_mesh": {"face": {"mean_mm": 1, "points": 3}, "seen": {"mean_mm": 2}}}) == {
        "scan_to_mesh": {"face": {"mean_mm": 1, "points": 3}}
    }
