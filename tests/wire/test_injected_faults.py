"""Every row of docs/faults.md: a fault on the wire, how it ends, and what brings the rig back."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from processes import eventually

from rigd.devices import reset_drive
from rigd.devices.contracts import DeviceError
from rigd.runner import RigError
from rigd.session import read_session
from rigd.session.layout import Status
from rigd.sim.wire import inject

pytestmark = pytest.mark.process

# Fast from the beginning, so that every fault is met while the motor moves.
CHIRP = {"start_hz": 5.0, "stop_hz": 10.0, "rest_s": 0.1, "ring_down_s": 0.1}
# A tick in lock-step waits half a second for a missing reply: where another row has ten of them,
# three suffice.
STALE = 3

FATAL, TOLERATED = "## Faults that end a session", "## Faults that a session tolerates"
MESSAGES = {
    "angle lost": r"angle.*10 ticks",
    "wrench lost": r"wrench.*10 ticks",
    "half of each wrench lost": rf"wrench.*{STALE} ticks",
    "drive silent": rf"angle.*{STALE} ticks",
    "sensor silent": rf"wrench.*{STALE} ticks",
    "emergency message": r"Drive .*0x2310",
    "wired stop (STO) opened": r"Drive .*wired stop \(STO\) was dropped.*switch-on disabled",
    "controller off the bus": r"CAN bus .*bus-off",
    "drive's heartbeat lost": r"Drive .*no heartbeat for 0\.1",
    "drive restarts": r"Drive .*it has restarted by itself; check its supply",
    "encoder jumps": r"Encoder jump .* rad exceeds limit",
    "encoder frozen": r"(Net torque while the encoder|Torque that the sudden stop of the encoder)",
    "encoder repeats every second angle": r"Number of encoder readings that repeat",
    "sensor frozen": r"Run of identical readings of all sensor channels",
    "sensor repeats every second wrench": r"readings of the sensor's whole wrench that repeat",
    "gauge frozen": r"Run of identical readings of the sensor's gauge 2 ",
    "statusword corrupted": r"Drive .*statusword",
    "controlword corrupted": r"Drive .*command came over the bus that this computer did not give",
    "sensor reports an error": r"Sensor .*0x8040.*calibration",
    "sensor restarts": r"Sensor .*its watchdog has reset it.*0x8001.*calibration 0",
    "gauge at the end of its range": r"Sensor's f. .* N exceeds limit",
    "bus cut": r"CAN bus .*(cut off|takes no more frames|cannot be read)",
    "loop's frames lost": rf"{STALE} ticks",
    "loop's heartbeat lost": r"Drive .*0x8130",
    "torque commands lost": r"Drive .*exerts .* commanded, for 10 ticks",
    "serial line cut": r"Sensor ATI Digital F/T on /dev/pts",
    "stream silent": rf"wrench.*{STALE} ticks",
    "streaming sensor frozen": r"Run of identical readings of all sensor channels",
    "streaming sensor restarts": rf"wrench.*{STALE} ticks",
    "stream reports an error": r"Sensor ATI Digital F/T .*error",
}
NOISE = {"simulation.torque_noise_nm": "5e-3", "simulation.force_noise_n": "2e-2"}
"""Without noise all readings of a sensor at rest are the same."""
READY = "the next session can be started"
UNTIL_MENDED = {
    "drive silent": "no answer",
    "wired stop (STO) opened": r"does not get ready.*STO is open",
    "controller off the bus": "no answer",
    "bus cut": "does not answer",
}
"""Message of `rigd reset` while the cause is there; elsewhere it would reset a fault that comes
again."""


@dataclass(frozen=True)
class Row:
    """A fault as documented."""

    name: str
    fault: str
    profile: str
    ticks: int
    last: str
    back: str = ""


def rows(heading):
    text = (Path(__file__).parents[2] / "docs" / "faults.md").read_text("utf-8")
    section = text[text.index(heading) + len(heading) :].partition("\n## ")[0]
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in section.splitlines()
        if line.startswith("|") and "`" in line
    ]
    return [Row(c[0], c[1].strip("`"), c[2], int(c[3]), *c[4:]) for c in cells]


AGAIN = {
    "angle lost",
    "bus cut",
    "controlword corrupted",
    "drive restarts",
    "drive's heartbeat lost",
    "encoder jumps",
    "encoder repeats every second angle",
    "gauge frozen",
    "sensor repeats every second wrench",
    "streaming sensor frozen",
    "gauge at the end of its range",
    "half of each wrench lost",
    "loop's frames lost",
    "sensor reports an error",
    "sensor restarts",
    "sensor silent",
    "statusword corrupted",
    "stream reports an error",
    "stream silent",
    "streaming sensor restarts",
    "torque commands lost",
    "wrench lost",
}
"""Faults whose reaction is covered by another row, or by the other device."""
FURTHER = {
    "controller off the bus",
    "emergency message",
    "encoder frozen",
    "sensor frozen",
    "serial line cut",
}
"""Lost devices and faults of drives, covered by other rows; frozen devices are covered in
tests/engine/test_every_interlock.py without the wire."""


def marks(row):
    """Marks of the tests that are not run each time."""
    again = [pytest.mark.slow] * (row.name in AGAIN)
    return again + [pytest.mark.further] * (row.name in FURTHER)


def named(row):
    return row.name.replace(" ", "_")


def test_every_row_has_its_message():
    assert [row.name for row in rows(FATAL)] == list(MESSAGES)


@pytest.mark.parametrize(
    "row",
    [pytest.param(row, marks=marks(row), id=named(row)) for row in rows(FATAL)],
)
def test_a_fault_ends_torque_and_the_rig_recovers(
    row, quiet_profile, start_simulator, run_order, load, drive_log, tmp_path, monkeypatch
):
    shortened = MESSAGES[row.name].endswith(f"{STALE} ticks")
    values = {"limits.stale_ticks_in_a_row": str(STALE)} if shortened else {}
    if re.match("stuck,what=(sensor|gauge)", row.fault):
        values |= NOISE
    profile, log = quiet_profile(row.profile, values), tmp_path / "drive.jsonl"
    simulator = start_simulator(profile, "--lock-step", "--log", log)
    # The record is long, so that the fault comes before its end at any speed.
    options = CHIRP | {"duration_s": 60.0}
    result = run_order(load(profile), "session", fast=True, faults=[row.fault], **options)
    assert result.outcome == "fault"
    assert re.search(MESSAGES[row.name], result.reason), result.reason
    assert result.scheduled == result.recorded + result.missed + result.lost
    assert result.lost == 0
    session = read_session(result.path)
    assert session.outcome["outcome"] == "fault"
    assert session.samples[-1]["status"] & Status.TORQUE_OFF
    # A drive that cannot be reached any more goes off a little later, by itself.
    assert eventually(lambda: drive_log(log).last_torque["enabled"] is False)
    at_the_end = drive_log(log)

    rig = load(profile).rig
    if row.name in UNTIL_MENDED:
        with monkeypatch.context() as brief:
            brief.setattr("rigd.devices.cia402._sdo._SDO_TIMEOUT_S", 0.1)
            brief.setattr("rigd.devices.cia402._switch_off._FIRST_ANSWER_TIMEOUT_S", 0.2)
            with pytest.raises(DeviceError, match=UNTIL_MENDED[row.name]) as refused:
                reset_drive(rig)
        assert READY not in str(refused.value)
    inject(rig.name, ["end"])
    if "`rigd reset`" in row.back:
        with pytest.raises(RigError, match=f"rigd reset --profile {rig.name}"):
            run_order(load(profile), "refused", fast=True, **CHIRP)
        message = reset_drive(rig)
        assert "The fault is reset" in message
        assert READY in message
    else:
        assert "start again" in row.back
    following = run_order(load(profile), "next", fast=True, **CHIRP | {"duration_s": 0.1})
    assert following.is_successful, following.reason
    assert following.recorded == following.scheduled
    simulator.terminate()
    assert simulator.wait(30.0) == 0

    entries = at_the_end
    (begun,) = entries.of("fault", "simulator")
    end = entries.last_torque
    assert (end["enabled"], end["torque_nm"]) == (False, 0.0)
    off = next(e for e in entries.of("torque") if e["t_s"] >= begun["t_s"] and not e["enabled"])
    assert off["torque_nm"] == 0.0
    ticks = row.ticks - (
        10 - STALE if shortened and row.last.startswith("the loop: more than ten") else 0
    )
    if row.name == "torque commands lost":
        # Nor does it get the command to switch off. That is tried for 50 ms of the computer's time
        # before it goes by SDO, in which a lock-step passes as many ticks as it can.
        ticks *= 4
    assert round((off["t_s"] - begun["t_s"]) * 1000) <= ticks


@pytest.mark.further  # as in tests/engine and tests/devices
@pytest.mark.parametrize(
    "name", ["antenna_can", pytest.param("antenna_serial", marks=pytest.mark.slow)]
)
def test_passing_faults_are_flagged_and_tolerated(
    name, quiet_profile, start_simulator, run_order, load
):
    """One after the other in one session: each is flagged up to the next, as in its row."""
    profile = quiet_profile(name)
    start_simulator(profile, "--lock-step")
    tolerated = [row for row in rows(TOLERATED) if row.profile == name]
    injected = []
    result = run_order(
        load(profile),
        "session",
        fast=True,
        faults=[row.fault for row in tolerated],
        injected=injected,
        **CHIRP | {"duration_s": 5.0},
    )
    assert result.is_successful, result.reason
    assert len(injected) == len(tolerated)
    status = read_session(result.path).samples["status"]
    stale = status & (Status.ANGLE_STALE | Status.WRENCH_STALE)
    assert not stale[: injected[0]].any()
    for row, first, end in zip(tolerated, injected, [*injected[1:], len(status)], strict=True):
        here = stale[first:end]
        if row.ticks:
            flag = Status[row.last.upper().replace(" ", "_")]
            assert 1 <= (here & flag != 0).sum() <= row.ticks, row.name
            assert not (here & ~int(flag)).any(), row.name
        else:
            assert not here.any(), row.name


@pytest.mark.further  # as in tests/devices/ati and canbus
@pytest.mark.parametrize(
    ("name", "sender", "ms"),
    [
        ("antenna_can", "drive,id=0x181", 1),
        ("antenna_serial", "sensor", 3),
    ],
)
def test_readings_late_or_lost_are_a_warning(
    name, sender, ms, quiet_profile, start_simulator, run_order, load
):
    profile = quiet_profile(name)
    start_simulator(profile, "--lock-step")
    fault = f"delay,from={sender},ms={ms},frames=1000000"
    result = run_order(load(profile), "session", fast=True, faults=[fault], **CHIRP)
    assert result.outcome == "complete"
    (warning,) = [
        e for e in read_session(result.path).events if "all have been delayed" in e.message
    ]
    assert (warning.level, warning.t_ns > 0) == ("warning", True)


@pytest.mark.further  # as lost ones do
def test_permanently_late_answers_end_the_session(quiet_profile, start_simulator, run_order, load):
    profile = quiet_profile("antenna_can", {"limits.stale_ticks_in_a_row": "6"})
    start_simulator(profile, "--lock-step")
    fault = "delay,from=sensor,ms=2,frames=1000000"
    result = run_order(load(profile), "session", fast=True, faults=[fault], **CHIRP)
    assert result.outcome == "fault"
    assert re.search(r"wrench.*6 ticks", result.reason), result.reason
