"""Results over HTTP: files by content id, ranges, reports in a sandbox, nothing from elsewhere; models."""

import json
import shutil
from pathlib import Path

import pytest
import sqlalchemy as sa

from tests.conftest import FIXTURES
from tests.workflows import browser
from tests.workflows.browser import needs_browser
from tests.workflows.service.conftest import RunningService
from workflows.engine.client import QueueClient
from workflows.engine.database import engine, table
from workflows.engine.jobs import FlowJob, Job
from workflows.records.store import Store

REPORT = "<html><script>1</script></html>"


def finish(service: RunningService, identity: str, arguments: dict, result: object) -> None:
    """Put a job into the queue, as one that has ended with a result."""
    url = service.state.settings.url
    queue = QueueClient(url)
    queue.submit([Job(id=identity, step="register stored", arguments=arguments)])
    queue.close()
    with engine(url).begin() as connection:
        connection.execute(
            sa.text(
                f"UPDATE {table(url, 'workflow_status')} SET status = 'SUCCESS', output = :o WHERE workflow_uuid = :i"
            ),
            {"o": json.dumps({"result": result}), "i": identity},
        )
    service.state.board.refresh()


def publish(service: RunningService, key: str, store: str | None = None, report: str = REPORT) -> str:
    """Publish a result and have a job end with it; return its content id."""

    def make(folder: Path) -> dict:
        (folder / "registration").mkdir()
        (folder / "registration" / "report.html").write_text(report)
        (folder / "registration" / "mesh.ply").write_text(f"{key} {'x' * 100}")
        (folder / "thumbnail.jpg").write_bytes(b"\xff\xd8")
        return {"status": "converged"}

    place = store or str(service.folder / "results" / "art")
    artifact = Store(place).produce(key, input_hash=key, make=make)
    finish(service, key, {"store": place, "key": key, "capture": "/x"}, {**artifact.brief(), "made": True})
    return artifact.content_id


@pytest.fixture(scope="module")
def content_id(service) -> str:
    return publish(service, "art/ann/smile")


def test_the_files_of_a_result(service, content_id):
    shown = service.get(f"/artifacts/{content_id}").json
    assert shown["job"] == "art/ann/smile" and shown["about"] == {"status": "converged"}
    files = {file["name"]: (file["bytes"], file["type"]) for file in shown["files"]}
    assert files["thumbnail.jpg"] == (2, "image/jpeg") and files["registration/report.html"][0] == len(REPORT)
    mesh = service.get(f"/artifacts/{content_id}/registration/mesh.ply")
    assert mesh.body.decode() == "art/ann/smile " + "x" * 100 and "immutable" in mesh.headers["cache-control"]
    assert service.get("/jobs/art/ann/smile").json["content_id"] == content_id


@pytest.mark.parametrize(
    ("sent", "status", "part"),
    [
        ("bytes=0-2", 206, "art"),
        ("bytes=4-6", 206, "ann"),
        ("bytes=112-", 206, "xx"),
        ("bytes=-3", 206, "xxx"),
        ("bytes=110-999", 206, "xxxx"),
        ("bytes=-9999", 200, None),
        ("bytes=5-2", 200, None),
        ("bytes=0-1,3-4", 200, None),
        ("lines=1-2", 200, None),
        ("bytes=114-", 416, None),
        ("bytes=-0", 416, None),
    ],
)
def test_ranges(service, content_id, sent, status, part):
    answer = service.get(f"/artifacts/{content_id}/registration/mesh.ply", Range=sent)
    assert answer.status == status
    if status == 206:
        assert answer.body.decode() == part and int(answer.headers["content-length"]) == len(part)
        assert answer.headers["content-range"].endswith("/114")
    else:
        assert answer.headers["content-range"] == "bytes */114" if status == 416 else len(answer.body) == 114


def test_a_report_cannot_reach_the_api(service, content_id):
    headers = service.get(f"/artifacts/{content_id}/registration/report.html").headers
    policy = headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts") and "allow-same-origin" not in policy
    assert "default-src 'none'" in policy and "connect-src data: blob:;" in policy
    assert headers["content-type"].startswith("text/html") and headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    "path", ["../artifact.json", "..%2F..%2Fservice%2Ftokens.json", "%2Fetc%2Fpasswd", "registration", "a%00b", "none"]
)
def test_other_files_are_not_given(service, content_id, path):
    assert service.get(f"/artifacts/{content_id}/{path}").problem["status"] == 404


def test_what_was_superseded_or_is_unknown_is_missing(service):
    old = publish(service, "art/bob/one")
    shutil.rmtree(service.folder / "results" / "art" / "art" / "bob")
    assert service.get(f"/artifacts/{old}").problem["status"] == 404
    for name in ("0" * 64, "x", "%1B", "0" * 63 + "%0A"):
        assert service.get(f"/artifacts/{name}").problem["status"] == 404


