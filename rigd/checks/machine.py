"""Checks of this computer for a loop in real time: rights and settings. Advice, never a refusal.

What the system would grant a session's loop is tried in a process that ends at once. ``rigd bench``
measures what the settings come to; ``docs/real_time.md`` says how to change them.
"""

import ctypes
import json
import os
import platform
import pwd
import subprocess
from collections.abc import Iterator
from pathlib import Path

from rigd.checks.rows import CheckResult, CheckRow, grade
from rigd.engine.realtime import LOCKED, REFUSED, isolated_cores
from rigd.profile import RealtimeSettings
from rigd.runtime import OWN_PYTHON

# Rights

_PATIENCE_S = 20.0
_TRY = """
import json, sys
from rigd.engine.realtime import Precedence, apply_realtime
priority, below, cpu = map(int, sys.argv[1:])
other = Precedence(below, cpu)
supervision = other.take()
other.release()
print(json.dumps([apply_realtime(priority=priority, cpu=cpu), supervision]))
"""
_ROWS = {"supervision": "supervisor and recorder"}
_WANTED = {
    "memory": "locked, without a limit",
    "scheduling": "SCHED_FIFO {priority}",
    "supervision": "SCHED_RR {supervision_priority}",
    "cpu": "realtime.cpu: a core of this computer",
    "idle_states": "/dev/cpu_dma_latency is writable",
}
_IDLE_STATES_REMEDY = (
    "Idle states: a sleeping core takes long to wake up. Let the group rigd bound that with this "
    "line in /etc/udev/rules.d/90-rigd.rules, then udevadm trigger: "
    'KERNEL=="cpu_dma_latency", GROUP="rigd", MODE="0660"'
)


def settings_granted(settings: RealtimeSettings) -> dict[str, str]:
    """Return the settings granted to the control process, tried in a process of its own.

    The key ``supervision`` holds the settings of supervisor and recorder.

    Raises
    ------
    OSError, subprocess.SubprocessError, ValueError
        If there is no such process, or it fails.
    """
    numbers = settings.priority, settings.supervision_priority, settings.cpu
    command = [*OWN_PYTHON, "-c", _TRY, *map(str, numbers)]
    tried = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=True)
    obtained: dict[str, str]
    obtained, supervision = json.loads(tried.stdout)
    if supervision:
        cores = supervision.get("cores")
        where = f" on core {cores}" if cores else ""
        obtained["supervision"] = supervision["scheduling"] + where
    return obtained


def rights_rows(settings: RealtimeSettings) -> Iterator[CheckRow]:
    """Return the rows on the real-time settings that a session would be granted."""
    try:
        obtained = settings_granted(settings)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        yield CheckRow(
            "real time", "rights", f"could not be tried: {error}", "", CheckResult.WARNING
        )
        return
    if settings.priority == 0:
        yield CheckRow("real time", "scheduling", "not requested", "", CheckResult.OK)
    for name, text in obtained.items():
        lacking = (
            text.startswith(REFUSED)
            or (name == "memory" and text != LOCKED)
            or (name == "supervision" and not text.startswith("SCHED_RR"))
        )
        wanted = _WANTED.get(name, "granted") if lacking else ""
        yield CheckRow(
            "real time",
            _ROWS.get(name, name.replace("_", " ")),
            text,
            wanted.format(
                priority=settings.priority, supervision_priority=settings.supervision_priority
            ),
            grade(fail=False, warn=lacking),
            _remedy(name, settings) if lacking else "",
        )


def _remedy(name: str, settings: RealtimeSettings) -> str:
    """Return the remedy, which is too long for the table."""
    if name == "idle_states":
        return _IDLE_STATES_REMEDY
    lines = {
        "memory": f"{_user()} - memlock unlimited",
        "scheduling": f"{_user()} - rtprio {settings.priority}",
        "supervision": f"{_user()} - rtprio {settings.priority}",
    }
    if name not in lines:
        return ""
    row = _ROWS.get(name, name).capitalize()
    return (
        f"{row}: put this line into /etc/security/limits.d/rigd.conf and log in again: "
        f"{lines[name]}"
    )


def _user() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return str(os.geteuid())


# Computer

_GROUP = "computer"
_CPU = Path("sys/devices/system/cpu")
_CLOCK_SOURCE = Path("sys/devices/system/clocksource/clocksource0/current_clocksource")
_THROTTLING = Path("proc/sys/kernel/sched_rt_runtime_us")
_THROTTLING_PERIOD = Path("proc/sys/kernel/sched_rt_period_us")
_REALTIME_KERNEL = Path("sys/kernel/realtime")
_TIMEX_SIZE = 512
"""More than the kernel's structure has on any architecture."""
_NOT_SYNCHRONISED = 5
_LEAST_RUNTIME = 0.95
"""Fraction of each period that the kernel leaves to real-time processes by default."""


def machine_rows(
    settings: RealtimeSettings, root: Path = Path("/"), kernel: str = ""
) -> Iterator[CheckRow]:
    """Return the rows on settings of this computer that delay ticks, with remedies.

    Parameters
    ----------
    settings
        Real-time settings of the profile.
    root
        Root of the file system.
    kernel
        Version of the kernel as in ``uname -v``; empty: that of this computer.
    """
    kernel = kernel or platform.version()
    yield _kernel_row(root, kernel)
    yield _virtual_row(root)
    yield _core_row(settings, root)
    yield _governor_row(root)
    yield _clock_row(root)
    yield _wall_clock_row()
    yield _throttling_row(settings, root)


