"""The operator's page on the real daemon with the simulated rig, as a new operator uses it."""

import contextlib
import os
import re
import resource
import signal
import time

import pytest
from cases import further
from playwright.sync_api import expect
from processes import child_running
from web_daemon import rig_with_page

pytestmark = pytest.mark.browser

SHOWN_WITHIN_S = 1.0
"""Within this time the page must show an event of the daemon."""
END_MS = 60_000
"""For work of the rig or the analysis on an overloaded computer."""


@pytest.fixture
def serve(tmp_path, write_profile_in):
    """Start a daemon with its page, on a rig of this test's own."""
    with contextlib.ExitStack() as ending:
        yield lambda *options: ending.enter_context(
            rig_with_page(write_profile_in, tmp_path, *options)
        )


@pytest.fixture
def operate(serve, open_page):
    """Open the page of a new daemon, and fill in a chirp of 10 s."""

    def operate(*options):
        daemon = serve(*options)
        page = open_page(daemon.address)
        page.wait_for_selector("#start-button:enabled", timeout=END_MS)
        for name, value in (("duration_s", 10), ("rest_s", 0.2), ("ring_down_s", 0.5)):
            page.fill(f"#parameter-{name}", str(value))
        page.fill("#operator", "A. Novice")
        page.fill("#specimen", "antenna 3")
        page.evaluate(WATCH)
        return daemon, page

    return operate


WATCH = """() => {
    const word = document.querySelector("#state-word");
    window.shownAt = {};
    new MutationObserver(() => { window.shownAt[word.textContent] = Date.now() / 1e3; })
        .observe(word, { childList: true, characterData: true, subtree: true });
}"""


def expect_text(page, selector, text):
    expect(page.locator(selector)).to_contain_text(text, timeout=END_MS)


def start(page):
    page.wait_for_selector("#start-button:enabled", timeout=END_MS)
    page.click("#start-button")
    # Under the virtual clock a session may end before the page is informed that it runs.
    begun = re.compile("PREPARING|RUNNING|RETURNING|FINISHING")
    expect(page.locator("#state-word")).to_have_text(begun, timeout=END_MS)


def delay_s(page, word, event):
    """Return the time from an event, as the daemon dates it, to its state on the page."""
    entry = page.locator("#event-list li", has_text=event).first
    return page.evaluate("() => window.shownAt")[word] - float(entry.get_attribute("data-at")) / 1e9


def expect_rows(page, count, outcome):
    """Wait for a number of sessions in the table, the newest with an outcome."""
    expect(page.locator("#rows tr[id]")).to_have_count(count, timeout=END_MS)
    expect_text(page, "#rows tr >> nth=0", outcome)


def test_session_in_real_time_is_shown_and_stopped(operate):
    _, page = operate("--no-look")
    start(page)
    expect_text(page, "#phase", "recording")
    expect_text(page, "#frequency", "Hz")
    expect_text(page, "#time-left", "0:")
    assert page.locator("#gauge-angle .percent").inner_text() != "–"
    assert page.get_attribute("#strip-angle", "aria-label") != "Angle: no data yet"
    page.click("#stop")
    expect_text(page, "#state-reason", "was stopped")
    assert delay_s(page, "READY", "→ ready: chirp was stopped") < SHOWN_WITHIN_S
    expect_rows(page, 1, "stopped")


