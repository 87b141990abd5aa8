"""Real-time rights are tried in another process: this one is unchanged."""

import os
import pwd
from dataclasses import replace

import pytest

from rigd.check_rows import CheckResult
from rigd.checks.machine import rights_rows
from rigd.profile import load_profile


@pytest.fixture
def settings():
    return load_profile("sim").realtime


def state():
    return os.sched_getaffinity(0), os.sched_getscheduler(0)


def test_every_setting_has_a_row_and_none_sticks(settings):
    before = state()
    rows = {row.what: row for row in rights_rows(settings)}
    assert set(rows) == {
        "memory",
        "timer slack",
        "garbage collector",
        "cpu",
        "idle states",
        "scheduling",
        "supervisor and recorder",
    }
    assert rows["timer slack"].verdict is CheckResult.OK
    assert state() == before


def test_a_refusal_is_a_warning_with_a_remedy(settings):
    rows = {row.what: row for row in rights_rows(replace(settings, cpu=4000))}
    assert rows["cpu"].verdict is CheckResult.WARNING
    assert rows["cpu"].found.startswith("refused")
    assert "realtime.cpu" in rows["cpu"].wanted


def test_an_ordinary_scheduler_may_be_wanted(settings):
    rows = {row.what: row for row in rights_rows(replace(settings, priority=0))}
    assert rows["scheduling"].found == "not requested"
    assert rows["scheduling"].verdict is CheckResult.OK


def test_a_failed_trial_is_reported(settings, monkeypatch):
    monkeypatch.setattr("rigd.checks.machine.OWN_PYTHON", ("/no/such/python",))
    (row,) = rights_rows(settings)
    assert row.verdict is CheckResult.WARNING
    assert "could not be tried" in row.found


def test_the_lines_to_grant_missing_rights_are_printed(settings, monkeypatch):
    granted = {
        "memory": "refused: not enough",
        "idle_states": "refused: not yours",
        "scheduling": "refused: not permitted",
        "supervision": "nice -10 (SCHED_RR refused: not permitted)",
    }
    monkeypatch.setattr("rigd.checks.machine.granted_realtime_settings", lambda settings: granted)
    rows = {row.what: row for row in rights_rows(settings)}
    user = pwd.getpwuid(os.geteuid()).pw_name
    assert f"{user} - memlock unlimited" in rows["memory"].detail
    assert f"{user} - rtprio {settings.priority}" in rows["scheduling"].detail
    assert f"{user} - rtprio {settings.priority}" in rows["supervisor and recorder"].detail
    assert rows["supervisor and recorder"].wanted == "SCHED_RR 20"
    assert 'KERNEL=="cpu_dma_latency"' in rows["idle states"].detail
    assert all(row.verdict is CheckResult.WARNING for row in rows.values())


def test_memory_locked_in_part_is_a_warning(settings, monkeypatch):
    granted = {"memory": "locked, except for memory that is allocated later (limit of 8 MB)"}
    monkeypatch.setattr("rigd.checks.machine.granted_realtime_settings", lambda settings: granted)
    (row,) = rights_rows(settings)
    assert row.verdict is CheckResult.WARNING
    assert "memlock unlimited" in row.detail
