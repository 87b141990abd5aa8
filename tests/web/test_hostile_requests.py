"""Hostile requests to the page's server: none acts, none reads other files than sessions."""

import base64
import contextlib
import json
import os
import time
import zlib

import pytest
from web_daemon import TOKEN, rig_with_page

from rigd.daemon.address import find_daemon_socket
from rigd.daemon.client import Client

START = json.dumps({"command": "start", "excitation": "chirp"}).encode()
RIGHT = {
    "Authorization": f"Bearer {TOKEN}",
    "X-Rigd": "1",
    "Content-Type": "application/json",
}
SECRET = b"nobody is to read this"


def without(*names):
    return {name: value for name, value in RIGHT.items() if name not in names}


@pytest.fixture(scope="module")
def secret_file(served, tmp_path_factory):
    """A file that must not be read, and paths to it."""
    secret = tmp_path_factory.mktemp("elsewhere") / "secret.mcap"
    write_secret_files(served.folder, secret)
    return secret


def write_secret_files(folder, secret):
    """Put files next to the folder of the sessions, and links to them into it."""
    secret.write_bytes(SECRET)
    (folder / "link.mcap").symlink_to(secret)
    (folder / "good.mcap").write_bytes(b"no session")
    (folder / "link.look.json").symlink_to(secret)
    (folder / "campaign.report").symlink_to(secret.parent)
    (folder / "good.report").mkdir()
    (folder / "good.report" / "report.html").write_text("a report")
    (folder / "good.report" / "secret.html").symlink_to(secret)
    (folder.parent / "secret.mcap").write_bytes(SECRET)
    (folder / ".hidden.mcap").write_bytes(SECRET)


@pytest.fixture(autouse=True)
def _server_runs_and_has_not_acted(served, secret_file):
    before = len(served.daemon.requests)
    yield
    acting = [each for each in served.daemon.requests[before:] if each["command"] not in OBSERVING]
    assert acting == []
    status, head, _ = served.request("GET", "/")
    assert status == 200
    assert "default-src 'self'" in head


OBSERVING = ("status", "watch")

WITHOUT_RIGHT = {
    "no token": without("Authorization"),
    "empty token": RIGHT | {"Authorization": "Bearer "},
    "wrong token": RIGHT | {"Authorization": f"Bearer {TOKEN}x"},
    "part of the token": RIGHT | {"Authorization": f"Bearer {TOKEN[:-1]}"},
    "token that is no ASCII": RIGHT | {"Authorization": "Bearer \xe4\xf6"},
    "other scheme": RIGHT
    | {"Authorization": "Basic " + base64.b64encode(f"u:{TOKEN}".encode()).decode()},
    "token as cookie": without("Authorization") | {"Cookie": f"token={TOKEN}"},
    "other origin": RIGHT | {"Origin": "http://evil.example"},
    "no origin at all": RIGHT | {"Origin": "null"},
    "origin of another local port": RIGHT | {"Origin": "http://127.0.0.1:1"},
    "origin of another scheme": RIGHT | {"Origin": "https://127.0.0.1"},
    "other site, says the browser": RIGHT | {"Sec-Fetch-Site": "cross-site"},
    "same site, says the browser": RIGHT | {"Sec-Fetch-Site": "same-site"},
    "other host": RIGHT | {"Host": "evil.example"},
    "host that begins like ours": RIGHT | {"Host": "127.0.0.1.evil.example"},
    "host with a user": RIGHT | {"Host": "127.0.0.1@evil.example"},
    "host with a path": RIGHT | {"Host": "evil.example/127.0.0.1"},
    "host that is not a name": RIGHT | {"Host": "[::1"},
    "no host": RIGHT | {"Host": None},
    "form of text/plain": without("X-Rigd") | {"Content-Type": "text/plain"},
    "plain text with our header": RIGHT | {"Content-Type": "text/plain"},
    "form": RIGHT | {"Content-Type": "application/x-www-form-urlencoded"},
    "form in parts": RIGHT | {"Content-Type": "multipart/form-data; boundary=x"},
    "without our header": without("X-Rigd"),
}


