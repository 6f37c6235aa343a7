"""Submissions: what is put into the queue, and what is refused before anything is."""

import json
import os
import shutil
import threading
import time
from pathlib import Path

import pytest

from tests.conftest import FIXTURES
from tests.workflows.conftest import add
from tests.workflows.service.conftest import open_service
from workflows.service import idempotency
from workflows.service.idempotency import HEADER, REPEATED
from workflows.service.submitting import store_cached_model


@pytest.fixture(scope="module")
def farm(tmp_path_factory, capture):
    """A service with uploads of four subjects, a model, and a root with two captures beside a foreign folder."""
    base = tmp_path_factory.mktemp("submissions")
    for name in ("disk", "foreign"):
        add(capture, base / name / "eve" / "rest", "neutral", "eve")
        add(capture, base / name / "eve" / "smile", "smile", "eve")
    with open_service(base / "farm", roots=(str(base / "disk"),)) as service:
        for name in ("ann", "bob", "cat", "dan"):
            add(capture, service.folder / "captures" / name / "rest", "neutral", name)
        add(capture, service.folder / "captures" / "ann" / "smile", "smile", "ann")
        (service.folder / "models" / "tiny").mkdir()
        for name in ("tiny_gnm.npz", "head_sparse_68.txt"):
            shutil.copyfile(FIXTURES / name, service.folder / "models" / "tiny" / name)
        yield service


def jobs_of(farm, run: str) -> list[str]:
    rows = farm.state.reader.listing(run)
    return sorted(row.id for row in rows)


def test_a_batch_of_uploads_paths_and_what_cannot_be_used(farm):
    disk = farm.folder.parent / "disk"
    captures = ["ann", "bob/rest", "ann/smile", "zoe", str(disk / "eve" / "rest"), str(disk / "eve" / "none")]
    answer = farm.post("/batches", {"captures": captures, "model": "tiny", "run": "monday"})
    assert answer.status == 202, answer.body
    assert answer.headers["location"] == "/api/v1/runs/monday"
    submitted = answer.json
    assert submitted["total"] == submitted["new"] == 5 and submitted["out"] == str(farm.folder / "results" / "monday")
    assert set(submitted["left_out"]) == {"zoe", str(disk / "eve" / "none")}
    assert "no such upload" in submitted["left_out"]["zoe"]
    expected = ["", "/ann/rest", "/ann/smile", "/bob/rest", "/eve/none", "/eve/rest"]
    assert jobs_of(farm, "monday") == [f"monday{part}" for part in expected]
    spec = farm.get("/jobs/monday/ann/smile").json["spec"]["arguments"]
    assert spec["model"] == str(farm.folder / "models" / "tiny" / "tiny_gnm.npz") and spec["key"] == "ann/smile"
    assert farm.get("/runs/monday").json["counts"] == {"waiting": 5}
    again = farm.post("/batches", {"captures": ["ann"], "model": "tiny", "run": "monday"})
    assert again.json["waiting"] == 2 and again.json["new"] == 0


def test_options_reach_the_jobs(farm):
    options = {"recipe": "preview", "seed": 7, "variant": "cuda"}
    body = {"captures": ["ann/rest"], "model": "tiny", "out": "tuesday/first", "run": "tuesday", "options": options}
    assert farm.post("/batches", body).json["out"] == str(farm.folder / "results" / "tuesday" / "first")
    kept = farm.get("/jobs/tuesday/ann/rest").json["spec"]["arguments"]["options"]
    assert {name: kept[name] for name in options} == options


