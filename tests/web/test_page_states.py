"""Top bar of the operator's page: state, reason, STOP; and what stays where it is."""

import re

import pytest
from fake_web_server import STATIC, TOKEN, UTC_NS, fake_web_server, gauges, progress, status, strip
from playwright.sync_api import expect
from processes import eventually

pytestmark = pytest.mark.browser

TELL_S = 1.0
"""Within this time the page has to say what has happened."""


@pytest.fixture
def server():
    with fake_web_server() as server:
        yield server


@pytest.fixture
def page(server, open_page):
    """The page with the right to act, connected."""
    page = open_page(f"{server.address}#token={TOKEN}")
    expect(page.locator("#state-word")).to_have_text("READY")
    return page


def says(page, selector, text):
    """Check that an element says a text within a second."""
    expect(page.locator(selector)).to_contain_text(text, timeout=1000 * TELL_S)


def change(before, after, reason):
    return {
        "type": "state", "utc_ns": UTC_NS + 10**9, "from": before, "to": after, "reason": reason,
    }  # fmt: skip


FULL_DISK = "Free space on the session's disk 12 MB below limit 50 MB."


STATES = [
    (change("ready", "running", "chirp was started"), "PREPARING", "Chirp was", "stopping"),
    (change("running", "stopping", "stop asked for"), "STOPPING", "Stop asked", "stopping"),
    (change("stopping", "ready", "chirp was stopped"), "READY", "was stopped", "ready"),
    (change("running", "fault", FULL_DISK), "FAULT", "Free space", "alarm"),
    ({"type": "lost", "reason": "The daemon is gone."}, "OFFLINE", "press the STO", "quiet"),
    (status("idle", doing="connecting"), "CONNECTING", "", "quiet"),
    (status(zero_lost=True), "READY", "The zero is lost", "ready"),
]


def test_each_state_and_a_failed_stop_are_told_within_a_second(server, page, open_page):
    for message, word, reason, tone in STATES:
        server.tell(message)
        says(page, "#state-word", word)
        says(page, "#state-reason", reason)
        assert page.get_attribute("#bar", "data-tone") == tone
        assert page.is_visible("#fault") == (word == "FAULT")
    # A stop that fails says what to do, also where the server answers no more.
    server.replies["stop"] = {"ok": False, "error": "The daemon gave no answer."}
    page.click("#stop")
    says(page, "#state-reason", "Not stopped: The daemon gave no answer. Use rigd stop")
    page.wait_for_timeout(100)
    assert page.inner_text("#state-word") == "READY"
    server.close()
    page.click("#stop")
    says(page, "#state-reason", "Not stopped: The page's server does not answer.")
    # That it cannot be reached is what is tested; an open page would try again.
    page.close()
    open_page.complaints.clear()


@pytest.mark.further
def test_a_lost_server_is_told_and_found_again(server, page):
    server.hang_up()
    says(page, "#state-word", "OFFLINE")
    assert page.is_disabled("#start-button")
    expect(page.locator("#state-word")).to_have_text("READY")
    assert page.is_enabled("#start-button")


@pytest.mark.further  # as tests/daemon/test_service.py has it of the status
def test_a_session_that_is_prepared_does_not_run_yet(server, page):
    server.tell(status("running"), progress(0.0, activity="preparing"))
    says(page, "#state-word", "PREPARING")
    server.tell(progress(0.1, activity="running"))
    says(page, "#state-word", "RUNNING")


@pytest.mark.further
def test_a_session_that_runs_and_says_nothing_is_offline(server, page):
    server.tell(status("running"), progress(0.1))
    says(page, "#state-word", "RUNNING")
    expect(page.locator("#state-word")).to_have_text("OFFLINE")
    server.tell(status("running"), progress(0.2))
    says(page, "#state-word", "RUNNING")


@pytest.mark.further
def test_a_fault_names_its_reason_and_the_way_out(server, page):
    reason = "Angle 0.51 rad exceeds limit 0.5 rad. " + "Turn it back. " * 20
    server.tell(status("fault", reason=reason))
    says(page, "#fault-reason", reason.strip())
    assert page.is_disabled("#start-button")
    page.click("#fault-reset")
    says(page, "#rig-result", "Fault reset.")
    assert server.asked == [("reset", True)]


