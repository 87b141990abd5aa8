"""The page for browsers: Rerun's own, but nothing of it is loaded from another computer."""

import http.client
import json
import re

import pytest

from rigd.live.page import kept_here

pytestmark = pytest.mark.xdist_group("realtime")


def get(port: int, path: str):
    """Ask the publisher's page server, as a browser does."""
    link = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        link.request("GET", path)
        answer = link.getresponse()
        return answer, answer.read()
    finally:
        link.close()


def test_a_browser_gets_the_viewer_and_is_kept_on_this_computer(publisher):
    port, viewer_url = publisher.address.page_port, publisher.address.viewer_url
    answer, _ = get(port, "/")
    assert answer.status == 302
    # Relative, for those that come through a tunnel from another port.
    assert answer.headers["Location"] == "/?" + viewer_url.split("?")[1]

    answer, body = get(port, answer.headers["Location"])
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

    answer, body = get(port, "/re_viewer_bg.wasm")
    assert answer.headers["Content-Type"] == "application/wasm"
    assert body[:4] == b"\0asm"
    assert len(body) == int(answer.headers["Content-Length"]) > 1_000_000
    answer, body = get(port, "/re_viewer.js")
    assert answer.status == 200
    assert b"WebHandle" in body

    answer, body = get(port, "/live.json")
    assert json.loads(body) == {"server": publisher.address.server}
    assert answer.headers["Cache-Control"] == "no-store"
    for path in ("/etc/passwd", "/../x", "/version"):
        assert get(port, path)[0].status == 404


def test_links_to_other_computers_are_left_out():
    page = (
        '<head><link rel="icon" href="favicon.ico" /><link rel="preconnect"\n'
        ' href="https://fonts.example" crossorigin /></head><body>x</body>'
    )
    kept = kept_here(page)
    assert 'href="favicon.ico"' in kept
    assert "fonts.example" not in kept
    assert kept.count("live.json") == 1