@pytest.mark.parametrize("headers", WITHOUT_RIGHT.values(), ids=WITHOUT_RIGHT)
def test_no_start_without_the_right(served, headers):
    status, _, body = served.request("POST", "/api/command", headers, START)
    assert status in (400, 403)
    assert TOKEN.encode() not in body


@pytest.mark.parametrize("path", ["/", "/static/main.js", "/api/sessions", "/favicon.ico"])
def test_another_site_gets_only_the_icon(served, path):
    """A report requests the icon: its sandbox makes it a page of another origin."""
    for site in ("cross-site", "same-site"):
        status, head, _ = served.request("GET", path, {"Sec-Fetch-Site": site}, b"")
        assert status == (200 if path == "/favicon.ico" else 403)
        shared = "cross-origin-resource-policy: cross-origin" in head.lower()
        assert shared is (path == "/favicon.ico")


@pytest.mark.parametrize("command", ["tare", "zero", "reset", "check"])
def test_no_command_acts_without_a_token(served, command):
    body = json.dumps({"command": command}).encode()
    status, _, _ = served.request("POST", "/api/command", without("Authorization"), body)
    assert status == 403


def test_token_in_the_address_is_ignored(served):
    target = f"/api/command?token={TOKEN}"
    status, _, _ = served.request("POST", target, without("Authorization"), START)
    assert status == 403


def test_prediction_without_a_token_reads_no_file(served, secret_file):
    request = {"command": "predict", "excitation": "file", "parameters": {"path": str(secret_file)}}
    status, _, _ = served.request(
        "POST", "/api/command", without("Authorization"), json.dumps(request).encode()
    )
    assert status == 403


@pytest.mark.parametrize("method", ["OPTIONS", "PUT", "DELETE", "TRACE", "GET", "PATCH", "FOO"])
def test_other_methods_are_refused(served, method):
    preflight = {
        "Origin": f"http://127.0.0.1:{served.port}",
        "Access-Control-Request-Method": "POST",
    }
    status, head, _ = served.request(method, "/api/command", RIGHT | preflight, START)
    assert status in (400, 405)
    assert "access-control" not in head.lower()


BODIES = {
    "no JSON": b"command=start",
    "a list": b"[" + START + b"]",
    "nested too deeply": b"[" * 30_000,
    "no command": b"{}",
    "command that is a list": b'{"command": ["start"]}',
    "one that watches": b'{"command": "watch"}',
    "two lines": START + b"\n" + START,
    "no UTF-8": b'{"command": "\xff"}',
    "more than is read": b" " * 70_000 + START,
    "nothing": b"",
}


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)
def test_invalid_requests_with_a_token_are_refused(served, body):
    status, _, _ = served.request("POST", "/api/command", RIGHT, body)
    assert status in (400, 413)


def test_a_compressed_request_is_not_unpacked(served):
    body = zlib.compress(START)
    headers = RIGHT | {"Content-Encoding": "deflate"}
    status, _, _ = served.request("POST", "/api/command", headers, body)
    assert status == 400


def test_bodies_of_100_mb_are_refused(served):
    block = b"x" * 65_536
    head = f"POST /api/command HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nX-Rigd: 1\r\n"
    head += f"Authorization: Bearer {TOKEN}\r\nContent-Type: application/json\r\n"
    began_s = time.monotonic()
    with_length = [head.encode() + b"Content-Length: 100000000\r\n\r\n", *[block] * 1526]
    answer = served.send(with_length)
    assert answer == b"" or b" 413 " in answer
    chunk = b"10000\r\n" + block + b"\r\n"
    answer = served.send([head.encode() + b"Transfer-Encoding: chunked\r\n\r\n", *[chunk] * 1526])
    assert answer == b"" or b" 413 " in answer
    assert time.monotonic() - began_s < 20.0


GARBAGE = {
    "noise": bytes(range(256)) * 8,
    "zeros": bytes(4096),
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(64),
    "header without end": b"GET / HTTP/1.1\r\nX: " + b"a" * 100_000 + b"\r\n\r\n",
    "many headers": b"GET / HTTP/1.1\r\n" + b"X: 1\r\n" * 10_000 + b"\r\n",
    "two lengths": b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\n"
    b"Content-Length: 90\r\n\r\n" + START,
    "length and pieces": b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + START,
    "address of another server": b"GET http://evil.example/ HTTP/1.1\r\n"
    b"Host: evil.example\r\nConnection: close\r\n\r\n",
}


