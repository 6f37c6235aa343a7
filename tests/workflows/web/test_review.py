"""The review page in a headless Chromium: decisions made there have the same effect as in a function call."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.support import performances
from registration.errors import InputError
from registration.stabilize import stabilized_folder as disk
from registration.stabilize.decisions import Decision
from registration.stabilize.pipeline import stabilize
from tests.coregister.conftest import head_assembly, model, model_file, source, wheel  # noqa: F401  fixtures
from tests.registration.stabilize import runs
from tests.workflows.browser import CHROMIUM, FLAGS, launch, needs_browser
from workflows.records.decisions import read_decisions
from workflows.records.run import read_run
from workflows.steps.stabilize import stabilize_run
from workflows.web.review import ReviewPage, review
from workflows.web.review_state import ReviewState

NAMES = ("smile", "jaw_open", "brows_up")


@pytest.fixture(scope="module")
def run(head_assembly, model, tmp_path_factory) -> Path:  # noqa: F811
    truths = [performances.true_subject(head_assembly, number, NAMES) for number in range(2)]
    seens = [performances.observe(truth, number, unobserved=0.02) for number, truth in enumerate(truths)]
    return runs.write_run(tmp_path_factory.mktemp("review"), model, truths, seens)


@pytest.fixture
def page(run, model_file) -> Iterator[ReviewPage]:  # noqa: F811
    (run / "decisions.jsonl").unlink(missing_ok=True)
    served = review(run, model_path=model_file, port=0)
    yield served
    served.close()


@needs_browser
def test_a_reviewer_steps_subtracts_undoes_and_saves(page, run, model, model_file, tmp_path):  # noqa: F811
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        tab = browser.new_page(viewport={"width": 1360, "height": 900})
        requests, sockets = [], []
        tab.on("request", lambda request: requests.append(request.url))
        tab.on("websocket", lambda socket: sockets.append(socket.url))
        tab.goto(page.url)
        see = sync_api.expect
        see(tab.get_by_text("6 expressions of 2 subjects")).to_be_visible(timeout=60_000)
        tab.set_default_timeout(15_000)
        see(tab.get_by_text("Coefficients by expression")).to_be_attached()
        see(tab.get_by_text("The ten samples with the largest coefficients")).to_be_attached()
        see(tab.locator("canvas").first).to_be_visible()

        first = tab.get_by_text("energy of the region").locator("..").inner_text()
        tab.get_by_role("button", name="next", exact=True).click()
        see(tab.get_by_text(first.split("\t")[-1], exact=True)).to_have_count(0)  # another component
        unsaved = tab.get_by_text("decisions not saved").locator("..")
        tab.get_by_role("textbox").last.fill("it turns")
        tab.get_by_role("button", name="subtract", exact=True).click()
        see(unsaved).to_contain_text("1")
        tab.get_by_role("button", name="drop", exact=True).click()
        see(unsaved).to_contain_text("2")
        assert page.review.effect.rms_mm > 0
        tab.get_by_role("button", name="Undo").click()
        see(tab.get_by_text("Undone.")).to_be_visible()
        see(unsaved).to_contain_text("1")
        tab.get_by_role("button", name="Save decisions").click()
        see(tab.get_by_text("1 decisions saved")).to_be_visible()
        image = tab.screenshot()
        browser.close()
    assert len(image) > 20_000
    allowed = (f"http://127.0.0.1:{page.port}/", f"blob:http://127.0.0.1:{page.port}/", "data:")
    assert requests and all(url.startswith(allowed) for url in requests)
    assert sockets == [f"ws://127.0.0.1:{page.port}/"] or sockets == [f"ws://127.0.0.1:{page.port}"]

    log = run / "decisions.jsonl"
    decided = read_decisions(log, page.review.dataset)
    assert decided == [Decision(region="left_periocular", component=1, action="subtract", reason="it turns")]
    replayed = stabilize_run(run, model_path=model_file, out=tmp_path / "out", decisions=log)
    expected = stabilize(read_run(run, model).meshes(), model, decisions=decided)
    for number, subject in enumerate(expected.subjects):
        replay = disk.read_subject(replayed.out, number)
        np.testing.assert_allclose(replay.vertices, subject.vertices, atol=1e-6)
        np.testing.assert_allclose(replay.T_neutral_expression, subject.T_neutral_expression, atol=1e-9)


@pytest.mark.slow
@needs_browser
def test_a_reviewer_walks_the_work_list_and_is_warned(page):
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    items = page.review.work_list()
    torn = next(item for item in items if page.review.stretch(*item.key).tears)
    with launch(sync_api) as browser:
        tab = browser.new_page(viewport={"width": 1360, "height": 900})
        tab.set_default_timeout(60_000)
        tab.goto(page.url)
        see = sync_api.expect
        see(tab.get_by_text(f"reviewed 0 of {len(items)}")).to_be_visible()
        tab.get_by_role("button", name="keep", exact=True).click()
        see(tab.get_by_text(f"reviewed 1 of {len(items)}")).to_be_visible()
        tab.get_by_role("button", name="next undecided").click()
        second = f"▸ {items[1].region.replace('_', ' ')} {items[1].component + 1}"
        see(tab.get_by_text(second, exact=True)).to_be_visible()
        tab.get_by_role("button", name="previous undecided").click()
        last = f"▸ {items[-1].region.replace('_', ' ')} {items[-1].component + 1}"
        see(tab.get_by_text(last, exact=True)).to_be_attached()  # the first one is decided
        page._go_to(*torn.key)
        warning = tab.get_by_text("Dropping it tears the mesh")
        see(warning).to_have_count(0)
        tab.get_by_role("button", name="drop", exact=True).click()
        see(warning).to_be_visible()
        see(tab.get_by_text("These decisions tear the mesh")).to_be_visible()
        tab.get_by_role("button", name="subtract", exact=True).click()
        see(warning).to_have_count(0)


def test_the_work_list_begins_with_flagged_components(page):
    review: ReviewState = page.review
    items = review.work_list()
    flags = [item.flagged for item in items]
    assert flags == sorted(flags, reverse=True) and not any(item.decided for item in items)
    assert {item.key for item in items} == {
        (part.region, k) for part in review.stored.components for k in range(len(part.energy))
    }
    first, second, third = items[:3]
    review.decide(*second.key, "keep", "")
    assert [item.key for item in review.work_list()] == [item.key for item in items]
    assert review.work_list()[1].decided and review.work_list()[1].action == "keep"
    assert review.undecided(*first.key, 1).key == third.key  # type: ignore[union-attr]
    assert review.undecided(*first.key, -1).key == items[-1].key  # type: ignore[union-attr]
    assert review.undecided(*items[-1].key, 1).key == first.key  # type: ignore[union-attr]
    for item in items[1:]:
        review.decide(*item.key, "keep", "")
    assert review.undecided(*second.key, 1).key == first.key  # type: ignore[union-attr]
    assert review.undecided(*first.key, 1) is None
    review.undo()
    assert review.undecided(*first.key, 1).key == items[-1].key  # type: ignore[union-attr]


def test_decisions_that_tear_are_known(page):
    review: ReviewState = page.review
    torn = next(item for item in review.work_list() if review.stretch(*item.key).tears)
    review.decide(*torn.key, "subtract", "")
    assert review.tearing == []  # one motion of the whole head
    review.decide(*torn.key, "drop", "")
    assert [item.key for item in review.tearing] == [torn.key]


def test_a_review_resumes_its_log(page, run, model_file):  # noqa: F811
    before: ReviewState = page.review
    before.decide("nose", 0, "subtract", "moves as one")
    before.decide("mouth", 0, "drop", "")
    assert before.undo().region == "mouth" and before.unsaved == 1  # type: ignore[union-attr]
    assert before.save() == 1 and before.save() == 0 and before.undo() is None
    with pytest.raises(InputError, match="does not exist"):
        before.decide("nose", 99, "drop", "")
    again = review(run, model_path=model_file, port=0)
    try:
        assert again.review.action("nose", 0) == "subtract" and again.review.unsaved == 0
        assert again.review.effect.rms_mm == before.effect.rms_mm > 0
        motion_before, motion_after = again.review.motions("nose", 0)
        np.testing.assert_array_equal(motion_before, again.review.stored.mean_displacement["nose"][0])
        assert np.abs(motion_before - motion_after).max() > 1e-6
    finally:
        again.close()


def test_opening_a_review_again_keeps_the_decisions(page, run, model_file):  # noqa: F811
    page.review.decide("nose", 0, "subtract", "moves as one")
    page.review.save()
    decided = stabilize_run(run, model_path=model_file, decisions=run / "decisions.jsonl")
    written = disk.read_manifest(decided.out)
    review(run, model_path=model_file, port=0).close()
    assert disk.read_manifest(decided.out) == written and len(written.decisions) == 1


def test_a_port_in_use_is_refused(page, run, model_file):  # noqa: F811
    with pytest.raises(InputError, match="cannot be served"):
        review(run, model_path=model_file, port=page.port)
