"""Detection by the long runs of growth and of sessions that end by starvation."""

import importlib
import sys
from pathlib import Path

import pytest

MINUTE_S = 60.0


@pytest.fixture
def load(monkeypatch):
    """Import a script of this folder, which is not a package."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    names = ("run_campaign", "run_starved", "run_viewers", "run_served")
    yield importlib.import_module
    for name in names:
        sys.modules.pop(name, None)


def usages(campaign, resident_kb):
    """Return one reading a second, for four minutes."""
    return [
        (float(t_s), campaign.ProcessUsage(round(resident_kb(t_s)), 1000, 20, 0))
        for t_s in range(round(4 * MINUTE_S))
    ]


@pytest.mark.parametrize(
    ("resident_kb", "grows"),
    [
        (lambda t_s: 50_000, False),
        (lambda t_s: 50_000 + 1_000 * min(t_s, MINUTE_S), False),
        (lambda t_s: 50_000 + 4 * t_s, False),
        (lambda t_s: 50_000 + 10 * t_s, True),
    ],
    ids=["flat", "while it warms up", "less than 2 %", "more"],
)
def test_growth_after_the_first_minute_is_a_complaint(load, resident_kb, grows):
    campaign = load("run_campaign")
    complaints = []
    table = campaign.growth_table({"live": usages(campaign, resident_kb)}, complaints)
    assert "live resident, kB" in table
    assert bool(complaints) == grows
    assert not grows or "live resident, kB grew by" in complaints[0]


def test_one_more_descriptor_is_a_complaint(load):
    campaign = load("run_campaign")
    usage_over_time = [
        (float(t_s), campaign.ProcessUsage(1000, 1000, 20 + (t_s > 150), 0)) for t_s in range(240)
    ]
    complaints = []
    campaign.growth_table({"control": usage_over_time}, complaints)
    assert complaints == ["control descriptors grew by 5.0 %"]


def test_too_few_readings_are_a_complaint(load):
    campaign = load("run_campaign")
    complaints = []
    campaign.growth_table({"live": [(1.0, campaign.ProcessUsage(1, 1, 1, 0))]}, complaints)
    assert complaints == ["live: too few looks to say whether it grows"]


RESULT = {"path": None, "scheduled": 0, "recorded": 0, "missed": 0, "late": 0, "lost": 0}


@pytest.mark.parametrize(
    ("reason", "complaint"),
    [
        (
            "Supervisor watchdog timeout (2 s); session aborted. Check CPU load.",
            "supervisor's sake",
        ),
        ("Run of missed ticks 30 ticks exceeds limit 25 ticks.", ""),
        (
            "Tracking error 0.12 rad exceeds limit 0.1 rad. It came after 9 missed ticks. "
            "The computer is overloaded: close other programs.",
            "",
        ),
        (
            "Check that nothing holds the beam, or lower the amplitude.",
            "does not name the computer",
        ),
    ],
)
def test_reason_on_a_busy_computer_must_name_it(load, reason, complaint):
    outcome = load("run_starved").evaluate(
        RESULT | {"outcome": "fault", "reason": reason}, "", live=False
    )
    assert complaint in "; ".join(outcome.complaints)
    assert bool(complaint) == bool(outcome.complaints)


@pytest.mark.process
@pytest.mark.slow  # in `make test` all sessions in real time run beside other workers
def test_supervision_is_in_time_with_busy_programs(load, tmp_path, monkeypatch, write_profile):
    starved = load("run_starved")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(starved, "RIG", str(write_profile("sim", patient=True)))
    with starved.busy(4):
        outcome = starved.run(3.0, tmp_path, live=False)
    assert not outcome.complaints, outcome
    assert outcome.outcome == "complete"
    assert outcome.scheduled == 3400 == outcome.recorded + outcome.missed
