"""The page for browsers: Rerun's own, but nothing is loaded from another computer."""

import json
import os
import re
import socket
import threading

import pytest
from processes import sockets

from rigd.live._page import ViewerPageServer, confine_to_loopback

pytestmark = pytest.mark.process


def test_page_loads_only_from_this_computer(received):
    address, answers = received["address"], received["page"]
    answer, _ = answers["/"]
    assert answer.status == 302
    # Relative, for browsers that connect through a tunnel from another port.
    assert answer.headers["Location"] == "/?" + address.viewer_url.split("?")[1]

    answer, body = answers[answer.headers["Location"]]
    page = body.decode()
    assert answer.status == 200
    assert "the_canvas_id" in page, "it is the viewer"
    assert re.findall(r"<(?:link|script|img|iframe)[^>]*//[^>]*>", page) == []
    policy = dict(
        part.strip().split(" ", 1) for part in answer.headers["Content-Security-Policy"].split(";")
    )
    assert policy["default-src"] == "'none'"
    hosts = {word for sources in policy.values() for word in sources.split() if "/" in word}
    assert hosts == {"http://127.0.0.1:*", "http://localhost:*"}

    answer, body = answers["/re_viewer_bg.wasm"]
    assert answer.headers["Content-Type"] == "application/wasm"
    assert body[:4] == b"\0asm"
    assert len(body) == int(answer.headers["Content-Length"]) > 1_000_000
    answer, body = answers["/re_viewer.js"]
    assert answer.status == 200
    assert b"WebHandle" in body

    answer, body = answers["/live.json"]
    assert json.loads(body) == {"server": address.server}
    assert answer.headers["Cache-Control"] == "no-store"
    for path in ("/etc/passwd", "/../x", "/version"):
        assert answers[path][0].status == 404


def test_links_to_other_computers_are_removed():
    page = (
        '<head><link rel="icon" href="favicon.ico" /><link rel="preconnect"\n'
        ' href="https://fonts.example" crossorigin /></head><body>x</body>'
    )
    confined = confine_to_loopback(page)
    assert 'href="favicon.ico"' in confined
    assert "fonts.example" not in confined
    assert confined.count("live.json") == 1


@pytest.fixture
def page():
    """A page server without content."""
    server = ViewerPageServer(0, lambda: None, lambda: 0)
    yield server
    server.close()


def test_requests_with_another_host_name_are_refused(page, get):
    """As with a name that was made to resolve to this computer."""
    assert get(page.port, "/live.json", "evil.example")[0].status == 403
    assert get(page.port, "/live.json", f"evil.example:{page.port}")[0].status == 403
    for host in ("127.0.0.1", "localhost", "localhost:12345"):  # with any port of a tunnel
        assert get(page.port, "/live.json", host)[0].status == 503


def test_idle_connections_are_limited(monkeypatch):
    monkeypatch.setattr("rigd.live._page._MAX_CONNECTIONS", 2)
    before = threading.active_count()
    page = ViewerPageServer(0, lambda: None, lambda: 0)
    idle = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(6)]
    try:
        for connection in idle[2:]:
            connection.settimeout(30.0)
            assert connection.recv(1) == b""
        # Besides the server's own thread, one for each connection and one for its time-out.
        assert threading.active_count() <= before + 1 + 2 * 2
    finally:
        for connection in idle:
            connection.close()
        page.close()


def test_duration_of_a_connection_is_limited(monkeypatch, page):
    monkeypatch.setattr("rigd.live._page._MAX_CONNECTION_DURATION_S", 0.2)
    with socket.create_connection(("127.0.0.1", page.port), 30.0) as connection:
        connection.sendall(b"GET / HTTP/1.0\r\n")  # its end never comes
        assert connection.recv(1) == b""


def test_closed_page_leaves_no_socket_and_thread(page):
    local_address = f"0100007F:{page.port:04X}"  # as /proc/net/tcp writes it
    assert local_address in {end.local for end in sockets(os.getpid())}
    page.close()
    assert local_address not in {end.local for end in sockets(os.getpid())}
    assert not [t for t in threading.enumerate() if "serve_forever" in t.name]
