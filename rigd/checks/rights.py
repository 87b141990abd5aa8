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
from rigd.engine.realtime import Precedence, obtain
priority, below, cpu = map(int, sys.argv[1:])
beside = Precedence(below, cpu)
supervision = beside.take()
beside.release()
print(json.dumps([obtain(priority=priority, cpu=cpu), supervision]))
"""
_ROWS = {"supervision": "supervisor and recorder"}
_WANTED = {
    "memory": "locked, without a limit",
    "scheduling": "SCHED_FIFO {priority}",
    "supervision": "SCHED_RR {supervision_priority}",
    "cpu": "realtime.cpu: a core of this computer",
    "idle_states": "/dev/cpu_dma_latency may be written to",
}
_IDLE_STATES_REMEDY = (
    "Idle states: a sleeping core takes long to wake up. Let the group rigd bound that with this "
    "line in /etc/udev/rules.d/90-rigd.rules, then udevadm trigger: "
    'KERNEL=="cpu_dma_latency", GROUP="rigd", MODE="0660"'
)


def settings_granted(settings: RealtimeSettings) -> dict[str, str]:
    """Return what the control process is granted, tried in a process of its own.

    Under ``supervision`` stands what supervisor and recorder are.

    Raises
    ------
    OSError, subprocess.SubprocessError, ValueError
        If there is no such process, or it fails.
    """
    numbers = settings.priority, settings.supervision_priority, settings.cpu
    command = [sys.executable, "-c", _TRY, *map(str, numbers)]
    tried = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=True)
    obtained: dict[str, str]
    obtained, supervision = json.loads(tried.stdout)
    if supervision:
        cores = supervision.get("cores")
        where = f" on core {cores}" if cores else ""
        obtained["supervision"] = supervision["scheduling"] + where
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
        lacking = (
            text.startswith(REFUSED)
            or (name == "memory" and text != LOCKED)
            or (name == "supervision" and not text.startswith("SCHED_RR"))
        )
        wanted = _WANTED.get(name, "granted") if lacking else ""
        yield Row(
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
    """Return what is too long for the table."""
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
