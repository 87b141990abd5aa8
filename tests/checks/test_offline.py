"""What a profile alone shows, before anything is connected."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rigd.beam import mode_shape, undamped_frequencies_rad_s
from rigd.check_rows import CheckResult, CheckRow, overall_verdict
from rigd.checks import check_without_devices, run_offline_checks
from rigd.checks.offline import axis_tilt_rows, profile_rows, record_rows, wiring_rows
from rigd.devices.canbus import bus_load
from rigd.excitation import ExcitationError, chirp
from rigd.profile import load_profile


def by_name(rows):
    return {row.what: row for row in rows}


def row(verdict):
    return CheckRow("", "", "", "", verdict)


def test_the_worst_row_is_the_verdict():
    ok, skipped, warning, fail = map(
        row, (CheckResult.OK, CheckResult.SKIPPED, CheckResult.WARNING, CheckResult.FAIL)
    )
    assert overall_verdict([]) == "ok"
    assert overall_verdict([ok, skipped]) == "ok"
    assert overall_verdict([ok, warning, skipped]) == "warnings"
    assert overall_verdict([warning, fail, ok]) == "failed"


def test_one_warning_names_all_assumed_numbers(can_profile):
    found = by_name(profile_rows(can_profile))["unverified profile values"]
    assert found.verdict is CheckResult.WARNING
    assumed = [key for key, source in can_profile.sources.items() if source == "assumed"]
    assert found.found == f"{len(assumed)} of {len(can_profile.sources)} assumed"
    assert all(key in found.detail for key in assumed)
    assert "beam.length_m" not in found.detail  # from the paper


def test_a_profile_without_assumptions_has_no_warning(can_profile):
    sources = dict.fromkeys(can_profile.sources, "measured")
    assert overall_verdict(profile_rows(replace(can_profile, sources=sources))) == "ok"


def test_the_longest_record_can_be_analysed(can_profile):
    (row,) = record_rows(can_profile)
    assert (row.found, row.verdict, row.detail) == ("4000 s at 1000 Hz", CheckResult.OK, "")
    assert row.wanted == "136 s (run chirp)"
    fast = replace(can_profile, rig=replace(can_profile.rig, rate_hz=40_000.0))
    (row,) = record_rows(fast)
    assert (row.found, row.verdict) == ("100 s at 40000 Hz", CheckResult.WARNING)
    assert "4000000 samples can be analysed" in row.detail
    with pytest.raises(ExcitationError, match="100 s is the most"):
        chirp(rate_hz=40_000.0)


def test_an_unknown_tilt_of_the_axis_is_only_a_warning(can_profile):
    (row,) = axis_tilt_rows(can_profile)
    assert (row.found, row.verdict) == ("not known", CheckResult.WARNING)
    for words in ("0.027 % for 0.5°", "level", "rig.axis_tilt_deg"):
        assert words in row.detail
    assert row in check_without_devices(can_profile, None)
    assert not run_offline_checks(can_profile).refusals
    (row,) = axis_tilt_rows(load_profile("sim"))
    assert row.verdict is CheckResult.SKIPPED


@pytest.mark.parametrize("tilt_deg", [0.5, -2.0])
def test_a_measured_tilt_states_the_shift_of_mode_1(can_profile, tilt_deg):
    """By Rayleigh's quotient with the shape of the mode, integrated here."""
    beam = can_profile.rig.beam
    x = np.linspace(0.0, 1.0, 4001)
    shape = mode_shape(1, x)
    slope = np.gradient(shape, x)
    load = 9.81 * np.sin(np.radians(tilt_deg)) / beam.length_m
    added = load * np.trapezoid((1 - x) * slope**2, x) / np.trapezoid(shape**2, x)
    squared = undamped_frequencies_rad_s(beam, 1)[0] ** 2
    percent = 100 * (np.sqrt(1 + added / squared) - 1)
    (row,) = axis_tilt_rows(replace(can_profile, axis_tilt_deg=tilt_deg))
    assert (row.verdict, row.detail) == (CheckResult.OK, "")
    number = re.search(r"shifted by (\S+) %", row.found)[1]
    assert float(number) == pytest.approx(percent, rel=0.05)


def test_the_shipped_wiring_is_fine(can_profile, serial_profile):
    for profile in (can_profile, serial_profile):
        rows = by_name(wiring_rows(profile.rig))
        assert {row.verdict for row in rows.values()} == {CheckResult.OK}
    assert list(wiring_rows(load_profile("sim").rig)) == []


def test_a_collision_fails(can_profile):
    rig = replace(can_profile.rig, ati_can=replace(can_profile.rig.ati_can, base_id=0x20))
    found = by_name(wiring_rows(rig))["identifiers"]
    assert found.verdict is CheckResult.FAIL
    assert "0x201 (RPDO1)" in found.found


@pytest.mark.parametrize(
    ("worst", "verdict"),
    [
        (0.69, CheckResult.OK),
        (0.71, CheckResult.WARNING),
        (0.89, CheckResult.WARNING),
        (0.91, CheckResult.FAIL),
        (1.2, CheckResult.FAIL),
    ],
)
def test_bus_load_is_refused_above_90_percent(can_profile, worst, verdict):
    rig = can_profile.rig
    bitrate = round(bus_load(rig).worst_case_load / worst * rig.can.bitrate_bit_s)
    found = by_name(wiring_rows(replace(rig, can=replace(rig.can, bitrate_bit_s=bitrate))))["load"]
    assert found.verdict is verdict
    assert f"{100 * worst:.1f} %" in found.found


def test_every_frame_is_listed(can_profile):
    detail = by_name(wiring_rows(can_profile.rig))["load"].detail
    for frame in (
        "SYNC (0x080",
        "RPDO1 (0x201, 4",
        "TPDO1 (0x181, 8",
        "0x680",
        "0x681, 6",
        "0x77f",
    ):
        assert frame in detail


def test_a_slow_serial_line_fails(serial_profile):
    """7000 records of 143 bits are 1.001 Mbit/s."""
    rig = serial_profile.rig
    rows = [row for row in wiring_rows(rig) if row.group == "serial line"]
    assert rows[0].found.startswith("80.1 %")
    slow = replace(rig, ati_serial=replace(rig.ati_serial, baud=115_200))
    (found,) = (row for row in wiring_rows(slow) if row.group == "serial line")
    assert found.verdict is CheckResult.FAIL