@pytest.mark.parametrize(
    ("change", "status", "where"),
    [
        ({"captures": ["{foreign}/eve/rest"]}, 403, "captures"),
        ({"captures": ["ann", "{farm}/captures/../service"]}, 403, "captures"),
        ({"captures": ["@{farm}/list.txt"]}, 422, "captures"),
        ({"captures": ["@list.txt"]}, 422, "captures"),
        ({"captures": ["s3://bucket/ann"]}, 403, "captures"),
        ({"captures": ["http://example.org/ann"]}, 422, "captures"),
        ({"captures": ["<script>"]}, 422, "captures"),
        ({"captures": ["ann/\u001b[2J"]}, 422, "captures"),
        ({"captures": ["../ann"]}, 422, "captures"),
        ({"captures": ["ann/rest/images"]}, 422, "captures"),
        ({"captures": []}, 422, "body.captures"),
        ({"captures": ["zoe"]}, 422, "captures"),
        ({"model": "{foreign}/m.npz"}, 403, "model"),
        ({"model": "{farm}/service/tokens.json"}, 403, "model"),
        ({"model": "none"}, 404, "model"),
        ({"model": "../x"}, 422, "model"),
        ({"out": "{farm}"}, 403, "out"),
        ({"out": "{farm}/service"}, 403, "out"),
        ({"out": "{farm}/logs/x"}, 403, "out"),
        ({"out": "{farm}/captures/x"}, 403, "out"),
        ({"out": "{foreign}"}, 403, "out"),
        ({"out": "../x"}, 422, "out"),
        ({"run": "a/b"}, 422, "body.run"),
        ({"run": None}, 422, "run"),
        ({"options": {"recipe": "os:getcwd"}}, 422, "body.options.recipe"),
        ({"options": {"detector": "os:getcwd"}}, 422, "body.options.detector"),
        ({"options": {"views": 1}}, 422, "body.options.views"),
        ({"unknown": 1}, 422, "body.unknown"),
    ],
    ids=str,
)
def test_what_cannot_be_submitted(farm, change, status, where):
    names = {"farm": str(farm.folder), "foreign": str(farm.folder.parent / "foreign")}
    text = json.dumps({"captures": ["ann"], "model": "tiny", "run": "refused", **change})
    for name, place in names.items():
        text = text.replace(f"{{{name}}}", place)
    problem = farm.post("/batches", text.encode(), Content_Type="application/json").problem
    assert (problem["status"], problem.get("where")) == (status, where), problem
    assert "\x1b" not in json.dumps(problem, ensure_ascii=False)
    assert jobs_of(farm, "refused") == [] and not (farm.folder / "results" / "refused").exists()


def test_a_link_leads_nowhere(farm):
    (farm.folder / "captures" / "link").mkdir(exist_ok=True)
    (farm.folder / "captures" / "link" / "rest").symlink_to(farm.folder.parent / "foreign" / "eve" / "rest")
    path = str(farm.folder / "captures" / "link" / "rest")
    for word in (path, "link/rest"):
        problem = farm.post("/batches", {"captures": [word], "model": "tiny", "run": "links"}).problem
        assert problem["status"] == 403
    assert jobs_of(farm, "links") == []
    shutil.rmtree(farm.folder / "captures" / "link")


def test_a_subject(farm):
    answer = farm.post("/subjects", {"subject": "ann", "model": "tiny", "run": "ann1"})
    assert answer.status == 202, answer.body
    assert answer.json["total"] == 2 and answer.json["left_out"] == {}
    spec = farm.get("/jobs/ann1").json["spec"]
    assert spec["flow"] == "subject" and spec["arguments"]["captures"] == ["rest", "smile"]
    assert farm.get("/runs/ann1").json["kind"] == "subject"
    busy = farm.post("/subjects", {"subject": "ann", "model": "tiny", "run": "ann1"}).problem
    assert busy["status"] == 409 and "not ended" in busy["detail"]
    other = farm.post("/batches", {"captures": ["ann"], "model": "tiny", "run": "ann1"}).problem
    assert other["status"] == 409 and other["detail"] == "The run is no batch"
    for change in ({"subject": "zoe"}, {"neutral": "frown"}, {"out": "s3://bucket/x"}, {"subject": "../ann"}):
        body = {"subject": "ann", "model": "tiny", "run": "ann2", **change}
        assert farm.post("/subjects", body).problem["status"] in (403, 422), change
    assert jobs_of(farm, "ann2") == []


def test_a_coregistration(farm):
    body = {
        "dataset": "captures",
        "model": "tiny",
        "run": "rounds",
        "iterations": 1,
        "components": [1],
        "anatomy": "keep",
        "gate": "person",
    }
    answer = farm.post("/coregistrations", body)
    assert answer.status == 202, answer.body
    plan = json.loads((farm.folder / "results" / "rounds" / "plan.json").read_text())
    assert plan["rule"]["max_rounds"] == 1 and plan["components"] == [1]
    assert plan["gate"]["policy"] == "person" and plan["gate"]["decisions"] == str(farm.folder / "gate")
    assert jobs_of(farm, "rounds") == ["rounds"] and answer.json["total"] >= 5
    for change in (
        {"dataset": "ann"},
        {"model_recipe": "os:getcwd"},
        {"components": [3, 2]},
        {"held_out": 1.5},
        {"gate": "no"},
    ):
        refused = farm.post("/coregistrations", {**body, "run": "no", **change}).problem
        assert refused["status"] in (403, 422), (change, refused)
    assert not (farm.folder / "results" / "no").exists() and jobs_of(farm, "no") == []


