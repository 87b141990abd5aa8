"""The operator's page: start, rig, live signals, responses, sessions, events."""

import re

import pytest
from fake_web_server import (
    MODES,
    PLAN,
    TOKEN,
    UTC_NS,
    fake_web_server,
    gauges,
    hello,
    job,
    response,
    session,
    status,
    strip,
)
from online_fits import online_fit
from playwright.sync_api import expect
from processes import eventually

pytestmark = pytest.mark.browser


@pytest.fixture
def server():
    with fake_web_server() as server:
        yield server


@pytest.fixture
def page(server, open_page):
    page = open_page(f"{server.address}#token={TOKEN}")
    page.wait_for_selector("#rows tr")
    return page


def expect_text(page, selector, text):
    expect(page.locator(selector)).to_contain_text(text)


def drawn_fraction(page, canvas):
    """Return the fraction of a canvas that is drawn on."""
    return page.evaluate(
        """canvas => {
            const { width, height } = document.querySelector(canvas);
            const { data } = document.querySelector(canvas).getContext("2d")
                .getImageData(0, 0, width, height);
            let points = 0;
            for (let k = 3; k < data.length; k += 4) points += data[k] > 0;
            return points / (width * height);
        }""",
        canvas,
    )


# Start


def test_start_sends_the_values_of_the_form(server, page):
    error = "The predicted peak angle of 0.6 rad exceeds 0.5 rad; lower the amplitude."
    server.replies["start"] = {"ok": False, "error": error}
    page.click("#start-button")
    expect_text(page, "#start-result", error)
    page.wait_for_selector("#start-button:enabled")
    server.send(hello(required_meta=["operator", "temperature_c"]), status())
    # The operator has a field of his own.
    expect(page.locator("#operator")).to_have_attribute("placeholder", "required")
    assert page.evaluate("document.getElementById('operator').required")
    assert not page.evaluate("document.getElementById('specimen').required")
    assert page.input_value("#metadata-rows .pair input >> nth=0") == "temperature_c"
    assert page.locator("#metadata-rows .pair").count() == 1
    page.fill("#parameter-amplitude_rad", "0,02")
    page.fill("#parameter-taper_s", "")
    page.fill("#repeat", "2")
    page.check("#force")
    page.fill("#operator", "R. Igge")
    page.fill("#specimen", "antenna 3")
    page.fill("#metadata-rows input:nth-child(2)", "21,4")
    page.click("#metadata-add")
    page.fill("#metadata-rows .pair:nth-child(2) input:nth-child(1)", "clamp")
    page.fill("#metadata-rows .pair:nth-child(2) input:nth-child(2)", "new")
    server.replies["start"] = {"series": 1, "plan": PLAN}
    page.click("#start-button")
    expect_text(page, "#prediction", "Predicted peaks")
    assert server.commands == [("start", True)] * 2
    assert server.requests[1:] == [
        {
            "command": "start", "excitation": "chirp", "repeat": 2, "force": True,
            "parameters": {
                "amplitude_rad": 0.02, "start_hz": 0.05, "stop_hz": 50, "duration_s": 120,
                "rest_s": 1, "ring_down_s": 15,
            },
            "notes": {
                "operator": "R. Igge", "specimen": "antenna 3",
                "meta": {"temperature_c": 21.4, "clamp": "new"},
            },
        }
    ]  # fmt: skip
    assert not page.is_checked("#force")  # required for each start
    # A failed check is shown, and accepted for one start.
    failed = {"name": "travel_no_angle", "text": "travel, if no angle comes: 2.50 rad"}
    beyond = {"name": "unknown_values", "text": "motor.peak_torque_nm: unknown"}
    rows = [failed | {"acceptable": True}, beyond | {"acceptable": False}]
    assert not page.is_visible("#failed-checks")
    shown = status()
    shown["daemon"]["failed_checks"] = rows
    server.send(shown)
    expect_text(page, "#failed-rows", "travel_no_angle: travel, if no angle comes: 2.50 rad")
    expect_text(page, "#failed-rows", "motor.peak_torque_nm")
    assert page.locator("#failed-rows input").count() == 1
    page.check("#failed-rows input")
    server.send(shown)  # the tick remains
    server.replies["predict"] = {"plan": PLAN | {"failed_checks": rows}}
    page.click("#predict")
    assert eventually(lambda: len(server.requests) == 3)
    page.click("#start-button")
    expect(page.locator("#failed-rows input")).not_to_be_checked()  # required for each start
    assert [request["accept"] for request in server.requests[2:]] == [["travel_no_angle"]] * 2


@pytest.mark.further
def test_each_excitation_has_its_own_parameters_with_units(page):
    assert "Amplitude" in page.inner_text("#parameters")
    assert "rad" in page.inner_text("#parameters")
    page.select_option("#excitation", "hold")
    assert page.locator("#parameters input").count() == 1
    assert page.input_value("#parameter-duration_s") == "10"


