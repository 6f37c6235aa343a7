"""Figures that are added later appear in the report that was written before."""

from pathlib import Path

from registration.report.page import render_report
from registration.report.summary import refresh_report
from registration.storage.registration_folder import read_manifest, save_registration, update_figures
from tests.registration.report.test_page import a_registration, check_page, some_inputs


def test_drift_that_was_measured_later_is_on_the_page(tmp_path: Path) -> None:
    registration = a_registration()
    folder = save_registration(registration, tmp_path / "out", render_report(some_inputs(registration=registration)))
    before = (folder / "report.html").read_text("utf-8")
    row = {"points": 77, "mean_mm": 0.531, "median_mm": 0.4, "std_mm": 0.2, "p95_mm": 1.71, "carried_mm": 0.05}
    update_figures(folder, {"drift": {"face": row}})
    refresh_report(folder)
    page = (folder / "report.html").read_text("utf-8")
    check_page(page)
    assert "Drift from the neutral" not in before and page.count("Drift from the neutral") == 1
    assert "drift from the neutral, mean" in page and "0.531" in page and "cam00" in page
    assert len(page) > len(before) and page.split("<section")[3:] == before.split("<section")[3:]


def test_the_verdict_follows_the_new_figures(tmp_path: Path) -> None:
    registration = a_registration()
    folder = save_registration(registration, tmp_path / "out", render_report(some_inputs(registration=registration)))
    bad = {"points": 9, "mean_mm": 1.5, "median_mm": 1.4, "std_mm": 0.2, "p95_mm": 2.0}
    update_figures(folder, {"scan_to_mesh": {"face": bad}})
    refresh_report(folder)
    assert read_manifest(folder).figures["verdict"]["level"] == "wrong"
    assert '<span class="badge wrong">' in (folder / "report.html").read_text("utf-8")


def test_a_folder_without_a_report_gets_a_verdict_and_an_older_page_stays(tmp_path: Path) -> None:
    folder = save_registration(a_registration(), tmp_path / "out")
    refresh_report(folder)
    assert read_manifest(folder).figures["verdict"]["level"] == "good" and not (folder / "report.html").exists()
    (folder / "report.html").write_text("<p>an older page</p>", "utf-8")
    refresh_report(folder)
    assert (folder / "report.html").read_text("utf-8") == "<p>an older page</p>"