def _kernel_row(root: Path, kernel: str) -> CheckRow:
    preemptible = "PREEMPT_RT" in kernel or _read(root / _REALTIME_KERNEL) == "1"
    if preemptible:
        found = "PREEMPT_RT"
    else:
        found = "preemptible" if "PREEMPT" in kernel else "not preemptible"
    return CheckRow(
        _GROUP,
        "kernel",
        found,
        "PREEMPT_RT",
        grade(fail=False, warn=not preemptible),
        ""
        if preemptible
        else "Kernel: an ordinary one delays a tick by milliseconds now and then; install your "
        "distribution's real-time kernel (Debian: linux-image-rt-amd64; Ubuntu: pro enable "
        "realtime-kernel).",
    )


def _virtual_row(root: Path) -> CheckRow:
    words = set(_read(root / "proc/cpuinfo").split())
    virtual = "hypervisor" in words or bool(_read(root / "sys/hypervisor/type"))
    return CheckRow(
        _GROUP,
        "hardware",
        "virtual machine" if virtual else "no hypervisor seen",
        "a dedicated computer",
        grade(fail=False, warn=virtual),
        "Hardware: the hypervisor can suspend this machine for milliseconds, which nothing inside "
        "can prevent; run a real rig on a dedicated computer."
        if virtual
        else "",
    )


def _core_row(settings: RealtimeSettings, root: Path) -> CheckRow:
    isolated = isolated_cores(root)
    cores = ", ".join(map(str, sorted(isolated)))
    alone = settings.cpu in isolated if settings.cpu >= 0 else bool(isolated)
    if settings.cpu >= 0 and isolated and not alone:
        found, remedy = (
            f"{cores}; the loop runs on {settings.cpu}",
            f"Isolated core: set realtime.cpu to -1 or to one of {cores}.",
        )
    else:
        found, remedy = cores or "none", _how_to_isolate((os.cpu_count() or 1) - 1)
    return CheckRow(
        _GROUP,
        "isolated core",
        found,
        "one",
        grade(fail=False, warn=not alone),
        "" if alone else remedy,
    )


def _how_to_isolate(last: int) -> str:
    if last == 0:
        return (
            "Isolated core: this computer has one core, which everything shares; use one with more."
        )
    return (
        "Isolated core: other programs may share the loop's core. Boot with "
        f"isolcpus={last} nohz_full={last} irqaffinity=0 (GRUB_CMDLINE_LINUX in /etc/default/grub, "
        "then update-grub)."
    )


def _governor_row(root: Path) -> CheckRow:
    governors = {
        _read(path) for path in sorted((root / _CPU).glob("cpu[0-9]*/cpufreq/scaling_governor"))
    }
    slow = bool(governors - {"performance"})
    return CheckRow(
        _GROUP,
        "frequency governor",
        ", ".join(sorted(governors)) or "none: the frequency is not this system's",
        "performance",
        grade(fail=False, warn=slow),
        "Frequency governor: an idle core slows down and takes longer for the next tick; "
        "cpupower frequency-set -g performance."
        if slow
        else "",
    )


def _clock_row(root: Path) -> CheckRow:
    source = _read(root / _CLOCK_SOURCE)
    # On other architectures than x86 the counter is the architecture's own, and quick.
    quick = source in ("tsc", "kvm-clock", "arch_sys_counter", "riscv_clocksource")
    return CheckRow(
        _GROUP,
        "clock source",
        source or "unknown",
        "tsc",
        grade(fail=False, warn=not quick),
        ""
        if quick
        else "Clock source: reading the time costs a microsecond each; the kernel log says why it "
        "does not trust the processor's counter (dmesg | grep -i tsc).",
    )


def _wall_clock_row() -> CheckRow:
    synchronised = _synchronised()
    return CheckRow(
        _GROUP,
        "wall clock",
        "synchronised" if synchronised else "not synchronised",
        "synchronised",
        grade(fail=False, warn=not synchronised),
        ""
        if synchronised
        else "Wall clock: the times in the files may be wrong (ticks do not depend on it); "
        "timedatectl set-ntp true, or install chrony.",
    )


def _throttling_row(settings: RealtimeSettings, root: Path) -> CheckRow:
    runtime_us = _number(root / _THROTTLING, -1)
    period_us = _number(root / _THROTTLING_PERIOD, 1_000_000)
    fraction = runtime_us / period_us if runtime_us >= 0 else 1.0
    low = fraction < _LEAST_RUNTIME and settings.priority > 0
    return CheckRow(
        _GROUP,
        "real-time share",
        "all of a core" if runtime_us < 0 else f"{100 * fraction:.0f} % of a core",
        f"{100 * _LEAST_RUNTIME:.0f} %",
        grade(fail=False, warn=low),
        "Real-time share: the kernel stops real-time processes that take more; "
        "sysctl kernel.sched_rt_runtime_us=950000."
        if low
        else "",
    )


def _synchronised() -> bool:
    """Return whether the kernel reports a synchronised wall clock."""
    try:
        state: int = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_SIZE))
    except (OSError, AttributeError):
        return False
    return 0 <= state < _NOT_SYNCHRONISED


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _number(path: Path, otherwise: int) -> int:
    try:
        return int(_read(path))
    except ValueError:
        return otherwise