@pytest.mark.parametrize("data", GARBAGE.values(), ids=GARBAGE)
def test_garbage_is_refused(served, short_timeouts, data):
    answer = served.send(data)
    assert answer == b"" or answer.split()[1][:1] == b"4"


READS = [
    "/static/../_server.py",
    "/static/%2e%2e/_server.py",
    "/static/..%2f_server.py",
    "/static/..%5c_server.py",
    "/static//etc/passwd",
    "/static/.",
    "/../../etc/passwd",
    "/api/sessions/../secret/file.mcap",
    "/api/sessions/%2e%2e%2fsecret/file.mcap",
    "/api/sessions/..%2Fsecret/file.mcap",
    "/api/sessions/%2fetc%2fpasswd/file.mcap",
    "/api/sessions/link/file.mcap",
    "/api/sessions/link/file.mat",
    "/api/sessions/link/look",
    "/api/sessions/.hidden/file.mcap",
    "/api/sessions/good%00/file.mcap",
    "/api/sessions/good/file.py",
    "/api/sessions/good/file...%2f..%2fsecret.mcap",
    "/api/sessions/good/report/secret.html",
    "/api/sessions/good/report/..%2f..%2fsecret.mcap",
    "/api/sessions/good/report/%2e%2e",
    "/api/campaign/campaign.report/secret.mcap",
    "/api/campaign/..%2f/secret.mcap",
    "/api/campaign/good.report/report.html",
    "/api/sessions/" + "a" * 5000 + "/file.mcap",
]


@pytest.mark.parametrize("target", READS)
def test_only_session_files_are_read(served, target):
    status, _, body = served.request("GET", target)
    assert status in (400, 404)
    assert SECRET not in body
    assert b"root:" not in body
    assert b"import" not in body


def test_the_overlay_reads_no_other_files(served):
    for ids in ("..%2fsecret", "link", ",".join(["good"] * 20)):
        status, _, body = served.request("GET", f"/api/frf?ids={ids}")
        assert SECRET not in body
        assert status in (200, 400, 404)


def test_invalid_pages_of_the_list_are_refused(served):
    for query in ("limit=-1", "limit=1e9", "offset=x", "limit=99999999999"):
        assert served.request("GET", f"/api/sessions?{query}")[0] == 400


def test_reports_and_campaigns_require_token_and_sessions(served):
    ids = json.dumps({"ids": ["good", "link"]}).encode()
    for target in ("/api/sessions/good/report", "/api/campaign"):
        assert served.request("POST", target, without("Authorization"), ids)[0] == 403
    assert served.request("POST", "/api/sessions/..%2fsecret/report", RIGHT, b"{}")[0] == 404
    for ids in (["good", "../secret"], ["good", "link"], ["good", "--jobs"], "good", ["good", 1]):
        body = json.dumps({"ids": ids}).encode()
        assert served.request("POST", "/api/campaign", RIGHT, body)[0] in (400, 404)


def handshake(**headers):
    key = base64.b64encode(os.urandom(16)).decode()
    return {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": key,
    } | headers


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://localhost:1"},
        {"Host": "evil.example"},
    ],
    ids=str,
)
def test_other_pages_cannot_read_the_live_signals(served, headers):
    status, _, _ = served.request(
        "GET", "/api/live", handshake(**headers, Connection="close, Upgrade")
    )
    assert status == 403


def test_page_is_disconnected_if_it_sends_a_frame(served):
    lines = [f"GET /api/live HTTP/1.1\r\nHost: 127.0.0.1:{served.port}"]
    lines += [f"{name}: {value}" for name, value in handshake().items()]
    # A frame of 16 MB, according to its head.
    frame = b"\x82\xff" + (1 << 24).to_bytes(8, "big") + b"mask" + b"x" * 100_000
    answer = served.send("\r\n".join(lines).encode() + b"\r\n\r\n" + frame)
    assert b" 101 " in answer


