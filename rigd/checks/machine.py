"""Checks of this computer's rights and settings for a loop in real time.

They give advice and refuse no session. A short-lived process determines the real-time settings that
the system grants. ``rigd bench`` measures the effect of the settings; ``docs/real_time.md``
explains how to change them.
"""

import ctypes
import json
import os
import platform
import pwd
import subprocess
from collections.abc import Iterator
from pathlib import Path

from rigd.check_rows import CheckResult, CheckRow, grade
from rigd.engine.realtime import MEMORY_LOCKED, REFUSED_PREFIX, isolated_cores
from rigd.profile import RealtimeSettings
from rigd.runtime.background import OWN_PYTHON

# Rights

_GRANT_TIMEOUT_S = 20.0
"""Longest time in seconds for the process that tries the real-time settings."""
_GRANT_PROGRAM = """
import json, sys
from rigd.engine.realtime import RaisedPriority, apply_realtime
priority, below, cpu = map(int, sys.argv[1:])
other = RaisedPriority(below, cpu)
supervision = other.request_priority()
other.restore_priority()
print(json.dumps([apply_realtime(priority=priority, cpu=cpu), supervision]))
"""
"""Program that requests the real-time settings and prints those granted as JSON."""
_ROW_LABELS = {"supervision": "supervisor and recorder"}
"""Labels of settings whose name is not a label."""
_REQUIRED_SETTINGS = {  # Required setting, for settings that were not granted
    "memory": "locked, without a limit",
    "scheduling": "SCHED_FIFO {priority}",
    "supervision": "SCHED_RR {supervision_priority}",
    "cpu": "realtime.cpu: a core of this computer",
    "idle_states": "/dev/cpu_dma_latency is writable",
}
_IDLE_STATES_ADVICE = (  # Advice if the depth of the processor's idle states cannot be limited
    "Idle states: a sleeping core takes long to wake up. Let the group rigd bound that with this "
    "line in /etc/udev/rules.d/90-rigd.rules, then udevadm trigger: "
    'KERNEL=="cpu_dma_latency", GROUP="rigd", MODE="0660"'
)


def granted_realtime_settings(requested_settings: RealtimeSettings) -> dict[str, str]:
    """Return the real-time settings that the system grants, as tried by a short-lived process.

    The keys are those of `apply_realtime`, for the control process. The key ``supervision`` holds
    the scheduling of supervisor and recorder.

    Raises
    ------
    OSError, subprocess.SubprocessError, ValueError
        If the process cannot be started, or fails.
    """
    setting_numbers = (
        requested_settings.priority,
        requested_settings.supervision_priority,
        requested_settings.cpu,
    )
    command_line = [*OWN_PYTHON, "-c", _GRANT_PROGRAM, *map(str, setting_numbers)]
    completed_process = subprocess.run(
        command_line, capture_output=True, text=True, timeout=_GRANT_TIMEOUT_S, check=True
    )
    granted_settings: dict[str, str]
    granted_settings, supervision_settings = json.loads(completed_process.stdout)
    if supervision_settings:
        core_numbers = supervision_settings.get("cores")
        core_text = f" on core {core_numbers}" if core_numbers else ""
        granted_settings["supervision"] = supervision_settings["scheduling"] + core_text
    return granted_settings


def rights_rows(settings: RealtimeSettings) -> Iterator[CheckRow]:
    """Yield check results on the real-time settings that the system would grant to a session."""
    try:
        granted_settings = granted_realtime_settings(settings)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        yield CheckRow(
            "real time", "rights", f"could not be tried: {error}", "", CheckResult.WARNING
        )
        return
    if settings.priority == 0:
        yield CheckRow("real time", "scheduling", "not requested", "", CheckResult.OK)
    for setting_name, granted_text in granted_settings.items():
        is_refused = (
            granted_text.startswith(REFUSED_PREFIX)
            or (setting_name == "memory" and granted_text != MEMORY_LOCKED)
            or (setting_name == "supervision" and not granted_text.startswith("SCHED_RR"))
        )
        wanted_text = _REQUIRED_SETTINGS.get(setting_name, "granted") if is_refused else ""
        yield CheckRow(
            "real time",
            _ROW_LABELS.get(setting_name, setting_name.replace("_", " ")),
            granted_text,
            wanted_text.format(
                priority=settings.priority, supervision_priority=settings.supervision_priority
            ),
            grade(fail=False, warn=is_refused),
            _setting_advice(setting_name, settings) if is_refused else "",
        )


def _setting_advice(setting_name: str, settings: RealtimeSettings) -> str:
    """Return the advice for a setting that was not granted, or "" if there is none."""
    if setting_name == "idle_states":
        return _IDLE_STATES_ADVICE
    limits_file_lines = {
        "memory": f"{_user_name()} - memlock unlimited",
        "scheduling": f"{_user_name()} - rtprio {settings.priority}",
        "supervision": f"{_user_name()} - rtprio {settings.priority}",
    }
    if setting_name not in limits_file_lines:
        return ""
    row_label = _ROW_LABELS.get(setting_name, setting_name).capitalize()
    return (
        f"{row_label}: put this line into /etc/security/limits.d/rigd.conf and log in again: "
        f"{limits_file_lines[setting_name]}"
    )