def test_the_same_key_and_request_are_answered_once(farm):
    body = {"captures": ["bob"], "model": "tiny", "run": "keyed"}
    first = farm.post("/batches", body, Idempotency_Key="k1")
    assert first.status == 202 and first.json["new"] == 1 and REPEATED.lower() not in first.headers
    again = farm.post("/batches", body, Idempotency_Key="k1")
    assert (again.status, again.json, again.headers["location"]) == (202, first.json, first.headers["location"])
    assert again.headers[REPEATED.lower()] == "true"
    other = farm.post("/batches", {**body, "run": "other"}, Idempotency_Key="k1").problem
    assert other["status"] == 422 and other["where"] == HEADER and jobs_of(farm, "other") == []
    assert farm.post("/batches", body, Idempotency_Key="k2").json["waiting"] == 1
    assert farm.post("/batches", body, Idempotency_Key="x" * 201).problem["status"] == 422
    assert farm.post("/batches", body, role="viewer", Idempotency_Key="k1").problem["status"] == 403
    assert farm.post("/batches", body, role=None, Idempotency_Key="k1").problem["status"] == 401


def test_refused_requests_do_not_use_up_a_key(farm):
    body = {"captures": ["zoe"], "model": "tiny", "run": "later"}
    assert farm.post("/batches", body, Idempotency_Key="k3").status == 422
    assert farm.post("/batches", {**body, "captures": ["bob"]}, Idempotency_Key="k3").status == 202


def test_a_key_in_use_and_an_old_key(farm, monkeypatch):
    body = {"captures": ["bob"], "model": "tiny", "run": "busy"}
    token = farm.state.tokens.find(farm.tokens["operator"])
    with farm.state.answers.claim(idempotency._digest(token.id, "k4")):
        assert farm.post("/batches", body, Idempotency_Key="k4").problem["status"] == 409
    assert farm.post("/batches", body, Idempotency_Key="k4").json["new"] == 1
    monkeypatch.setattr(idempotency, "KEPT_S", -1.0)
    assert farm.post("/batches", body, Idempotency_Key="k4").json["waiting"] == 1


def test_many_submissions_at_once_with_one_key_make_one_run(farm):
    body, answers = {"captures": ["bob", "cat"], "model": "tiny", "run": "crowd"}, []

    def send() -> None:
        answers.append(farm.post("/batches", body, Idempotency_Key="k5"))

    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {answer.status for answer in answers} <= {202, 409}
    done = [answer.json for answer in answers if answer.status == 202]
    assert done and all(answer == done[0] for answer in done) and done[0]["new"] == 2


def test_answers_are_kept_for_their_owner_only_and_not_for_ever(tmp_path):
    answers = idempotency.Answers(tmp_path)
    kept = idempotency.KeptAnswer(request="r", status=202, location="", content={}, time=time.time())
    answers.keep("a", kept)
    assert answers.find("a") == kept and (tmp_path / "idempotency").stat().st_mode & 0o077 == 0
    file: Path = tmp_path / "idempotency" / "a.json"
    os.utime(file, (0, 0))
    idempotency.Answers(tmp_path).keep("b", kept)
    assert not file.exists() and answers.find("b") == kept


def test_malformed_bodies(farm):
    for body in (b"", b"[]", b"{", b"\xff\xfe", b'{"captures": ["\\ud800"], "model": "tiny", "run": "x"}', b"null"):
        problem = farm.post("/batches", body, Content_Type="application/json").problem
        assert problem["status"] in (400, 422)
    assert farm.post("/batches", b"x" * (17 * 2**20), Content_Type="application/json").status == 413
    assert farm.get("//healthz", role=None).status == 200


def test_a_cached_model_is_copied_to_where_workers_may_read_it(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "models" / "first"
    assert store_cached_model("first", str(folder)) is None and not folder.parent.exists()
    cached = tmp_path / "cache" / "gnm-registration" / "first-0123"
    cached.mkdir(parents=True)
    for name in ("gnm_head_first.npz", "head_sparse_68.txt", "notes.txt"):
        (cached / name).write_text(name)
    assert store_cached_model("first", str(folder)) == str(folder / "gnm_head_first.npz")
    assert sorted(path.name for path in folder.iterdir()) == ["gnm_head_first.npz", "head_sparse_68.txt"]
    assert store_cached_model("second", str(folder)) is None