def test_links_out_of_the_results_are_refused(service, tmp_path):
    content = publish(service, "art/cat/one")
    (tmp_path / "secret").write_text("secret")
    mesh = next((service.folder / "results" / "art" / "art" / "cat").rglob("mesh.ply"))
    mesh.unlink()
    mesh.symlink_to(tmp_path / "secret")
    answer = service.get(f"/artifacts/{content}/registration/mesh.ply")
    assert answer.problem["status"] == 422 and b"secret" not in answer.body


def test_forged_rows_lead_nowhere(service, tmp_path):
    store = tmp_path / "store"
    outside = publish(service, "forged/a", store=str(store))
    assert service.get(f"/artifacts/{outside}").problem["status"] == 403
    for number, (arguments, result) in enumerate(
        [
            ({"store": str(service.folder / "results")}, {"key": "../../service", "content_id": "1" * 64}),
            ({}, {"out": str(service.folder / "service"), "content_id": "1" * 64}),
            ({"store": 5}, {"key": [], "out": {}, "content_id": "1" * 64}),
        ]
    ):
        finish(service, f"forged/{number}", arguments, result)
    assert service.get(f"/artifacts/{'1' * 64}").problem["status"] in (403, 404)


def test_a_folder_of_a_subject(service):
    folder = service.folder / "results" / "ann" / "smile"
    folder.mkdir(parents=True)
    manifest = {"content_id": "a" * 64, "status": "stopped", "reason": "late"}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "report.html").write_text(REPORT)
    (folder / "link").symlink_to("/etc/passwd")
    finish(
        service, "ann/smile", {"out": str(folder)}, {"out": str(folder), "status": "stopped", "content_id": "a" * 64}
    )
    shown = service.get(f"/artifacts/{'a' * 64}").json
    assert [file["name"] for file in shown["files"]] == ["manifest.json", "report.html"]
    assert shown["about"] == {"status": "stopped", "reason": "late"}
    answer = service.get(f"/artifacts/{'a' * 64}/report.html")
    assert answer.body.decode() == REPORT and answer.headers["cache-control"] == "private, no-cache"
    (folder / "manifest.json").write_text(json.dumps({**manifest, "content_id": "b" * 64}))
    assert service.get(f"/artifacts/{'a' * 64}").problem["status"] == 404


def test_models(service):
    models = service.folder / "models"
    shutil.copyfile(FIXTURES / "tiny_gnm.npz", models / "tiny.npz")
    (models / "tiny.extra.npz").write_bytes(b"x")
    out = service.folder / "results" / "rounds"
    (out / "it00" / "model").mkdir(parents=True)
    built = out / "it00" / "model" / "head.npz"
    built.write_bytes(b"model")
    record = {
        "models": {"model 0": "/x.npz", "model 1": str(built), "model 2": "/etc/passwd", "model 3": 5},
        "generalization_mm": {"model 1": {"5": 0.5, "10": None}},
        "verdict": {"proceed": False, "reason": "enough"},
    }
    (out / "coregistration.json").write_text(json.dumps(record))
    queue = QueueClient(service.state.settings.url)
    queue.submit([FlowJob(id="rounds", flow="coregister", arguments={"plan": f"{out}/plan.json"}, queue="driver")])
    queue.close()
    service.state.board.refresh()
    listed = {model["id"]: model for model in service.get("/models").json}
    assert set(listed) == {"tiny", "rounds/1"}
    assert listed["rounds/1"]["generalization_mm"] == {"5": 0.5} and listed["rounds/1"]["bytes"] == 5
    assert service.get("/models/rounds/1").json["verdict"]["reason"] == "enough"
    assert service.get("/models/rounds/2").problem["status"] == 404
    submitted = service.post("/batches", {"captures": ["none"], "model": "rounds/1", "run": "r"}).problem
    assert submitted["detail"] == "There is nothing to register"
    (out / "coregistration.json").write_text("{")
    assert [model["id"] for model in service.get("/models").json] == ["tiny"]


@needs_browser
def test_scripts_of_a_report_run_and_reach_nothing(service):
    """As a page embeds it, and in a tab of its own, with the viewer's session in the browser."""
    sync_api = pytest.importorskip("playwright.sync_api")
    probe = (
        "<html><body><script>document.title = 'ran ' + origin; let text = 'sent ';"
        "try { text = 'cookie ' + document.cookie } catch (e) { text = 'none ' }"
        "fetch('/api/v1/runs').then(r => r.text(), () => 'refused').then(t => { document.body.append(text + t) })"
        "</script></body></html>"
    )
    content = publish(service, "art/eve/probe", report=probe)
    place = f"{service.url}/api/v1/artifacts/{content}/registration/report.html"
    secret = service.state.access.login_link(service.state.tokens.find(service.tokens["viewer"]))
    with browser.launch(sync_api) as chromium:
        tab = chromium.new_page()
        tab.goto(f"{service.url}/login?once={secret}")
        tab.goto(f"{service.url}/login")
        tab.evaluate(
            "place => { const f = document.createElement('iframe'); f.src = place; document.body.append(f) }", place
        )
        for frame in (tab.wait_for_selector("iframe").content_frame(), tab):
            if frame is tab:
                tab.goto(place)
            frame.wait_for_selector("text=refused")
            assert frame.title() == "ran null" and "none refused" in frame.content()