def _user_name() -> str:
    """Return the name of the user of this process, or the user id if it has no name."""
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return str(os.geteuid())


# Computer

_COMPUTER_GROUP = "computer"
"""Group of the rows on the computer's settings."""
_CPU_FOLDER = Path("sys/devices/system/cpu")
"""Folder of the processor's settings, relative to the root of the file system."""
_CLOCK_SOURCE_FILE = Path("sys/devices/system/clocksource/clocksource0/current_clocksource")
"""File with the name of the kernel's clock source."""
_REALTIME_RUNTIME_FILE = Path("proc/sys/kernel/sched_rt_runtime_us")
"""File with the microseconds of each period that real-time processes may use."""
_REALTIME_PERIOD_FILE = Path("proc/sys/kernel/sched_rt_period_us")
"""File with the period in microseconds in which the kernel limits real-time processes."""
_REALTIME_KERNEL_FILE = Path("sys/kernel/realtime")
"""File that contains 1 on a real-time kernel."""
_TIMEX_BYTES = 512
"""Size in bytes of the buffer for the kernel's ``timex`` structure.

It is larger than the structure on any architecture."""
_CLOCK_ERROR_STATE = 5
"""State that ``adjtimex`` returns for a wall clock that is not synchronised (TIME_ERROR)."""
_MIN_REALTIME_FRACTION = 0.95
"""Smallest fraction of each period for real-time processes; it is the kernel's default."""


def machine_rows(
    settings: RealtimeSettings, file_system_root: Path = Path("/"), kernel_version: str = ""
) -> Iterator[CheckRow]:
    """Yield check results on settings of this computer that can delay ticks, with advice.

    Parameters
    ----------
    settings
        Real-time settings of the profile.
    file_system_root
        Root of the file system from which the settings are read.
    kernel_version
        Version of the kernel as in ``uname -v``, or "" for that of this computer.
    """
    kernel_version = kernel_version or platform.version()
    yield _kernel_row(file_system_root, kernel_version)
    yield _virtual_machine_row(file_system_root)
    yield _isolated_core_row(settings, file_system_root)
    yield _governor_row(file_system_root)
    yield _clock_row(file_system_root)
    yield _wall_clock_row()
    yield _throttling_row(settings, file_system_root)


def _kernel_row(file_system_root: Path, kernel_version: str) -> CheckRow:
    """Return the check result on whether the kernel is a real-time kernel."""
    is_preemptible = (
        "PREEMPT_RT" in kernel_version
        or _read_or_empty(file_system_root / _REALTIME_KERNEL_FILE) == "1"
    )
    if is_preemptible:
        found_text = "PREEMPT_RT"
    else:
        found_text = "preemptible" if "PREEMPT" in kernel_version else "not preemptible"
    return CheckRow(
        _COMPUTER_GROUP,
        "kernel",
        found_text,
        "PREEMPT_RT",
        grade(fail=False, warn=not is_preemptible),
        ""
        if is_preemptible
        else "Kernel: an ordinary one delays a tick by milliseconds now and then; install your "
        "distribution's real-time kernel (Debian: linux-image-rt-amd64; Ubuntu: pro enable "
        "realtime-kernel).",
    )


def _virtual_machine_row(file_system_root: Path) -> CheckRow:
    """Return the check result on whether this computer is a virtual machine."""
    cpu_info_words = set(_read_or_empty(file_system_root / "proc/cpuinfo").split())
    is_virtual_machine = "hypervisor" in cpu_info_words or bool(
        _read_or_empty(file_system_root / "sys/hypervisor/type")
    )
    return CheckRow(
        _COMPUTER_GROUP,
        "hardware",
        "virtual machine" if is_virtual_machine else "no hypervisor seen",
        "a dedicated computer",
        grade(fail=False, warn=is_virtual_machine),
        "Hardware: the hypervisor can suspend this machine for milliseconds, which nothing inside "
        "can prevent; run a real rig on a dedicated computer."
        if is_virtual_machine
        else "",
    )