@pytest.mark.further
def test_target_precision_is_a_text_field(server, page):
    page.select_option("#excitation", "until")
    assert not page.is_visible("#watch-fit")  # it is fitted anyway
    page.fill("#parameter-targets", "damping 1%; alpha 0.03")
    server.replies["start"] = {"series": 1, "plan": PLAN}
    page.click("#start-button")
    expect_text(page, "#prediction", "Predicted peaks")
    request = {"targets": "damping 1%; alpha 0.03", "at_most_s": 120}
    assert (server.requests[0]["excitation"], server.requests[0]["parameters"]) == (
        "until", request,
    )  # fmt: skip
    assert "watch_fit" not in server.requests[0]


@pytest.mark.further
def test_the_record_of_any_excitation_can_be_fitted(server, page):
    server.replies["start"] = {"series": 1, "plan": PLAN}
    page.check("#watch-fit")
    page.click("#start-button")
    expect_text(page, "#prediction", "Predicted peaks")
    assert server.requests[0]["watch_fit"] is True


def series(fit, **members):
    return {
        "series": 1, "excitation": "until", "session": 1, "repeat": 1, "notes": {}, "plan": PLAN,
        "path": "/data/sessions/1.mcap", "running": True, "stopped": False, "failed": False,
        "reason": "", "fit": fit, "sessions": [], **members,
    }  # fmt: skip


def width(page, cell):
    """Return the width of the bar of an interval."""
    return page.locator(f"{cell} .fill").bounding_box()["width"]


@pytest.mark.further
def test_modes_and_targets_of_each_fit_are_shown(server, page):
    assert not page.is_visible("#fit")
    server.send(status("running", series=series(None)))
    expect_text(page, "#fit-of", "not yet")
    server.send(status("running", series=series(online_fit(6.0, 4.0))))
    expect_text(page, "#fit-of", "first 6.0 s of the record")
    expect_text(page, "#fit-search", "About 12 s more.")
    cell = "#fit-modes tbody tr:nth-child(1) td:nth-child(3)"
    expect_text(page, cell, "0.910 ± 0.078")
    widest = width(page, cell)
    target_row = "#fit-targets tbody tr:nth-child(1)"
    expect_text(page, target_row, "0.00040 (4.4 %)")
    expect_text(page, target_row, "5 %")
    expect_text(page, "#fit-targets tbody tr:nth-child(2)", "damping of mode 3")
    assert page.locator("#fit-modes tbody tr").count() == 2  # the third is not visible yet
    server.send(status("running", series=series(online_fit(8.0, 0.8, third="doubtful"))))
    expect_text(page, cell, "0.910 ± 0.016")
    assert width(page, cell) == pytest.approx(0.2 * widest, rel=0.05)
    expect_text(page, f"{target_row} .reached", "100 %")
    expect_text(page, "#fit-modes tbody tr:nth-child(3)", "0.990 (doubtful)")
    expect_text(page, "#fit-result", "A disturbance at 50 Hz was modelled.")
    ended = online_fit(9.0, search=False) | {"search": {"reason": "Reached: <all>."}}
    server.send(status(series=series(ended, running=False)))
    expect_text(page, "#fit-search", "Reached: <all>.")
    server.send(status(series=series(None, excitation="hold", path="/data/sessions/2.mcap")))
    expect(page.locator("#fit")).to_be_hidden()


@pytest.mark.further
def test_invalid_number_is_reported_and_not_sent(server, page):
    page.fill("#parameter-amplitude_rad", "much")
    page.click("#start-button")
    expect_text(page, "#start-result", "Amplitude much is not a number; give one in rad.")
    page.fill("#parameter-amplitude_rad", "0.02")
    page.fill("#repeat", "1.5")
    page.click("#start-button")
    expect_text(page, "#start-result", "Repeat 1.5 is not a whole number")
    assert server.commands == []


@pytest.mark.further
def test_predict_shows_peaks_limits_and_largest_amplitude(server, page):
    refused = "The predicted peak speed of 11 rad/s exceeds 10 rad/s."
    plan = PLAN | {"peak_velocity_rad_s": 11.0, "refused": refused}
    server.replies["predict"] = {"plan": plan, "largest_amplitude_rad": 0.028_679}
    page.click("#predict")
    expect_text(page, "#prediction", "11.0 of 10 rad/s")
    expect_text(page, "#prediction", refused)
    expect_text(page, "#prediction", "39.0 mm")
    rows = page.locator("#prediction .bar-row")
    assert [rows.nth(k).get_attribute("class").split()[1:] for k in range(3)] == [
        [], ["over"], ["near"],
    ]  # fmt: skip
    # Rounded down, so that it passes; and predicted again.
    page.click("#take-largest")
    assert page.input_value("#parameter-amplitude_rad") == "0.0286"
    assert eventually(lambda: server.requests[-1]["parameters"]["amplitude_rad"] == 0.0286)
    page.wait_for_selector("#prediction:not(.outdated)")
    page.fill("#parameter-duration_s", "60")
    page.wait_for_selector("#prediction.outdated")


