"""The check of requests to pages, on viser's real server."""

import asyncio
import http.client
from collections.abc import Iterator
from typing import Any

import pytest
import viser
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

from tests.workflows.browser import CHROMIUM, FLAGS, needs_browser
from workflows.web.page_access import PageAccess, guarded_servers
from workflows.web.server import PageServer, literal

NAME = "![x](http://127.0.0.1:1/x.png) <img src=http://127.0.0.1:1/y.png> `a` *b* {c}"


@pytest.fixture(scope="module")
def page() -> Iterator[PageServer]:
    served = PageServer(0, "PageAccess")
    yield served
    served.close()


def get(page: PageServer, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in {"Host": f"127.0.0.1:{page.port}", **headers}.items():
        connection.putheader(name, value)
    connection.endheaders()
    return connection.getresponse()


def opens(page: PageServer, query: str, **headers: str) -> bool:
    """Whether a web socket opens, and the server sends the page's content on it."""

    async def attempt() -> bool:
        url = f"ws://127.0.0.1:{page.port}/{query}"
        protocols = [Subprotocol(f"viser-v{viser.__version__}")]
        host = headers.pop("Host", None)
        settings: dict[str, Any] = {"subprotocols": protocols, "additional_headers": headers, "proxy": None}
        if host is not None:  # the client derives the header from the URL
            settings |= {"host": "127.0.0.1", "port": page.port}
            url = f"ws://{host}/{query}"
        try:
            async with connect(url, **settings) as socket:
                return bool(await asyncio.wait_for(socket.recv(), 10))
        except InvalidStatus as refused:
            assert refused.response.status_code == 403
            return False

    return asyncio.run(attempt())


def query(page: PageServer) -> str:
    return page.url.partition("/?")[2]


def test_the_printed_url_opens_the_page_and_sets_a_strict_cookie(page: PageServer) -> None:
    answer = get(page, f"/?{query(page)}")
    cookie = answer.headers["Set-Cookie"]
    assert answer.status == 200 and b"<html" in answer.read()
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert answer.headers["X-Frame-Options"] == "DENY" and answer.headers["Referrer-Policy"] == "no-referrer"
    assert get(page, "/", Cookie=f"other=1; {cookie.partition(';')[0]}").status == 200
    assert opens(page, "", Cookie=cookie.partition(";")[0], Origin=f"http://127.0.0.1:{page.port}")


def test_nothing_is_served_without_the_token(page: PageServer) -> None:
    for path in ("/", "/index.html", "/?token=", "/?token=x", f"/?{query(page)}x", "/?" + "&" * 5000, "/x/../y"):
        answer = get(page, path)
        assert answer.status == 403 and b"URL that the command printed" in answer.read(), path
    assert get(page, "/", Cookie=f"gnmreg-{page.port}=wrong").status == 403
    for words in ("", "?token=", "?token=wrong"):
        assert not opens(page, words, Origin=f"http://127.0.0.1:{page.port}")


ORIGINS = ("https://evil.example", "http://127.0.0.1:1", "http://localhost.evil.example", "null", "file://", "")


@pytest.mark.parametrize("origin", ORIGINS)
def test_a_foreign_origin_is_refused_even_with_the_token(page: PageServer, origin: str) -> None:
    assert get(page, f"/?{query(page)}", Origin=origin).status == 403
    assert not opens(page, f"?{query(page)}", Origin=origin)


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example", "10.0.0.1", "[", ""])
def test_a_wrong_host_is_refused_even_with_the_token(page: PageServer, host: str) -> None:
    host = host.replace("{port}", str(page.port))
    assert get(page, f"/?{query(page)}", Host=host).status == 403
    if "evil" in host:
        assert not opens(page, f"?{query(page)}", Host=host)
        assert not opens(page, f"?{query(page)}", Host=host, Origin=f"http://{host}")


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:{port}", "localhost:9999", "[::1]:{port}"])
def test_the_page_and_tunnels_to_it_are_served(page: PageServer, host: str) -> None:
    host = host.replace("{port}", str(page.port))
    assert get(page, f"/?{query(page)}", Host=host, Origin=f"http://{host}").status == 200
    assert opens(page, f"?{query(page)}", Host=host, Origin=f"http://{host}")


def test_each_page_has_a_token_of_its_own(page: PageServer) -> None:
    other = PageServer(0, "Other")
    try:
        assert query(other) != query(page) and get(other, f"/?{query(page)}").status == 403
        assert other.url.startswith("http://127.0.0.1:")
    finally:
        other.close()


def test_a_release_of_viser_without_the_check_does_not_start() -> None:
    with pytest.raises(RuntimeError, match="another way"), guarded_servers(PageAccess()):
        pass


@needs_browser
def test_only_the_printed_url_works_in_a_browser(page: PageServer) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    page._server.gui.add_markdown(f"### {literal(NAME)}")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        tab = browser.new_page()
        tab.goto(f"http://127.0.0.1:{page.port}/")
        assert "Refused" in tab.inner_text("body")
        requests = []
        tab.on("request", lambda request: requests.append(request.url))
        with tab.expect_websocket() as socket:
            tab.goto(page.url)
        socket.value.wait_for_event("framereceived", timeout=30_000)
        sync_api.expect(tab.get_by_text(NAME)).to_be_visible(timeout=30_000)
        assert all("//127.0.0.1:1/" not in url for url in requests)
        tab.goto("about:blank")
        opened = tab.evaluate(
            """url => new Promise(done => { const s = new WebSocket(url);
                s.onopen = () => done(true); s.onerror = () => done(false); })""",
            f"ws://127.0.0.1:{page.port}/?{query(page)}",
        )
        browser.close()
    assert not opened