@pytest.mark.further
def test_progress_tells_time_left_phase_and_frequency(server, page):
    controller = {"pid": 812, "uid": 1000, "user": "ada"}
    server.tell(
        status("running", controller=controller),
        progress(0.5, session=2, repeat=3, missed=7),
        gauges(0.4, frequency_hz=12.345),
    )
    says(page, "#frequency", "12.3 Hz")
    says(page, "#time-left", "1:08")
    says(page, "#phase", "recording, 2 of 3")
    says(page, "#controller", "ada, process 812")
    says(page, "#count-missed", "7")
    # Where time is skipped there is no time left to tell.
    server.tell(progress(0.25, time_left_s=None))
    says(page, "#time-left", "25 %")


@pytest.mark.further
def test_a_stop_does_not_wait_behind_downloads(server, page):
    server.replies["stop"] = {"stopping": True}
    page.evaluate("() => { for (let k = 0; k < 8; k++) fetch(`/api/sessions/${k}/file.mat`); }")
    # As many as a browser has connections to one server.
    assert eventually(lambda: server.asked.count(("file", False)) == 6)
    page.click("#stop")
    says(page, "#state-reason", "Stop requested.")
    assert ("stop", False) in server.asked


@pytest.mark.further
def test_a_stop_that_is_not_answered_in_time_is_told(server, page):
    server.replies["stop"] = None
    page.click("#stop")
    told = page.locator("#state-reason")
    expect(told).to_contain_text("Not stopped: No answer within 3 s.", timeout=10_000)
    assert not page.get_attribute("#stop", "aria-busy")


def test_without_the_token_the_page_is_read_only_and_stops(server, open_page):
    page = open_page(server.address)
    expect(page.locator("#state-word")).to_have_text("READY")
    assert "rigd serve --web" in page.inner_text("#read-only")
    page.wait_for_selector("#rows tr")
    page.check("#rows tr:nth-child(1) input")
    page.check("#rows tr:nth-child(3) input")
    for needs_right in ("#start-button", "#zero", "#tare", "#check", "#reset", "#campaign"):
        assert page.is_disabled(needs_right)
    for free in ("#stop", "#predict", "#overlay"):
        assert page.is_enabled(free)
    server.replies["stop"] = {"stopping": True}
    page.focus("#stop")
    page.keyboard.press("Enter")
    says(page, "#state-reason", "Stop requested.")
    assert server.asked == [("stop", False)]
    assert "not an emergency stop" in page.inner_text(".stop")


@pytest.mark.further
def test_the_token_stays_with_the_tab_and_leaves_the_address(page, server):
    assert TOKEN not in page.url
    page.reload()
    expect(page.locator("#state-word")).to_have_text("READY")
    assert page.is_enabled("#start-button")


@pytest.mark.further
@pytest.mark.parametrize("width", [360, 390, 1280])
def test_nothing_jumps_or_overflows_when_a_session_runs(server, open_page, width):
    page = open_page(f"{server.address}#token={TOKEN}", width=width)
    page.wait_for_selector("#rows tr")
    boxes = """() => ["#stop", "#live", "#response", "#start", "#rig", "#sessions"].map(
        (each) => { const box = document.querySelector(each).getBoundingClientRect();
            return [each, Math.round(box.x), Math.round(box.y), Math.round(box.width)] })"""
    before = page.evaluate(boxes)
    server.tell(
        status("running", controller={"pid": 4_194_304, "uid": 1000, "user": "a.rather.long.name"}),
        progress(0.5, repeat=1000, session=999, missed=123_456, late=123_456, phase="waiting"),
        strip(0.0, 200),
        gauges(1.2),
        {"type": "event", "utc_ns": UTC_NS, "level": "warning", "text": "Very long. " * 50},
    )
    says(page, "#phase", "waiting for the beam to rest")
    assert page.evaluate(boxes) == before
    assert page.evaluate("document.documentElement.scrollWidth") == width
    bar = page.locator("#bar")
    assert bar.evaluate("bar => bar.scrollHeight - bar.clientHeight") <= 1


@pytest.mark.further
def test_the_page_is_there_within_a_second(server, open_page):
    loaded_s = []
    for _ in range(3):  # of which the computer may have been elsewhere for one or two
        page = open_page(server.address)
        says(page, "#state-word", "READY")
        timing = "() => performance.getEntriesByType('navigation')[0].loadEventEnd"
        loaded_s.append(page.evaluate(timing) / 1e3)
    assert min(loaded_s) < 1.0
    # Its modules come at once, not each when the one before has been read.
    asked = set(re.findall(r"/static/(\w+\.js)", (STATIC / "index.html").read_text()))
    assert asked == {path.name for path in STATIC.glob("*.js")}
