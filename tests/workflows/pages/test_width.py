"""No page scrolls sideways, on a telephone or a desk, whatever names and messages are on it."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from coregister.stopping_rule import StoppingRule
from registration.model import gnm_npz
from registration.report.page import render_report
from tests.registration.report.test_page import a_registration, some_inputs
from tests.workflows import test_coregistration
from tests.workflows.browser import launch, needs_browser, sideways_px
from tests.workflows.pages import test_batch
from tests.workflows.pages import test_coregistration as coregistration_page
from tests.workflows.records.test_batch import a_row
from tests.workflows.rounds import MODEL, write_people
from tests.workflows.test_coregistration import true_register  # noqa: F401  a fixture
from workflows.pages import evaluation, model, stabilization
from workflows.pages.base import heat_images
from workflows.pages.subject import render_subject_page
from workflows.records.subject import CaptureRow, SubjectRecord

LONG = "ünbroken_" * 20
PATH = f"/data/{'a_folder/' * 30}cam00.png cannot be read; expected a PNG file, got nothing"
NUMBERS = {"scan_to_mesh": {"face": {"mean_mm": 1234.5, "median_mm": 1234.5, "p95_mm": 1234.5}}}
FIGURES = {**NUMBERS, "drift": {"face": {"mean_mm": 123.4}}, "residuals": {"overall": {"silhouette_px": 12.5}}}
VERDICT = {"level": "wrong", "reasons": [PATH]}


def report() -> str:
    registration = a_registration(reason=PATH, seconds={LONG: 1.0}, inputs={LONG: "ab" * 32})
    notes = {"notes": [PATH], "views_not_trusted": {LONG: PATH}}
    registration = replace(registration, figures={**registration.figures, **notes})
    return render_report(some_inputs(registration=registration, subject=LONG, expression=LONG))


def subject() -> str:
    row = CaptureRow(name=LONG, expression=PATH, status="converged", reason=PATH, figures=FIGURES, folder=LONG)
    rows = (row, replace(row, name="b", status="error", figures={"verdict": VERDICT}))
    return render_subject_page(SubjectRecord(subject=LONG, model="ab" * 32, recipe=LONG, neutral=LONG, rows=rows), {})


def batch() -> str:
    rows = [replace(a_row(LONG), figures=FIGURES, seconds=1e4, report="r", thumbnail="t")]
    return test_batch.render(*rows, a_row("b", "failed", status="timed out", reason=PATH))


def coregistration() -> str:
    done = coregistration_page.a_round("it00")
    done["register"] = {LONG: {LONG: {"usable": False, "reason": PATH}}}
    plan = coregistration_page.PLAN | {"dataset": f"/{LONG}"}
    changes = {"plan": plan, "rounds": [done], "stopped": PATH, "sources": {LONG: "registrations"}}
    curves = {"model 0": {"5": 1.5}, "model 1": {"5": 1.25}}
    return coregistration_page.render(coregistration_page.EMPTY | changes | {"generalization_mm": curves, "at": 5})


@needs_browser
@pytest.mark.parametrize("render", [report, subject, batch, coregistration], ids=lambda render: render.__name__)
def test_pages_of_long_names_and_messages(render: Callable[[], str], tmp_path: Path) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    (tmp_path / "index.html").write_text(render())
    with launch(sync_api) as browser:
        assert sideways_px(browser, tmp_path / "index.html") == {400: 0, 1280: 0}


@pytest.mark.slow
@needs_browser
def test_pages_of_a_round(capture, true_register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    """The pages of models, evaluations and stabilized sets, with small images."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    monkeypatch.undo()  # the fixture omits pages and images
    for name in ("register", "subject"):
        monkeypatch.setattr(f"workflows.steps.{name}.register", true_register)
    for module in (evaluation, model, stabilization):
        monkeypatch.setattr(module, "heat_images", lambda *a, **k: heat_images(*a, **{**k, "size": (48, 52)}))
    dataset = write_people(capture, tmp_path / "dataset", 4)
    out = tmp_path / "out"
    test_coregistration.run_rounds(dataset, out, rule=StoppingRule(max_rounds=1))
    pages = [out / "it00" / name / "index.html" for name in ("evaluation", "registrations/stabilized", "model")]
    manifest = json.loads((out / "it00/model/gnm_head.manifest.json").read_text())
    changes = {"rejected": [{"name": LONG, "reason": PATH}], "demographics": {LONG: {LONG: 3}}}
    pages[-1].write_text(model.render_model_page(gnm_npz.read(MODEL), manifest | changes))
    with launch(sync_api) as browser:
        for page in (*pages, out / "index.html", out / "it00/registrations/p0/index.html"):
            assert sideways_px(browser, page) == {400: 0, 1280: 0}, page