@pytest.mark.further  # as test_page_states.py, test_page_server.py and tests/daemon
def test_failures_are_shown(operate, open_page):
    daemon, page = operate()

    def start_recording():
        start(page)
        expect_text(page, "#phase", "recording")

    def expect_fault_and_reset(reason):
        expect_text(page, "#state-word", "FAULT")
        assert delay_s(page, "FAULT", "→ fault") < SHOWN_WITHIN_S
        assert reason in page.inner_text("#fault-reason")
        page.click("#fault-reset")
        expect_text(page, "#state-word", "READY")

    start_recording()
    expect_text(page, "#response-keys", "measured")
    os.kill(child_running(daemon.process.pid, "control_process"), signal.SIGKILL)
    expect_fault_and_reset("control")

    start_recording()
    recorder = child_running(daemon.process.pid, "recorder")
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (20_000, 20_000))  # like a full disk
    expect_fault_and_reset("cannot be written")

    start_recording()
    daemon.process.send_signal(signal.SIGSTOP)
    stopped_s = time.time()
    expect_text(page, "#state-word", "OFFLINE")
    assert "Press the wired stop (STO)" in page.inner_text("#state-reason")
    # The daemon's status, sent twice a second, may just have come.
    assert page.evaluate("() => window.shownAt.OFFLINE") - stopped_s < SHOWN_WITHIN_S + 0.2
    daemon.process.send_signal(signal.SIGCONT)
    expect_text(page, "#state-word", "RUNNING")
    killed_s = time.time()
    daemon.process.kill()
    expect_text(page, "#state-word", "OFFLINE")
    assert page.evaluate("() => window.shownAt.OFFLINE") - killed_s < SHOWN_WITHIN_S
    # The page's server ends too, and the browser logs that it does not answer.
    page.close()
    open_page.complaints.clear()


@pytest.mark.parametrize(
    ("options", "reports"),
    [
        further(("--fast",), False, id="fast"),
        # Reports and campaigns take longer than the rest.
        pytest.param(("--fast",), True, id="fast-reports", marks=pytest.mark.slow),
        pytest.param((), True, id="real-time", marks=pytest.mark.slow),
    ],
)
def test_first_use_from_a_session_to_a_campaign(operate, open_page, options, reports):
    daemon, page = operate(*options)
    page.click("#predict")
    expect_text(page, "#prediction", "Predicted peaks")
    expect_text(page, "#prediction", "Largest allowed")

    # A chirp of 10 s to its end; a longer one, stopped; and the first once more.
    start(page)
    expect_rows(page, 1, "complete")
    page.fill("#parameter-duration_s", "600")
    start(page)
    expect_text(page, "#phase", "recording")
    page.click("#stop")
    expect_rows(page, 2, "stopped")
    page.fill("#parameter-duration_s", "10")
    start(page)
    expect_rows(page, 3, "complete")

    quick_looks = page.locator("#event-list li", has_text="Quick look at ")
    expect(quick_looks).to_have_count(3, timeout=2 * END_MS)
    row = "#rows tr[id] >> nth=0"
    page.click(f"{row} >> button.link >> nth=0")
    expect_text(page, ".detail:not([hidden])", "Mean coherence")
    if options:  # in real time, missed ticks may leave nothing to identify
        expect_text(page, f"{row} >> .modes", "Hz")
        expect_text(page, ".detail:not([hidden])", "95 % interval")
    completed = page.locator("#event-list li", has_text="Complete: ")
    expect(completed).to_have_count(2)
    for number in (0, 2):
        page.check(f"#rows tr[id] >> nth={number} >> input")
    page.click("#overlay")
    expect_text(page, "#comparison-keys", "antenna 3")
    expect(page.locator("#comparison-keys .key")).to_have_count(2)
    if not reports:
        return
    page.click(f"{row} >> text=Make report")
    report = page.locator("#sessions-result a")
    expect(report).to_have_text("open the report", timeout=2 * END_MS)
    assert "antenna 3" in report_of(daemon, open_page, report)

    if options:  # in real time, missed ticks may leave nothing to fit
        page.click("#campaign")
        expect(report).to_have_attribute("href", re.compile("campaign"), timeout=2 * END_MS)
        report_text = report_of(daemon, open_page, report)
        assert "antenna 3" in report_text
        assert "2 sessions" in report_text


def report_of(daemon, open_page, link):
    """Open the report behind a link of the page; return its text."""
    address = daemon.address.split("#")[0].rstrip("/") + link.get_attribute("href")
    return open_page(address).inner_text("body")
