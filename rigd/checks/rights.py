"""What the system would grant a session's loop, tried in a process that ends at once."""

import json
import os
import pwd
import subprocess
import sys
from collections.abc import Iterator

from rigd.checks.rows import Row, Verdict, grade
from rigd.engine.realtime import LOCKED, REFUSED
from rigd.profile import RealtimeSettings

_PATIENCE_S = 20.0
_TRY = """
import json, sys
from rigd.engine.realtime import obtain
print(json.dumps(obtain(priority=int(sys.argv[1]), cpu=int(sys.argv[2]))))
"""
_WANTED = {
    "memory": "locked, without a limit",
    "scheduling": "SCHED_FIFO {priority}",
    "cpu": "realtime.cpu: a core of this computer",
    "idle_states": "/dev/cpu_dma_latency may be written to",
}
_IDLE_STATES_REMEDY = (
    "Idle states: a sleeping core takes long to wake up. Let the group rigd bound that with this "
    "line in /etc/udev/rules.d/90-rigd.rules, then udevadm trigger: "
    'KERNEL=="cpu_dma_latency", GROUP="rigd", MODE="0660"'
)


def settings_granted(settings: RealtimeSettings) -> dict[str, str]:
    """Return what :func:`rigd.engine.realtime.obtain` reports in a process of its own.

    Raises
    ------
    OSError, subprocess.SubprocessError, ValueError
        If there is no such process, or it fails.
    """
    command = [sys.executable, "-c", _TRY, str(settings.priority), str(settings.cpu)]
    tried = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=True)
    obtained: dict[str, str] = json.loads(tried.stdout)
    return obtained


def rights_rows(settings: RealtimeSettings) -> Iterator[Row]:
    """Say what a session would be granted of what the profile asks for."""
    try:
        obtained = settings_granted(settings)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        yield Row("real time", "rights", f"could not be tried: {error}", "", Verdict.WARNING)
        return
    if settings.priority == 0:
        yield Row("real time", "scheduling", "not asked for", "", Verdict.OK)
    for name, text in obtained.items():
        lacking = text.startswith(REFUSED) or (name == "memory" and text != LOCKED)
        wanted = _WANTED.get(name, "granted").format(priority=settings.priority) if lacking else ""
        yield Row(
            "real time",
            name.replace("_", " "),
            text,
            wanted,
            grade(fail=False, warn=lacking),
            _remedy(name, settings) if lacking else "",
        )


def _remedy(name: str, settings: RealtimeSettings) -> str:
    """Return what is too long for the table."""
    if name == "idle_states":
        return _IDLE_STATES_REMEDY
    lines = {
        "memory": f"{_user()} - memlock unlimited",
        "scheduling": f"{_user()} - rtprio {settings.priority}",
    }
    if name not in lines:
        return ""
    return (
        f"{name.capitalize()}: put this line into /etc/security/limits.d/rigd.conf and log in "
        f"again: {lines[name]}"
    )


def _user() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return str(os.geteuid())
