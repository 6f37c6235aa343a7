"""The pages: who sees them, what they say, that names from captures stay text; the gate; files in a sandbox."""

import json
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from html.parser import HTMLParser
from pathlib import Path

import pytest

from bench.support import pretended_queue
from tests.workflows.pages.test_coregistration import EMPTY, PLAN, a_round
from tests.workflows.service.conftest import RunningService, open_service
from workflows.engine.client import QueueClient
from workflows.engine.jobs import DRIVER, FlowJob
from workflows.service import reviews
from workflows.service.pages.capture import strip
from workflows.service.pages.charts import Line, line_chart
from workflows.service.problems import Problem

HTML = {"Accept": "text/html"}
RUN = "monday"
EVIL = "<img src=x onerror=alert(1)>\x1b[31m\u202e&\"'"


@pytest.fixture(scope="module")
def farm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    """A service whose queue has a batch in all states and a coregistration."""
    with open_service(tmp_path_factory.mktemp("pages")) as service:
        results = service.folder / "results"
        ids = pretended_queue.fill(service.state.settings.url, results / RUN, RUN, 40)
        for job in ids[:4]:
            publish(service, job)
        evil = {"status": EVIL, "reason": EVIL, "what": EVIL, "where": EVIL, "got": EVIL, "fix": EVIL}
        pretended_queue.write(
            service.state.settings.url,
            [
                {"id": ids[39], "status": "ERROR", "error": json.dumps({"error": evil}), "output": None}
                | {"executor_id": EVIL, "started_at_epoch_ms": 1, "completed_at": 2}
            ],
        )
        forge(service, f"{RUN}/<b>name")
        coregister(service)
        service.state.board.refresh()
        yield service


def publish(service: RunningService, job: str, normals_deg: float = 7.0) -> Path:
    """Write what a pretended job published: a manifest and a report with pictures."""
    folder = service.folder / "results" / RUN / job.partition("/")[2] / pretended_queue.ATTEMPT / "registration"
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"residuals": {"overall": {"normals_deg": normals_deg, "silhouette_px": 0.5, "landmarks_px": 1.0}}}
    manifest = {"content_id": f"{job} content", "status": "converged", "reason": "", "inputs": {}, "figures": figures}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    picture = '<img class="zoom" alt="{}" src="data:image/png;base64,iVBORw0KGgo=">'
    alts = ("texture, front", "a&lt;b: colour, capture", "a&lt;b: colour, rendering", "front")
    (folder / "report.html").write_text("".join(picture.format(alt) for alt in alts))
    return folder


def forge(service: RunningService, identity: str) -> None:
    """Copy a row under an id that `check_id` refuses."""
    with closing(sqlite3.connect(service.folder / "queue.sqlite")) as database, database:
        columns = [row[1] for row in database.execute("PRAGMA table_info(workflow_status)")]
        chosen = ", ".join("?" if name == "workflow_uuid" else f'"{name}"' for name in columns)
        query = f"INSERT INTO workflow_status SELECT {chosen} FROM workflow_status WHERE workflow_uuid != ? LIMIT 1"
        database.execute(query, (identity, RUN))


def coregister(service: RunningService) -> None:
    out = service.folder / "results" / "week7"
    built = {"registered": 2, "content_id": "ab" * 32}
    rounds = [row | {"build": row["build"] | built} for row in (a_round("it00"),)]
    curve = {"1": 2.0, "5": 1.5}
    record = EMPTY | {
        "rounds": rounds,
        "models": {"model 0": "/m0.npz", "model 1": EVIL},
        "generalization_mm": {"model 0": curve, "model 1": {"1": 1.8, "5": 1.2}},
        "at": 5,
        "verdict": {"proceed": False, "reason": "no gain"},
    }
    for name in (
        "it00/model/index.html",
        "it00/registrations/s#1/index.html",
        "it00/registrations/s#1/rest/report.html",
    ):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("<p>product</p>")
    (out / "coregistration.json").write_text(json.dumps(record))
    (out / "plan.json").write_text(json.dumps(PLAN))
    client = QueueClient(service.state.settings.url)
    client.submit([FlowJob(id="week7", flow="coregister", arguments={"plan": str(out / "plan.json")}, queue=DRIVER)])
    client.close()