def test_silent_and_incomplete_clients_are_disconnected(served, short_timeouts):
    half = b"POST /api/command HTTP/1.1\r\nHost: localhost\r\nX-Rigd: 1\r\n"
    for sent in (b"", b"GET / HT", half):
        with served.connect() as link:
            link.sendall(sent)
            assert link.recv(1) == b""
    body = half + b"Content-Type: application/json\r\nContent-Length: 9\r\n\r\n{"
    assert b" 408 " in served.send(body)


def test_connections_of_others_displace_no_page(served, replace_in_page):
    replace_in_page(most_connections=8)
    host = f"Host: 127.0.0.1:{served.port}"
    opening = "\r\n".join(f"{name}: {value}" for name, value in handshake().items())
    with contextlib.ExitStack() as ending:
        page = ending.enter_context(served.connect())
        page.sendall(f"GET /api/live HTTP/1.1\r\n{host}\r\n{opening}\r\n\r\n".encode())
        assert b" 101 " in page.recv(1000)
        for _ in range(20):
            link = ending.enter_context(served.connect())
            link.sendall(f"GET / HTTP/1.1\r\n{host}\r\n\r\n".encode())
            assert b" 200 " in link.recv(1000)
        assert served.request("GET", "/")[0] == 200
        assert len(served.server.pages) == 1


def test_connections_beyond_the_limit_are_closed(served, short_timeouts):
    links = [served.connect() for _ in range(150)]
    for link in links:
        assert link.recv(1) == b""  # at once, or because they send nothing
        link.close()


@pytest.fixture
def rig(tmp_path, tmp_path_factory, write_profile_in):
    """The real daemon with its page, time skipped, and a file that must not be read."""
    with rig_with_page(write_profile_in, tmp_path, "--fast") as rig:
        rig.folder.mkdir(exist_ok=True)
        write_secret_files(rig.folder, tmp_path_factory.mktemp("elsewhere") / "secret.mcap")
        yield rig


@pytest.mark.further  # as the page's server above, and test_page_daemon.py of a session
def test_real_daemon_refuses_all_and_runs_a_session_afterwards(rig):
    def with_own_token(headers):
        """Return headers with the daemon's own token in place of that of these tests."""
        return {name: text and text.replace(TOKEN, rig.token) for name, text in headers.items()}

    def refused(method, target, headers=(), body=b""):
        status, _, answer = rig.request(method, target, with_own_token(dict(headers)), body)
        assert 400 <= status < 500, (method, target, status)
        assert not any(secret in answer for secret in (SECRET, b"root:", rig.token.encode()))

    with Client(find_daemon_socket(rig.name)) as client:

        def status():
            document = client.ask("status")
            return (
                document["state"],
                document["series"],
                document["controller"],
                document["last_check"],
            )

        while status()[0] != "ready":
            time.sleep(0.02)
        for headers in WITHOUT_RIGHT.values():
            refused("POST", "/api/command", headers, START)
        for command in ("tare", "zero", "reset", "check"):
            body = json.dumps({"command": command}).encode()
            refused("POST", "/api/command", without("Authorization"), body)
        for body in BODIES.values():
            refused("POST", "/api/command", RIGHT, body)
        for target in READS:
            refused("GET", target)
        for ids in (["good", "../secret"], ["good", "link"], ["good", "--jobs"]):
            refused("POST", "/api/campaign", RIGHT, json.dumps({"ids": ids}).encode())
        rig.timeout_s = 0.2  # for requests that wait for more bytes
        for data in GARBAGE.values():
            with contextlib.suppress(TimeoutError):
                answer = rig.send(data)
                assert answer == b"" or answer.split()[1][:1] == b"4"
        assert status() == ("ready", None, None, None)

        rig.timeout_s = 30.0
        parameters = {"duration_s": 2.0, "rest_s": 0.1, "ring_down_s": 0.1}
        request = {"command": "start", "excitation": "chirp", "parameters": parameters}
        body = json.dumps(request).encode()
        assert rig.request("POST", "/api/command", with_own_token(RIGHT), body)[0] == 200
        while (series := client.ask("status")["series"])["running"]:
            time.sleep(0.02)
        assert [session["outcome"] for session in series["sessions"]] == ["complete"]
    assert rig.process.poll() is None