# Rig


@pytest.mark.further
def test_results_of_zero_tare_and_check_are_shown(server, page):
    axes = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
    server.replies |= {
        "zero": {"moved_rad": 0.001},
        "tare": {
            "mean": dict.fromkeys(axes, 0.4005), "std": dict.fromkeys(axes, 0.02),
            "torque_std_nm": 0.0021,
        },
        "check": {
            "verdict": "1 failed",
            "rows": [
                {"what": "bus load", "status": "ok", "text": "41 %", "remedy": "None."},
                {"what": "priority", "status": "failed", "text": "none", "remedy": "Set it."},
            ],
        },
    }  # fmt: skip
    page.click("#zero")
    expect_text(page, "#rig-result", "Zero set (shift 0.00100 rad).")
    page.click("#tare")
    expect_text(page, "#rig-result", "0.401 N")
    expect_text(page, "#rig-result", "0.020 N·m")
    page.click("#check")
    expect_text(page, "#rig-result", "1 failed")
    assert page.locator("#rig-result .failed").inner_text() == "failed priority: none\nSet it."
    assert "None." not in page.inner_text("#rig-result")
    server.send(status(last_check={"utc_ns": UTC_NS, "verdict": "1 failed"}))
    expect_text(page, "#last-check", "1 failed, ")
    expect_text(page, "#calibration", "FT12345")


def test_buttons_and_responses_by_state(server, page):
    enabled = "['zero', 'tare', 'check', 'reset', 'start-button'].filter(id => " \
        "!document.getElementById(id).disabled).join()"  # fmt: skip
    assert page.evaluate(enabled) == "zero,tare,check,start-button"
    for message, expected in (
        (status("running"), ""), (status("fault"), "reset"), (status(doing="tare"), ""),
        (status("idle"), "check"),
    ):  # fmt: skip
        server.send(message)
        page.wait_for_function(f"() => {enabled} === '{expected}'")
    # The response of a session is cleared when the next one of a series begins.
    server.send(status("running"), response("nominal"), response("last"), response())
    expect_text(page, "#response-keys", "measured")
    server.send(status("running"), response("nominal"))
    expect(page.locator("#response-keys")).to_have_text("nominal model")
    server.send(response(reached_hz=5.0))
    expect_text(page, "#response-keys", "measured")


# Live


@pytest.mark.further
def test_gauges_are_per_cent_of_limits_and_coloured_near_them(server, page):
    message = gauges(0.5)
    message["angle"] |= {"value": 0.4, "fraction": 0.8}
    message["velocity"] |= {"value": 10.4, "fraction": 1.04}
    message["i2t"] = {"value": 0.1, "limit": None, "unit": "N·m", "fraction": None}
    server.send(message)
    expect_text(page, "#gauge-angle", "80 %")
    assert page.get_attribute("#gauge-angle", "class") == "gauge near"
    assert page.get_attribute("#gauge-angle", "title") == "0.400 rad of 0.500 rad"
    assert page.get_attribute("#gauge-velocity", "class") == "gauge over"
    assert page.inner_text("#gauge-velocity .percent") == "104 %"
    expect_text(page, "#gauge-i2t", "0.100 N·m")


@pytest.mark.further
def test_strips_show_the_last_ten_seconds(server, page):
    before = drawn_fraction(page, "#strip-angle")
    server.send(strip(0.0, 300))
    label = re.compile("^Angle, last 10 s: −0.02[45].* to 0.02[45].* rad$")
    expect(page.locator("#strip-angle")).to_have_attribute("aria-label", label)
    assert drawn_fraction(page, "#strip-angle") > 2 * before
    # Gaps are skipped, and a new record starts from zero.
    gap = strip(0.0, 40)
    for name in ("angle_min", "angle_max", "reference_min", "reference_max"):
        gap[name][10] = None
    full = drawn_fraction(page, "#strip-angle")
    server.send(gap)
    page.wait_for_timeout(100)
    assert 0 < drawn_fraction(page, "#strip-angle") < 0.6 * full


@pytest.mark.further
def test_the_response_grows_over_model_and_last_session(server, page):
    before = drawn_fraction(page, "#response-plot")
    server.send(response("nominal"), response("last", specimen="antenna 3"))
    expect_text(page, "#response-keys", "last session (antenna 3)")
    server.send(response(reached_hz=5.0))
    expect_text(page, "#response-keys", "measured")
    little = drawn_fraction(page, "#response-plot")
    assert little > before
    page.hover("#response-plot", position={"x": 60, "y": 50})
    expect_text(page, "#response-readout", "coherence")
    assert "Hz" in page.inner_text("#response-readout")