class Tags(HTMLParser):
    """The elements of a page, and its text."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def links(self) -> list[str]:
        return [str(attrs.get("href")) for tag, attrs in self.found if tag == "a"]


def see(farm: RunningService, path: str, role: str = "viewer") -> Tags:
    answer = farm.get(f"/{path}", role, **HTML)
    assert answer.status == 200, (path, answer.body[:500])
    page = Tags(answer.body)
    for tag, attrs in page.found:
        assert "style" not in attrs and tag != "style" and not any(name.startswith("on") for name in attrs), (path, tag)
        assert tag != "script" or attrs.get("src", "").startswith("/static/")  # type: ignore[union-attr]
        assert not (tag == "img" and attrs.get("src") == "x")
    return page


PAGES = (
    *("/", "/jobs", f"/runs/{RUN}", f"/runs/{RUN}?status=look&number=9", f"/runs/{RUN}?text=%3Cb%3E"),
    *(f"/captures/{RUN}/subject_00000/neutral", f"/captures/{RUN}/subject_00007/lips_funnel"),
    *("/captures/week7", "/runs/week7", "/coregistrations/week7", "/models", "/gate", f"/gate/{RUN}"),
)


@pytest.mark.parametrize("path", PAGES)
def test_every_page_answers_and_has_neither_style_nor_script_in_its_text(farm, path):
    assert see(farm, path).text.strip()


def test_a_browser_without_a_session_is_led_to_the_login_and_back(farm):
    answer = farm.get("//runs/monday?status=look", None, **HTML)
    assert answer.status == 303 and answer.headers["location"] == "/login?next=%2Fruns%2Fmonday%3Fstatus%3Dlook"
    form = farm.get("//login?next=%2Fruns%2Fmonday%3Fstatus%3Dlook", None)
    assert b'action="/login?next=/runs/monday%3Fstatus%3Dlook"' in form.body
    for given, place in (
        ("/runs/a%3Fb=1", "/runs/a?b=1"),
        ("//evil.org", "/"),
        ("https://evil.org", "/"),
        ("/%5Ce", "/"),
    ):
        body = f"token={farm.tokens['viewer']}".encode()
        sent = {"Content_Type": "application/x-www-form-urlencoded"}
        answer = farm.request("POST", f"//login?next={given}", body, None, **sent)
        assert (answer.status, answer.headers["location"]) == (303, place)


def test_a_program_gets_problem_details_and_a_person_a_page(farm):
    assert farm.get("//runs/nothing").problem["status"] == 404
    page = farm.get("//runs/nothing", **HTML)
    assert page.status == 404 and b"There is no such run" in page.body and b"<dt>got</dt><dd>nothing</dd>" in page.body
    assert farm.get("/runs/nothing", **HTML).problem["status"] == 404  # of the API


def test_the_overview_counts_and_links_what_failed(farm):
    page = see(farm, "/")
    assert "24" in page.text and "captures done in the last 24 hours" in page.text
    kinds = [link for link in page.links() if link.startswith("/jobs?kind=")]
    assert any("bad%20input" in link for link in kinds)
    listed = see(farm, next(link for link in kinds if "mask" in link))
    assert "The mask is empty" in listed.text and "died" not in listed.text


def test_the_wall_filters_by_status_subject_expression_and_reason(farm):
    def names(query: str) -> list[str]:
        return [link for link in see(farm, f"/runs/{RUN}?{query}").links() if link.startswith("/captures/")]

    assert len(names("")) == 41
    subject = {f"/captures/{RUN}/subject_00000/{expression}" for expression in pretended_queue.EXPRESSIONS}
    assert set(names("subject=subject_00000")) == subject
    assert len(names("expression=smile")) == 8
    assert all("/subject_" in name for name in names("status=waiting"))
    assert names("text=nothing_like_it") == []
    assert names(f"text={'x' * 300}") == []
    assert farm.get(f"//runs/{RUN}?text={'x' * 500}", **HTML).status == 422


def test_names_and_reasons_from_captures_stay_text(farm):
    page = see(farm, f"/captures/{RUN}/subject_00007/lips_funnel")
    assert page.text.count("<img src=x onerror=alert(1)>") >= 5
    assert "<b>name" in see(farm, f"/runs/{RUN}?text=%3Cb%3E").text
    assert EVIL in see(farm, "/coregistrations/week7").text
    assert farm.get(f"//captures/{RUN}/%3Cb%3Ename", **HTML).status == 404


def test_a_capture_says_what_failed_and_how_to_repeat_it(farm):
    failed = next(e for e in farm.state.board.entries.values() if e.status == "bad input")
    page = see(farm, f"/captures/{failed.id}", "operator")
    for words in ("view cam03, masks/cam03.png", "some pixels of the subject", "draw the mask again"):
        assert words in page.text
    assert f"gnmreg debug {failed.id} --folder {farm.folder}" in page.text
    assert "Register again" in page.text and "Register again" not in see(farm, f"/captures/{failed.id}").text


def test_figures_stand_among_those_of_the_run(farm):
    page = see(farm, f"/captures/{RUN}/subject_00000/neutral")
    others = sum(len(entry.figures) > 0 for entry in farm.state.board.entries.values()) - 1
    assert f"of {others} others" in page.text and others >= 20
    assert len([tag for tag, attrs in page.found if attrs.get("class") == "strip"]) >= 5
    drawn = strip([1.0, 2.0, 3.0, 50.0], 50.0)
    assert drawn["x"] == 200 and strip([1.0, 1.0, 1.0], 1.0)["x"] == 0
    assert sum(height > 0 for _, _, height in drawn["bins"]) == len(drawn["bins"])


def test_charts_leave_out_what_is_no_number_and_keep_names_apart():
    lines = [Line(name=str(k), points=[(1, 1.0), (2, 1.0 + 0.001 * k), (3, float("nan"))]) for k in range(3)]
    chart = line_chart(lines, "components")
    assert chart is not None and all(len(line["dots"]) == 2 for line in chart["lines"])
    heights = sorted(line["label_y"] for line in chart["lines"])
    assert min(b - a for a, b in zip(heights, heights[1:], strict=False)) >= 12
    assert line_chart([Line(name="one", points=[(1, 1.0)])], "x") is None


def test_reports_run_in_a_sandbox_and_nothing_outside_is_read(farm):
    job = f"{RUN}/subject_00000/neutral"
    report = farm.get(f"//files/report/{job}")
    policy = report.headers["content-security-policy"]
    assert report.status == 200 and policy.startswith("sandbox allow-scripts ") and "allow-same-origin" not in policy
    assert farm.get(f"//files/picture/1/{job}").headers["content-type"] == "image/png"
    assert farm.get(f"//files/picture/99/{job}").status == 404
    assert farm.get(f"//files/thumbnail/{job}").status == 404  # none was written
    secret = farm.folder.parent / "secret.html"
    secret.write_text("secret")
    folder = publish(farm, f"{RUN}/subject_00001/neutral")
    (folder / "report.html").unlink()
    (folder / "report.html").symlink_to(secret)
    assert farm.get(f"//files/report/{RUN}/subject_00001/neutral").status == 404
    assert farm.get("//coregistrations/week7/files/it00/model/index.html").status == 200
    for path in ("../../tokens.json", "%2e%2e/%2e%2e/service/tokens.json", "plan.txt", "it00/none.html", "/etc/x.html"):
        assert farm.get(f"//coregistrations/week7/files/{path}").status == 404, path


def test_a_changed_record_of_a_coregistration_is_a_refusal(farm):
    file = farm.folder / "results" / "week7" / "coregistration.json"
    kept = file.read_text()
    try:
        for text in ("{", "[]", '{"plan": {}}', json.dumps(EMPTY | {"rounds": [{"name": 1}]})):
            file.write_text(text)
            answer = farm.get("//coregistrations/week7", **HTML)
            assert answer.status in (404, 422) and b"cannot be read" in answer.body, text
            assert farm.get("//models", **HTML).status == 200
    finally:
        file.write_text(kept)


def test_a_capture_of_a_batch_is_registered_again_with_another_recipe(farm):
    done = f"{RUN}/subject_00004/smile"
    assert farm.post("/reregister", {"job": done, "recipe": "studio"}).json == {"count": 1}
    row = farm.state.reader.rows([done])[done]
    assert row.state == "waiting" and row.spec["arguments"]["options"]["recipe"] == "studio"
    assert farm.post("/reregister", {"job": done, "recipe": "os:system"}).problem["where"] == "recipe"
    assert farm.post("/reregister", {"job": "week7", "recipe": "studio"}).problem["status"] == 422
    assert farm.post("/reregister", {"job": done, "recipe": "studio"}, role="viewer").status == 403


def test_decisions_are_bound_to_what_was_seen_and_can_be_undone(farm):
    job = f"{RUN}/subject_00000/smile"
    listed = farm.get(f"/gate/items?run={RUN}").json
    item = next(row for row in listed["items"] if row["job"] == job)
    assert item["verdict"] == "look" and item["waits"] and "normals 7.0°" in item["reasons"][0]["text"]
    given = {"job": job, "content_id": item["content_id"], "decision": "reject", "reason": EVIL.replace("\x1b", "")}
    assert farm.post("/gate/decisions", given, role="operator").status == 403
    assert farm.post("/gate/decisions", given | {"content_id": "other"}, role="reviewer").problem["status"] == 409
    answer = farm.post("/gate/decisions", given, role="reviewer").json
    assert answer["entry"]["who"] == "reviewer" and not answer["can_continue"]
    rows = farm.get(f"/gate/items?run={RUN}&show=decided").json["items"]
    assert [(row["job"], row["accepted"]) for row in rows] == [(job, False)]
    assert "reviewer: reject" in see(farm, f"/gate/{RUN}?job={job}", "reviewer").text
    assert farm.post("/gate/decisions", given | {"decision": "undo"}, role="reviewer").status == 200
    assert farm.post("/gate/decisions", given | {"decision": "undo"}, role="reviewer").problem["status"] == 409
    log = farm.get("/gate/log").json
    assert [entry["decision"] for entry in log["entries"]] == ["undo", "reject"] and log["total"] == 2
    publish(farm, job, normals_deg=1.0)  # without a change of the job's row it is not read again
    assert farm.get(f"/gate/items?run={RUN}").json["counts"]["decided"] == 0


def test_a_parked_run_can_go_on_when_nothing_waits(farm):
    assert "Continue the run" not in see(farm, f"/gate/{RUN}", "operator").text
    assert "Continue the run" not in see(farm, "/coregistrations/week7", "operator").text
    times = {"started_at_epoch_ms": 1, "completed_at": 2, "executor_id": "c0", "output": None}
    error = json.dumps({"error": {"status": "parked", "reason": "the gate"}})
    pretended_queue.write(farm.state.settings.url, [{"id": "week7", "status": "ERROR", "error": error, **times}])
    farm.state.board.refresh()
    assert "Continue the run" in see(farm, "/gate/week7", "operator").text
    assert "Continue the run" in see(farm, "/coregistrations/week7", "operator").text
    assert "Continue the run" not in see(farm, "/gate/week7", "reviewer").text


def test_a_damaged_log_of_decisions_is_a_refusal(tmp_path):
    with open_service(tmp_path / "farm") as service:
        ids = pretended_queue.fill(service.state.settings.url, service.folder / "results" / RUN, RUN, 5)
        (service.folder / "gate").mkdir()
        (service.folder / "gate" / "decisions.jsonl").write_text('{"sequence": 1}\n')
        service.state.board.refresh()
        assert service.get(f"/gate/items?run={RUN}").problem["status"] == 422
        assert b"key of the gate" in service.get("//gate", **HTML).body
        given = {"job": ids[0], "content_id": "x", "decision": "accept"}
        assert service.post("/gate/decisions", given, role="reviewer").problem["status"] == 422


def test_a_review_opens_on_the_loopback_interface_only(farm, tmp_path):
    given = {"run": "week7", "round": 0}
    assert farm.post("/reviews", given, role="operator").status == 403
    assert farm.post("/reviews", given | {"round": 7}, role="reviewer").status == 404
    with open_service(tmp_path / "farm", host="0.0.0.0", names=("127.0.0.1",)) as service:  # its own loopback address
        out = service.folder / "results" / "week7"
        out.mkdir()
        coregister(service)
        service.state.board.refresh()
        refused = service.post("/reviews", given, role="reviewer").problem
        assert refused["status"] == 409 and "gnmreg stabilize review" in refused["fix"]
        assert "does not pass on" in see(service, "/coregistrations/week7", "reviewer").text


def test_a_review_is_one_child_for_each_run_and_says_why_it_cannot_start(tmp_path, monkeypatch):
    script = "import sys, time; print('loading'); print(sys.argv[1], flush=True); time.sleep(float(sys.argv[2]))"

    def command(run: Path, model: Path) -> list[str]:
        line = "The model cannot be read" if run.name == "bad" else f"Open http://127.0.0.1:1/?token={run.name} in a"
        return [sys.executable, "-c", script, line, "0" if run.name == "bad" else "600"]

    monkeypatch.setattr(reviews, "review_command", command)
    opened = reviews.Reviews()
    try:
        with pytest.raises(Problem, match="could not start") as refused:
            opened.open(tmp_path / "bad", tmp_path)
        assert refused.value.details.got == "loading The model cannot be read"
        assert opened.open(tmp_path / "good", tmp_path) == "http://127.0.0.1:1/?token=good"
        (child,) = (page.process for page in opened._pages.values() if page.address)
        assert opened.open(tmp_path / "good", tmp_path) == "http://127.0.0.1:1/?token=good"
        assert child.poll() is None
    finally:
        opened.stop()
    assert child.poll() is not None
