"""Uploads: a capture is there whole and checked, or nothing is left of it."""

import hashlib
import io
import json
import shutil
import socket
import threading
import time
import zipfile
from pathlib import Path

import pytest

from tests.registration.capture import small
from tests.workflows.service.archives import tar_of, tar_with, zip_of
from tests.workflows.service.conftest import open_service
from workflows.engine.client import QueueClient
from workflows.engine.jobs import Job
from workflows.service.archives import digest_of_files, files_of
from workflows.service.settings import UploadLimits
from workflows.service.uploads import Uploads


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    return small.make(tmp_path_factory.mktemp("ball") / "ball")


def left(service) -> list[str]:
    """What is in the folder of uploads besides captures."""
    incoming = service.folder / "captures" / ".incoming"
    return [path.name for path in incoming.iterdir()] if incoming.exists() else []


def test_a_capture_is_uploaded_listed_shown_and_deleted(service, ball):
    answer = service.request("PUT", "/captures/ann/smile", tar_of(ball))
    assert answer.status == 201, answer.body
    assert {file["name"] for file in answer.json["files"]} == set(files_of(ball))
    assert answer.json["upload"]["by"] == "operator" and answer.json["upload"]["views"] > 1
    assert service.get("/captures/ann/smile").json == answer.json
    listed = service.get("/captures?subject=ann").json
    assert listed["total"] == 1 and listed["captures"][0]["expression"] == "neutral"
    assert service.get("/captures?subject=ann&offset=1").json["captures"] == []
    uploaded = service.folder / "captures" / "ann" / "smile"
    assert all((uploaded / name).read_bytes() == path.read_bytes() for name, path in files_of(ball).items())
    again = service.request("PUT", "/captures/ann/smile", tar_of(ball)).problem
    assert again["status"] == 409 and "replace" in again["fix"]
    replaced = service.request("PUT", "/captures/ann/smile?replace=true", zip_of(ball))
    assert replaced.status == 201 and replaced.json["upload"]["digest"] == answer.json["upload"]["digest"]
    assert service.request("DELETE", "/captures/ann/smile").status == 204
    assert service.get("/captures/ann/smile").problem["status"] == 404 and not uploaded.parent.exists()
    assert left(service) == []


def test_a_capture_in_one_folder_of_its_archive_and_in_chunks(service, ball):
    content = zip_below(ball)
    answer = service.request("PUT", "/captures/bob/rest", iter([content[:1000], content[1000:]]))
    assert answer.status == 201, answer.body
    digests = answer.json["upload"]["digest"]
    assert len(digests) == 64 and (service.folder / "captures" / "bob" / "rest" / "capture.toml").is_file()
    assert digests == digest_of(ball)


