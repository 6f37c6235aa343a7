import socket
import threading
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from registration.errors import InputError
from registration.model import fetch, gnm_npz
from tests.fixtures.make_fixtures import HERE


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "cache" / "gnm-registration" / "v3_0" / "gnm_head.npz"


class Quiet(SimpleHTTPRequestHandler):
    asked: list[str] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        super().do_GET()

    def log_message(self, *args: object) -> None: ...


class CutShort(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        content = (HERE / "tiny_gnm.npz").read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content[:20_000])

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


def refused(cache: Path, address: str) -> InputError:
    with pytest.raises(InputError) as caught:
        fetch.fetch(address)
    assert list(cache.parent.iterdir()) == []
    return caught.value


def test_downloads_once(cache, site):
    address, served = site
    served.write_bytes((HERE / "tiny_gnm.npz").read_bytes())
    assert fetch.fetch(address) == cache == fetch.cached_path()
    assert cache.read_bytes() == served.read_bytes()
    assert list(cache.parent.iterdir()) == [cache]
    assert fetch.fetch(address) == cache
    assert Quiet.asked == ["/v3_0/gnm_head.npz"]
    gnm_npz.read(cache)


def test_without_a_network_the_error_names_where_to_put_the_file(cache):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}"  # bound but not listening: connections are refused
        error = refused(cache, address)
    assert "cannot be downloaded" in error.what and error.where == f"{address}/v3_0/gnm_head.npz"
    assert error.fix.endswith(str(cache))


def test_with_an_unknown_host_the_error_names_where_to_put_the_file(cache):
    assert refused(cache, "http://no-such-host.invalid").fix.endswith(str(cache))


def test_a_missing_file_on_the_server_is_refused(cache, site):
    assert "404" in refused(cache, site[0]).got


def test_a_download_that_is_no_model_is_refused(cache, site):
    site[1].write_bytes(b"<html>please log in</html>")
    assert "cannot be read" in refused(cache, site[0]).what


def test_an_incomplete_download_is_refused(cache):
    for address in serving(CutShort):
        assert "20000 of" in refused(cache, address).got


def test_the_official_address():
    assert f"{fetch.BASE_URL}/{fetch.FILE}".startswith("https://") and "google/gnm-v3" in fetch.BASE_URL
