import hashlib
import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from registration.errors import InputError
from registration.model import fetch, gnm_npz
from registration.model.fetch import FILE, Source
from tests.fixtures.make_fixtures import HERE
from workflows.cli.app import main

MODEL = (HERE / "tiny_gnm.npz").read_bytes()
VARIABLES = ("GNM_CACHE_DIR", "HF_HOME", "HF_ENDPOINT", "KAGGLEHUB_CACHE", "KAGGLE_API_ENDPOINT")


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """The path of the official file in our cache; nothing is in any cache."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY", *VARIABLES):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "cache" / "gnm-registration" / "v3_0" / "gnm_head.npz"


class Quiet(SimpleHTTPRequestHandler):
    asked: list[str] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        super().do_GET()

    def log_message(self, *args: object) -> None: ...


class Breaking(BaseHTTPRequestHandler):
    """Breaks every transfer off after 20000 bytes, and continues where it is asked to."""

    tag: str | None = '"1"'
    ranges: list[str | None] = []
    new_version_at = 99  # number of the request from which on the file has another tag

    def do_GET(self) -> None:
        self.ranges.append(self.headers.get("Range"))
        tag = self.tag if len(self.ranges) < self.new_version_at else '"2"'
        start = 0
        if (wanted := self.headers.get("Range")) and self.headers.get("If-Range") == tag:
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(MODEL) - start))
        if tag is not None:
            self.send_header("ETag", tag)
        self.end_headers()
        self.wfile.write(MODEL[start : start + 20_000])

    def log_message(self, *args: object) -> None: ...


def serving(handler) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def site(tmp_path) -> Iterator[tuple[str, Path]]:
    root = tmp_path / "site"
    (root / "v3_0").mkdir(parents=True)
    Quiet.asked.clear()
    for address in serving(partial(Quiet, directory=str(root))):
        yield address, root / "v3_0" / "gnm_head.npz"


@pytest.fixture
def breaking() -> Iterator[tuple[str, type[Breaking]]]:
    handler = type("Handler", (Breaking,), {"ranges": []})
    for address in serving(handler):
        yield address, handler


def at(address: str, sha256: str | None = None) -> Source:
    return Source(name="http", address=f"{address}/{FILE}", page="https://example.org", sha256=sha256)


def refused(cache: Path, source: Source) -> InputError:
    with pytest.raises(InputError) as caught:
        fetch.fetch(source)
    assert list(cache.parent.iterdir()) == []
    assert str(cache) in caught.value.fix and source.page in caught.value.fix
    return caught.value


class Messages:
    def __init__(self) -> None:
        self.texts: list[str] = []
        self.updates: list[tuple[int, int]] = []

    def message(self, text: str) -> None:
        self.texts.append(text)

    def update(self, done: int, total: int, label: str) -> None:
        self.updates.append((done, total))


def test_downloads_once_and_records_the_source(cache, site):
    address, served = site
    served.write_bytes(MODEL)
    told = Messages()
    assert fetch.fetch(at(address), progress=told) == cache == fetch.cached_path()
    assert cache.read_bytes() == MODEL
    assert any("Apache-2.0" in text for text in told.texts) and told.updates[-1] == (len(MODEL), len(MODEL))
    assert sorted(path.name for path in cache.parent.iterdir()) == ["gnm_head.npz", "gnm_head.source.json"]
    record = fetch.source_record(cache)
    assert record is not None and record["address"] == at(address).address and record["licence"] == "Apache-2.0"
    assert (record["sha256"], record["bytes"]) == (hashlib.sha256(MODEL).hexdigest(), len(MODEL))
    assert any("differs from the release" in text for text in told.texts)
    assert fetch.fetch(at(address)) == cache
    assert Quiet.asked == ["/v3_0/gnm_head.npz"]
    gnm_npz.read(cache)
    cache.write_bytes(MODEL + b"\0")  # placed by hand since
    assert fetch.source_record(cache) is None


@pytest.mark.parametrize(
    "place",
    [
        f"gnm_dir/{FILE}",
        f"gnm_dir/models--google--gnm-v3/snapshots/c01e/{FILE}",
        f"gnm_dir/google_gnm-v3/{FILE}",
        f"cache/gnm/models/{FILE}",
        f"home/.cache/gnm/models/{FILE}",
        f"cache/huggingface/hub/models--google--gnm-v3/snapshots/c01e/{FILE}",
        "home/.cache/kagglehub/models/google/gnm-v3/other/gnm_head_v3_0/1/gnm_head.npz",
        f"cache/gnm-registration/{FILE}",
    ],
)
def test_a_file_on_this_machine_is_used_where_it_lies(cache, tmp_path, monkeypatch, place):
    monkeypatch.setenv("GNM_CACHE_DIR", str(tmp_path / "gnm_dir"))
    path = tmp_path / place
    path.parent.mkdir(parents=True)
    path.write_bytes(MODEL)
    before = sorted(tmp_path.rglob("*"))
    assert fetch.fetch(at("http://no-such-host.invalid")) == path
    assert sorted(tmp_path.rglob("*")) == before


def test_googles_caches_come_first(cache, tmp_path, monkeypatch):
    monkeypatch.setenv("GNM_CACHE_DIR", str(tmp_path / "gnm_dir"))
    places = [tmp_path / place / FILE for place in ("gnm_dir", "cache/gnm/models", "home/.cache/gnm/models")]
    for path in (*places, cache):
        path.parent.mkdir(parents=True)
        path.write_bytes(MODEL)
    assert list(fetch.installed_files()) == [*places, cache]
    places[0].write_bytes(MODEL[:1000])
    told = Messages()
    assert fetch.fetch(progress=told) == places[1]
    assert str(places[0]) in told.texts[0] and "cut short" in told.texts[0]
    assert str(places[1]) in told.texts[1] and "no landmark scheme" in told.texts[1]


def test_a_damaged_file_in_our_cache_is_an_error(cache):
    cache.parent.mkdir(parents=True)
    cache.write_bytes(MODEL[:1000])
    with pytest.raises(InputError, match="cannot be read"):
        fetch.fetch(at("http://no-such-host.invalid"))


def test_an_interrupted_transfer_is_continued(cache, breaking):
    address, handler = breaking
    assert fetch.fetch(at(address)).read_bytes() == MODEL
    assert handler.ranges[0] is None and handler.ranges[1] == "bytes=20000-"


def test_parts_of_two_versions_are_not_joined(cache, breaking):
    address, handler = breaking
    handler.new_version_at = 2  # the second request gets all of the new version from its start
    assert fetch.fetch(at(address)).read_bytes() == MODEL
    assert len(handler.ranges) == 4


@pytest.mark.parametrize("tag", [None, 'W/"1"'])
def test_without_a_version_the_transfer_begins_again_and_gives_up(cache, breaking, tag):
    address, handler = breaking
    handler.tag = tag
    assert f"of {len(MODEL)} bytes" in refused(cache, at(address)).got
    assert handler.ranges == [None] * 4


def test_without_a_network_the_error_names_where_to_put_the_file(cache):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}"  # bound but not listening: connections are refused
        error = refused(cache, at(address))
    assert "cannot be downloaded" in error.what and error.where == f"{address}/v3_0/gnm_head.npz"


def test_with_an_unknown_host_the_error_names_where_to_put_the_file(cache):
    refused(cache, at("http://no-such-host.invalid"))


def test_a_missing_file_on_the_server_is_refused(cache, site):
    assert "404" in refused(cache, at(site[0])).got


@pytest.mark.parametrize(
    ("content", "got"),
    [(b"<html>please log in</html>", "a web page"), (b"", "an empty file"), (MODEL[:30_000], "cut short")],
)
def test_a_download_that_is_no_model_is_refused(cache, site, content, got):
    site[1].write_bytes(content)
    error = refused(cache, at(site[0]))
    assert "cannot be read" in error.what and got in error.got


def test_another_file_than_the_address_names_is_refused(cache, site):
    site[1].write_bytes(MODEL)
    assert "not the released model" in refused(cache, at(site[0], sha256="0" * 64)).what
    assert fetch.fetch(at(site[0], sha256=hashlib.sha256(MODEL).hexdigest())) == cache


def test_the_landmark_scheme_comes_with_the_model(cache, site):
    address, served = site
    served.write_bytes(MODEL)
    source = replace(at(address), landmarks=f"{address}/v3_0/head_sparse_68.txt")
    told = Messages()
    assert fetch.fetch(source, progress=told) == cache
    assert any("cannot be had (404" in text and "head_sparse_68.txt" in text for text in told.texts)
    told = Messages()
    fetch.fetch(source, progress=told)
    (text,) = told.texts
    assert "there is no landmark scheme beside" in text
    for content, there in ((b"<html>", False), ((HERE / "head_sparse_68.txt").read_bytes(), True)):
        cache.unlink()
        (served.parent / "head_sparse_68.txt").write_bytes(content)
        fetch.fetch(source)
        assert cache.with_name("head_sparse_68.txt").is_file() == there
    told = Messages()
    fetch.fetch(source, progress=told)
    assert told.texts == []


def test_a_file_that_is_too_large_is_refused(cache, site, monkeypatch):
    site[1].write_bytes(MODEL)
    monkeypatch.setattr(fetch, "_MAX_BYTES", 1000)
    assert "more than 1000" in refused(cache, at(site[0])).got


def test_the_public_addresses(monkeypatch):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    public = fetch.sources()
    assert public["http"].address == "https://huggingface.co/google/gnm-v3/resolve/main/v3_0/gnm_head.npz"
    assert public["huggingface"].address.startswith("https://huggingface.co/google/gnm-v3/resolve/c01e90d2")
    assert public["huggingface"].sha256 is not None
    assert public["kaggle"].address.startswith(
        "https://www.kaggle.com/api/v1/models/google/gnm-v3/other/gnm_head_v3_0/"
    )


def test_the_command(cache, tmp_path, monkeypatch, capsys):
    site = tmp_path / "mirror"
    for source in ("huggingface", "kaggle"):
        monkeypatch.setenv("HF_ENDPOINT", "http://host")
        monkeypatch.setenv("KAGGLE_API_ENDPOINT", "http://host")
        path = site / fetch.sources()[source].address.removeprefix("http://host/")
        path.parent.mkdir(parents=True)
        path.write_bytes(MODEL)
    for address in serving(partial(Quiet, directory=str(site))):
        monkeypatch.setenv("HF_ENDPOINT", address)
        monkeypatch.setenv("KAGGLE_API_ENDPOINT", address)
        monkeypatch.setattr(fetch, "LANDMARKS", f"{address}/head_sparse_68.txt")
        assert main(["model", "fetch", "--source", "huggingface"]) == 2  # it is not the released file
        assert "expected: sha256 61d78bbf" in capsys.readouterr().err
        assert main(["model", "fetch", "--source", "kaggle"]) == 0
    assert capsys.readouterr().out.strip() == str(cache)
    assert json.loads(cache.with_suffix(".source.json").read_text())["source"] == "kaggle"
