"""What this computer is like for a loop in real time: advice, never a refusal.

``rigd bench`` measures what it comes to; ``docs/real_time.md`` says how to change it.
"""

import ctypes
import os
import platform
from collections.abc import Iterator
from pathlib import Path

from rigd.checks.rows import Row, grade
from rigd.engine.realtime import isolated_cores
from rigd.profile import RealtimeSettings

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
"""Of each period that the kernel leaves to real-time processes unless told otherwise."""


def machine_rows(
    settings: RealtimeSettings, root: Path = Path("/"), kernel: str = ""
) -> Iterator[Row]:
    """Say what about this computer makes ticks late, and what is done about it.

    Parameters
    ----------
    settings
        What the profile asks for.
    root
        Of the file system.
    kernel
        Its version as ``uname -v`` has it; empty: that of this computer.
    """
    kernel = kernel or platform.version()
    yield _kernel_row(root, kernel)
    yield _virtual_row(root)
    yield _core_row(settings, root)
    yield _governor_row(root)
    yield _clock_row(root)
    yield _wall_clock_row()
    yield _throttling_row(settings, root)


def _kernel_row(root: Path, kernel: str) -> Row:
    preemptible = "PREEMPT_RT" in kernel or _read(root / _REALTIME_KERNEL) == "1"
    if preemptible:
        found = "PREEMPT_RT"
    else:
        found = "preemptible" if "PREEMPT" in kernel else "not preemptible"
    return Row(
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


def _virtual_row(root: Path) -> Row:
    words = set(_read(root / "proc/cpuinfo").split())
    virtual = "hypervisor" in words or bool(_read(root / "sys/hypervisor/type"))
    return Row(
        _GROUP,
        "hardware",
        "virtual machine" if virtual else "no hypervisor seen",
        "a computer of its own",
        grade(fail=False, warn=virtual),
        "Hardware: the host takes the processor away for milliseconds and nothing in here can keep "
        "it; run a real rig on a computer of its own."
        if virtual
        else "",
    )


def _core_row(settings: RealtimeSettings, root: Path) -> Row:
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
    return Row(
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


def _governor_row(root: Path) -> Row:
    governors = {
        _read(path) for path in sorted((root / _CPU).glob("cpu[0-9]*/cpufreq/scaling_governor"))
    }
    slow = bool(governors - {"performance"})
    return Row(
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


def _clock_row(root: Path) -> Row:
    source = _read(root / _CLOCK_SOURCE)
    # On other architectures than x86 the counter is the architecture's own, and quick.
    quick = source in ("tsc", "kvm-clock", "arch_sys_counter", "riscv_clocksource")
    return Row(
        _GROUP,
        "clock source",
        source or "unknown",
        "tsc",
        grade(fail=False, warn=not quick),
        ""
        if quick
        else "Clock source: reading the time costs a microsecond each; see in the kernel's log why "
        "it does not trust the processor's counter (dmesg | grep -i tsc).",
    )


def _wall_clock_row() -> Row:
    synchronised = _synchronised()
    return Row(
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


def _throttling_row(settings: RealtimeSettings, root: Path) -> Row:
    runtime_us = _number(root / _THROTTLING, -1)
    period_us = _number(root / _THROTTLING_PERIOD, 1_000_000)
    share = runtime_us / period_us if runtime_us >= 0 else 1.0
    low = share < _LEAST_RUNTIME and settings.priority > 0
    return Row(
        _GROUP,
        "real-time share",
        "all of a core" if runtime_us < 0 else f"{100 * share:.0f} % of a core",
        f"{100 * _LEAST_RUNTIME:.0f} %",
        grade(fail=False, warn=low),
        "Real-time share: the kernel stops real-time processes that take more; "
        "sysctl kernel.sched_rt_runtime_us=950000."
        if low
        else "",
    )


def _synchronised() -> bool:
    """Whether the kernel knows of somebody who keeps its wall clock right."""
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