def _isolated_core_row(settings: RealtimeSettings, file_system_root: Path) -> CheckRow:
    """Return the check result on whether the loop's core is isolated from other programs."""
    isolated_core_numbers = isolated_cores(file_system_root)
    cores_text = ", ".join(map(str, sorted(isolated_core_numbers)))
    is_loop_core_isolated = (
        settings.cpu in isolated_core_numbers if settings.cpu >= 0 else bool(isolated_core_numbers)
    )
    if settings.cpu >= 0 and isolated_core_numbers and not is_loop_core_isolated:
        found_text, remedy_text = (
            f"{cores_text}; the loop runs on {settings.cpu}",
            f"Isolated core: set realtime.cpu to -1 or to one of {cores_text}.",
        )
    else:
        found_text, remedy_text = cores_text or "none", _isolation_advice((os.cpu_count() or 1) - 1)
    return CheckRow(
        _COMPUTER_GROUP,
        "isolated core",
        found_text,
        "one",
        grade(fail=False, warn=not is_loop_core_isolated),
        "" if is_loop_core_isolated else remedy_text,
    )


def _isolation_advice(last_core: int) -> str:
    """Return the advice to isolate the last core, whose number is `last_core`."""
    if last_core == 0:
        return (
            "Isolated core: this computer has one core, which everything shares; use one with more."
        )
    return (
        f"Isolated core: other programs may share the loop's core. Boot with isolcpus={last_core} "
        f"nohz_full={last_core} irqaffinity=0 (GRUB_CMDLINE_LINUX in /etc/default/grub, then "
        "update-grub)."
    )


def _governor_row(file_system_root: Path) -> CheckRow:
    """Return the check result on the governor of the processor's frequency."""
    governors = {
        _read_or_empty(governor_file)
        for governor_file in sorted(
            (file_system_root / _CPU_FOLDER).glob("cpu[0-9]*/cpufreq/scaling_governor")
        )
    }
    is_slow_governor = bool(governors - {"performance"})
    return CheckRow(
        _COMPUTER_GROUP,
        "frequency governor",
        ", ".join(sorted(governors)) or "none: the frequency is not this system's",
        "performance",
        grade(fail=False, warn=is_slow_governor),
        "Frequency governor: an idle core slows down and takes longer for the next tick; "
        "cpupower frequency-set -g performance."
        if is_slow_governor
        else "",
    )


def _clock_row(file_system_root: Path) -> CheckRow:
    """Return the check result on the kernel's clock source."""
    clock_source = _read_or_empty(file_system_root / _CLOCK_SOURCE_FILE)
    # Architectures other than x86 have a fast counter of their own.
    is_fast_clock = clock_source in ("tsc", "kvm-clock", "arch_sys_counter", "riscv_clocksource")
    return CheckRow(
        _COMPUTER_GROUP,
        "clock source",
        clock_source or "unknown",
        "tsc",
        grade(fail=False, warn=not is_fast_clock),
        ""
        if is_fast_clock
        else "Clock source: reading the time costs a microsecond each; the kernel log says why it "
        "does not trust the processor's counter (dmesg | grep -i tsc).",
    )


def _wall_clock_row() -> CheckRow:
    """Return the check result on whether the wall clock is synchronised."""
    is_synchronised = _is_wall_clock_synchronised()
    return CheckRow(
        _COMPUTER_GROUP,
        "wall clock",
        "synchronised" if is_synchronised else "not synchronised",
        "synchronised",
        grade(fail=False, warn=not is_synchronised),
        ""
        if is_synchronised
        else "Wall clock: the times in the files may be wrong (ticks do not depend on it); "
        "timedatectl set-ntp true, or install chrony.",
    )


def _throttling_row(settings: RealtimeSettings, file_system_root: Path) -> CheckRow:
    """Return the result on the fraction of time that the kernel leaves to real-time processes."""
    realtime_runtime_us = _read_number(file_system_root / _REALTIME_RUNTIME_FILE, -1)
    realtime_period_us = _read_number(file_system_root / _REALTIME_PERIOD_FILE, 1_000_000)
    realtime_fraction = (
        realtime_runtime_us / realtime_period_us if realtime_runtime_us >= 0 else 1.0
    )
    is_realtime_limited = realtime_fraction < _MIN_REALTIME_FRACTION and settings.priority > 0
    return CheckRow(
        _COMPUTER_GROUP,
        "real-time share",
        "all of a core"
        if realtime_runtime_us < 0
        else f"{100 * realtime_fraction:.0f} % of a core",
        f"{100 * _MIN_REALTIME_FRACTION:.0f} %",
        grade(fail=False, warn=is_realtime_limited),
        "Real-time share: the kernel stops real-time processes that take more; "
        "sysctl kernel.sched_rt_runtime_us=950000."
        if is_realtime_limited
        else "",
    )


def _is_wall_clock_synchronised() -> bool:
    """Return whether the kernel reports a synchronised wall clock."""
    try:
        clock_state: int = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    except (OSError, AttributeError):
        return False
    return 0 <= clock_state < _CLOCK_ERROR_STATE


def _read_or_empty(path: Path) -> str:
    """Return the stripped text of a file, or an empty string if it cannot be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _read_number(path: Path, default: int) -> int:
    """Return the integer in a file, or `default` if there is none."""
    try:
        return int(_read_or_empty(path))
    except ValueError:
        return default
