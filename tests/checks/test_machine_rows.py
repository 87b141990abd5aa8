"""Advice on the computer: from its files, with a remedy, never a refusal."""

from dataclasses import replace

import pytest

from rigd.check_rows import CheckResult
from rigd.checks.machine import machine_rows
from rigd.profile import load_profile

CPU = "sys/devices/system/cpu"
GOOD = {
    "proc/cpuinfo": "flags : fpu tsc\n",
    f"{CPU}/isolated": "2-3\n",
    f"{CPU}/cpu0/cpufreq/scaling_governor": "performance\n",
    f"{CPU}/cpu1/cpufreq/scaling_governor": "performance\n",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc\n",
    "proc/sys/kernel/sched_rt_runtime_us": "950000\n",
    "proc/sys/kernel/sched_rt_period_us": "1000000\n",
}
REALTIME_KERNEL = "#1 SMP PREEMPT_RT Debian 6.1"


@pytest.fixture
def rows(tmp_path, monkeypatch):
    """The rows of a good computer, but for some files."""
    monkeypatch.setattr("rigd.checks.machine._is_wall_clock_synchronised", lambda: True)

    def of(changed=None, *, kernel=REALTIME_KERNEL, **settings):
        for path, text in (GOOD | (changed or {})).items():
            file = tmp_path / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        realtime = replace(load_profile("sim").realtime, **settings)
        return {row.what: row for row in machine_rows(realtime, tmp_path, kernel)}

    return of


def test_a_good_computer_has_no_advice(rows):
    found = rows()
    assert {row.verdict for row in found.values()} == {CheckResult.OK}
    assert not any(row.detail for row in found.values())
    assert found["isolated core"].found == "2, 3"


@pytest.mark.parametrize(
    ("what", "path", "text", "found", "remedy"),
    [
        (
            "hardware",
            "proc/cpuinfo",
            "flags : fpu hypervisor",
            "virtual machine",
            "a dedicated computer",
        ),
        ("hardware", "sys/hypervisor/type", "xen", "virtual machine", "a dedicated computer"),
        ("isolated core", f"{CPU}/isolated", "", "none", "isol"),
        (
            "frequency governor",
            f"{CPU}/cpu1/cpufreq/scaling_governor",
            "powersave",
            "performance, powersave",
            "cpupower",
        ),
        (
            "clock source",
            "sys/devices/system/clocksource/clocksource0/current_clocksource",
            "hpet",
            "hpet",
            "dmesg",
        ),
        ("real-time share", "proc/sys/kernel/sched_rt_runtime_us", "500000", "50 %", "950000"),
    ],
)
def test_each_deficiency_is_a_warning_with_a_remedy(rows, what, path, text, found, remedy):
    rows_found = rows({path: text})
    row = rows_found.pop(what)
    assert row.verdict is CheckResult.WARNING
    assert found in row.found
    assert remedy in row.detail
    assert {other.verdict for other in rows_found.values()} == {CheckResult.OK}


@pytest.mark.parametrize(
    ("kernel", "found"),
    [("#1 SMP PREEMPT_DYNAMIC x", "preemptible"), ("#1 SMP x", "not preemptible")],
)
def test_an_ordinary_kernel_is_a_warning(rows, kernel, found):
    row = rows(kernel=kernel)["kernel"]
    assert (row.found, row.verdict) == (found, CheckResult.WARNING)


def test_a_realtime_kernel_is_known_from_its_files(rows):
    assert rows({"sys/kernel/realtime": "1\n"}, kernel="#1 SMP")["kernel"].verdict is CheckResult.OK


def test_warning_if_the_loop_avoids_the_isolated_core(rows):
    row = rows(cpu=1)["isolated core"]
    assert row.verdict is CheckResult.WARNING
    assert "realtime.cpu" in row.detail
    assert rows(cpu=3)["isolated core"].verdict is CheckResult.OK


def test_warning_if_the_wall_clock_is_not_synchronised(rows, monkeypatch):
    monkeypatch.setattr("rigd.checks.machine._is_wall_clock_synchronised", lambda: False)
    assert rows()["wall clock"].verdict is CheckResult.WARNING


def test_missing_files_are_no_failure(tmp_path):
    found = list(machine_rows(load_profile("sim").realtime, tmp_path))
    assert CheckResult.FAIL not in {row.verdict for row in found}


def test_rows_of_this_computer():
    found = [row.what for row in machine_rows(load_profile("sim").realtime)]
    assert len(found) == len(set(found)) == 7