def zip_below(ball: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, path in files_of(ball).items():
            archive.write(path, f"ball/{name}")
    return buffer.getvalue()


def digest_of(folder: Path) -> str:
    return digest_of_files({n: hashlib.sha256(p.read_bytes()).hexdigest() for n, p in files_of(folder).items()})


def test_the_doctor_refuses_with_all_that_is_wrong(service, ball, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(ball, broken)
    image, *_ = sorted((broken / "images").iterdir())
    image.write_bytes(b"no image")
    problem = service.request("PUT", "/captures/eve/broken", tar_of(broken)).problem
    assert problem["status"] == 422 and problem["where"].startswith("eve/broken/images/")
    assert str(service.folder) not in json.dumps(problem)
    assert left(service) == [] and not (service.folder / "captures" / "eve").exists()


@pytest.mark.parametrize(
    ("content", "status"),
    [
        (tar_with("capture.toml", b"2", linkname="/etc/passwd"), 422),
        (tar_with("notes.txt", content=b"x"), 422),
        (tar_with("capture.toml", content=b"kind = ["), 422),
        (b"", 422),
        (b"<html>", 422),
    ],
)
def test_other_archives_are_refused(service, content, status):
    assert service.request("PUT", "/captures/eve/other", content).problem["status"] == status
    assert left(service) == [] and service.get("/captures/eve/other").status == 404


@pytest.mark.parametrize(
    "path", ["..%2F..%2Fx/y", ".hidden/y", "a/%1B%5B2J", "%3Cscript%3E/a", "a/b%00", "a/.incoming"]
)
def test_names_that_are_none_are_refused(service, path):
    for method in ("PUT", "GET", "DELETE"):
        answer = service.request(method, f"/captures/{path}", b"x" if method == "PUT" else None)
        assert answer.problem["status"] in (404, 422) and b"\x1b" not in answer.body


def test_a_viewer_uploads_and_deletes_nothing(service, ball):
    assert service.request("PUT", "/captures/eve/any", b"x", role="viewer").problem["status"] == 403
    assert service.request("DELETE", "/captures/eve/any", role="viewer").problem["status"] == 403


def test_limits_of_bytes(tmp_path, ball):
    limits = UploadLimits(max_bytes=50_000, max_entries=3)
    with open_service(tmp_path / "farm", uploads=limits) as service:
        assert service.request("PUT", "/captures/a/b", bytes(50_001)).problem["status"] == 413
        assert service.request("PUT", "/captures/a/b", iter([bytes(30_000)] * 2)).problem["status"] == 413
        small_tar = tar_with("a")[:512] * 4 + bytes(1024)
        assert service.request("PUT", "/captures/a/b", small_tar).status in (413, 422)
        assert left(service) == [] and service.get("/captures").json["total"] == 0


def begin_upload(service, path: str, content: bytes, stated: int) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", service.port))
    head = f"PUT /api/v1{path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {service.tokens['operator']}\r\n"
    connection.sendall(f"{head}Content-Length: {stated}\r\n\r\n".encode() + content)
    return connection


def wait_until(condition) -> None:
    until = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_an_upload_that_is_cut_leaves_nothing_and_blocks_nobody(service, ball):
    content = tar_of(ball)
    with begin_upload(service, "/captures/cut/one", content[:1000], len(content)):
        wait_until(lambda: left(service) == ["cut@one"])
        second = service.request("PUT", "/captures/cut/one", content).problem
        assert second["status"] == 409 and "uploaded" in second["detail"]
        assert service.get("/captures/cut/one").status == 404
    wait_until(lambda: left(service) == [])
    assert service.request("PUT", "/captures/cut/one", content).status == 201


def test_two_uploads_of_one_name_at_once(service, ball):
    content, statuses = tar_of(ball), []

    def send() -> None:
        statuses.append(service.request("PUT", "/captures/twice/one", content).status)

    threads = [threading.Thread(target=send) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [201, 409, 409] and left(service) == []


def test_a_capture_that_a_job_reads_stays(service, ball):
    assert service.request("PUT", "/captures/used/one", tar_of(ball)).status == 201
    path = service.get("/captures/used/one").json["path"]
    queue = QueueClient(service.state.settings.url)
    queue.submit([Job(id="uses/used/one", step="register stored", arguments={"capture": path})])
    service.state.board.refresh()
    for method, query, body in (("DELETE", "", None), ("PUT", "?replace=true", tar_of(ball))):
        refused = service.request(method, f"/captures/used/one{query}", body).problem
        assert refused["status"] == 409 and "uses/used/one" in refused["fix"]
    queue.cancel("uses")
    queue.close()
    service.state.board.refresh()
    assert service.request("DELETE", "/captures/used/one").status == 204


def test_a_start_deletes_what_a_killed_service_has_left_but_no_running_upload(service):
    stale = service.folder / "captures" / ".incoming" / "old@one"
    (stale / "unpacked").mkdir(parents=True)
    with service.state.uploads.claim("new", "one") as incoming:
        incoming.archive.write_bytes(b"half")
        Uploads(service.state.settings).start()
        assert left(service) == ["new@one"] and incoming.archive.read_bytes() == b"half"
    assert left(service) == []
