import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from registration.errors import InputError
from workflows.records.store import MANIFEST, Store


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """An S3 server over HTTP, with one bucket."""
    import boto3
    from moto.server import ThreadedMotoServer

    settings = {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": "",
    }
    former = {name: os.environ.get(name) for name in settings}
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    os.environ.update(settings | {"AWS_ENDPOINT_URL": f"http://{host}:{port}"})
    boto3.client("s3").create_bucket(Bucket="results")
    yield "s3://results"
    server.stop()
    for name, value in former.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    if request.param == "folder":
        return Store(tmp_path / "store")
    return Store(f"{request.getfixturevalue('bucket')}/{tmp_path.name}")


def write(folder: Path) -> dict[str, object]:
    (folder / "sub").mkdir()
    (folder / "mesh.ply").write_bytes(b"mesh")
    (folder / "sub" / "page.html").write_bytes(b"page")
    return {"mm": 0.5}


def must_not_run(folder: Path) -> dict[str, object]:
    raise AssertionError("produced again")


def overwrite(store: Store, name: str, content: bytes | None) -> None:
    """Overwrite or delete a file without the store's knowledge."""
    path = store._path(name)
    if content is None:
        store._fs.rm_file(path)
        return
    store._fs.makedirs(path.rpartition("/")[0], exist_ok=True)
    store._fs.pipe_file(path, content)


def test_find_returns_the_published_artifact(store: Store) -> None:
    assert store.find("run/a") is None
    artifact = store.produce("run/a", input_hash="hash", make=write)
    assert store.find("run/a") == artifact
    assert artifact.about == {"mm": 0.5} and set(artifact.files) == {"mesh.ply", "sub/page.html"}
    assert list(store.keys()) == ["run/a"]


def test_files_are_opened_at_any_position(store: Store) -> None:
    artifact = store.produce("run/a", input_hash="hash", make=write)
    with store.open(artifact, "sub/page.html") as stream:
        stream.seek(2)
        assert stream.read() == b"ge"
    with pytest.raises(InputError, match="artifact"):
        store.open(artifact, "../artifact.json")
    overwrite(store, f"run/a/{artifact.attempt}/mesh.ply", None)
    with pytest.raises(InputError, match="artifact"):
        store.open(artifact, "mesh.ply").read()


def test_the_same_input_hash_returns_the_stored_artifact(store: Store) -> None:
    first = store.produce("a", input_hash="one", make=write)
    assert store.produce("a", input_hash="one", make=must_not_run) == first
    second = store.produce("a", input_hash="two", make=write)
    assert second.input_hash == "two" and second.attempt != first.attempt
    assert second.content_id == first.content_id
    assert len(store.verify().orphaned) == 2


def test_a_missing_file_leads_to_a_new_attempt(store: Store) -> None:
    first = store.produce("a", input_hash="one", make=write)
    overwrite(store, f"a/{first.attempt}/mesh.ply", None)
    assert store.produce("a", input_hash="one", make=write).attempt != first.attempt


def test_a_failing_step_publishes_nothing(store: Store) -> None:
    def write_half(folder: Path) -> dict[str, object]:
        (folder / "half").write_text("x")
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        store.produce("a", input_hash="one", make=write_half)
    assert store.find("a") is None
    assert store.verify().artifacts == 0 and not store.verify().orphaned


def test_concurrent_attempts_leave_one_sound_artifact(store: Store) -> None:
    """A suspended attempt publishes after its successor: exactly one complete artifact remains."""

    def write_after_successor(folder: Path) -> dict[str, object]:
        store.produce("a", input_hash="one", make=write)
        return write(folder)

    last = store.produce("a", input_hash="one", make=write_after_successor)
    assert store.find("a") == last
    report = store.verify()
    assert report.is_sound and report.artifacts == 1 and len(report.orphaned) == 2


def test_verify_lists_missing_altered_and_orphaned_files(store: Store) -> None:
    a = store.produce("run/a", input_hash="one", make=write)
    b = store.produce("run/b", input_hash="one", make=write)
    assert store.verify().is_sound and store.verify().artifacts == 2
    overwrite(store, f"run/a/{a.attempt}/mesh.ply", b"mush")
    overwrite(store, f"run/b/{b.attempt}/sub/page.html", None)
    overwrite(store, "run/c/attempt-1/left", b"over")
    overwrite(store, f"run/d/{MANIFEST}", b"{}")
    report = store.verify()
    assert report.altered == (f"run/a/{a.attempt}/mesh.ply",)
    assert report.missing == (f"run/b/{b.attempt}/sub/page.html",)
    assert report.orphaned == ("run/c/attempt-1/left",)
    assert list(report.unreadable) == [f"run/d/{MANIFEST}"]
    assert not report.is_sound


@pytest.mark.parametrize("name", ["../../outside", "/etc/passwd", "sub/../../x"])
def test_a_manifest_that_points_outside_is_refused(store: Store, name: str) -> None:
    store.produce("a", input_hash="one", make=write)
    value = json.loads(store._fs.cat_file(store._path("a", MANIFEST)))
    value["files"] = {name: {"sha256": "0", "bytes": 1}}
    overwrite(store, f"a/{MANIFEST}", json.dumps(value).encode())
    with pytest.raises(InputError) as refused:
        store.find("a")
    assert "inside the attempt" in refused.value.expected


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{}", b"[" * 99_999, b'{"kind": "gnm-artifact", "schema": 1}', b"\xff"]
)
def test_a_malformed_manifest_is_refused(store: Store, content: bytes) -> None:
    overwrite(store, f"a/{MANIFEST}", content)
    with pytest.raises(InputError):
        store.find("a")


def test_old_iterations_are_retired(store: Store) -> None:
    for key in ("run/it00/a", "run/it01/a", "run/it01/s/b", "run/it02/a", "run/final", "other/it00/a"):
        store.produce(key, input_hash="one", make=write)
    assert store.retire("run", keep=2) == ["run/it00"]
    assert list(store.keys()) == ["other/it00/a", "run/final", "run/it01/a", "run/it01/s/b", "run/it02/a"]
    assert not store.verify().orphaned
    assert store.retire("run", keep=2) == []


def test_tidy_removes_only_old_unpublished_files(store: Store) -> None:
    store.produce("a", input_hash="one", make=write)
    store.produce("a", input_hash="two", make=write)
    assert store.tidy(older_than_s=3600) == 0
    time.sleep(1.1)  # modification times in object storage have a resolution of one second
    assert store.tidy(older_than_s=0.01) == 2
    assert store.verify().is_sound and not store.verify().orphaned
    assert store.find("a") is not None


def test_no_password_reaches_a_manifest(store: Store) -> None:
    store.produce("a", input_hash="one", make=lambda folder: {"from": "postgresql://me:secret@host/db"})
    assert b"secret" not in store._fs.cat_file(store._path("a", MANIFEST))


def test_a_foreign_scheme_is_refused() -> None:
    with pytest.raises(InputError):
        Store("nonsense://x")