@pytest.mark.further
def test_live_view_is_linked(server, page):
    assert page.is_hidden("#rerun")
    message = status()
    message["rig"]["live_view"] = {"url": "http://127.0.0.1:9090/?url=x"}
    server.send(message)
    page.wait_for_selector("#rerun", state="visible")
    assert page.get_attribute("#rerun", "href") == "http://127.0.0.1:9090/?url=x"


# Sessions


@pytest.mark.further
def test_filter_and_details_of_sessions(server, page):
    server.sessions = [session(0), session(1, outcome="stopped", specimen="antenna 4")]
    page.select_option("[name=outcome]", "stopped")
    page.wait_for_function("() => document.querySelectorAll('#rows tr[id]').length === 1")
    expect_text(page, "#sessions-count", "1 session")
    page.click("#rows button.link >> nth=0")
    page.wait_for_selector(".detail:not([hidden])")
    details = page.inner_text(".detail")
    assert "2.61130" in details  # to the second digit of its uncertainty
    assert "2.60973 to 2.61287" in details
    assert "the second mode has changed" in details
    assert "Damping of mode 3 is uncertain" in details
    assert "Temperature\n21.4 °C" in details


@pytest.mark.further
def test_files_and_report_of_a_session(server, page):
    server.sessions = [session(0), session(1, report="/somewhere/report.html")]
    page.fill("[name=text]", "x")
    page.wait_for_function("() => document.querySelectorAll('#rows tr[id]').length === 2")
    name = server.sessions[1]["id"]
    hrefs = page.locator(f"#session-{name} .files a")
    assert [hrefs.nth(k).get_attribute("href") for k in range(hrefs.count())] == [
        f"/api/sessions/{name}/report/",
        *(f"/api/sessions/{name}/file.{ending}" for ending in ("mcap", "mat", "uff")),
    ]
    page.click("text=Make report")
    expect_text(page, "#sessions-result", "Report of")
    address = f"/api/sessions/{server.sessions[0]['id']}/report"
    assert server.commands == [(address, True)]
    server.sessions[0] = session(0, report="/somewhere/else/report.html")
    server.send(job("done", id=server.sessions[0]["id"], address=f"{address}/"))
    page.wait_for_selector(f"#sessions-result a[href='{address}/']")
    assert page.locator("#rows a:text-is('Report')").count() == 2
    server.send(job("failed", error="The report was not made: no space."))
    expect_text(page, "#sessions-result", "The report was not made: no space.")


@pytest.mark.further
def test_overlay_and_campaign_of_selected_sessions(server, page):
    assert page.is_disabled("#overlay")
    for row in (1, 3, 5):
        page.check(f"#rows tr:nth-child({row}) input")
    expect_text(page, "#ticked", "3 selected")
    page.click("#overlay")
    page.wait_for_selector("#comparison", state="visible")
    assert page.locator("#comparison-keys .key").count() == 2
    expect_text(page, "#comparison-keys .key:nth-child(1)", "fitted model, 95 % band")
    expect_text(page, "#comparison-keys .key:nth-child(2)", "Welch's method, coherence above 0.8")
    expect_text(page, "#sessions-result", "the coherence of the measured response is not known")
    assert drawn_fraction(page, "#comparison-plot") > 0.02
    page.click("#campaign")
    expect_text(page, "#sessions-result", "Campaign: running")
    assert server.commands == [("/api/campaign", True)]


@pytest.mark.further
def test_markup_in_texts_is_not_interpreted(server, page):
    evil = "<img src=x onerror=\"document.title='broken'\">"
    server.sessions = [session(0, specimen=evil, operator=evil, note=evil, modes=MODES)]
    server.send(
        {"type": "event", "utc_ns": UTC_NS, "level": "info", "text": evil},
        {"type": "session"},
        status("fault", reason=evil),
    )
    expect_text(page, "#rows", evil)
    expect_text(page, "#event-list", evil)
    assert page.locator("main img").count() == 0
    assert page.title() == "sim – rigd"


# Events


@pytest.mark.further
def test_events_are_listed_once_newest_first(server, page):
    for second, level in ((1, "info"), (3, "warning"), (2, "error")):
        server.send({
            "type": "event", "utc_ns": UTC_NS + second * 10**9, "level": level,
            "text": f"event {second}",
        })  # fmt: skip
    server.send(status())
    expect_text(page, "#event-list", "event 2")
    texts = page.locator("#event-list .text").all_inner_texts()
    assert texts == ["event 3", "event 2", "event 1",
                     "idle → ready: the simulated rig is connected"]  # fmt: skip
    assert page.locator("#event-list li.warning .level").inner_text() == "warning"
