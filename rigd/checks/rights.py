"""What the system would grant a session's loop, tried in a process that ends at once."""

import json
import subprocess
import sys
from collections.abc import Iterator

from rigd.checks.rows import Row, Verdict, grade
from rigd.engine.realtime import REFUSED
from rigd.profile import RealtimeSettings

_PATIENCE_S = 20.0
_TRY = """
import json, sys
from rigd.engine.realtime import obtain
print(json.dumps(obtain(priority=int(sys.argv[1]), cpu=int(sys.argv[2]))))
"""
_REMEDY = {
    "memory": "ulimit -l unlimited (memlock in limits.conf)",
    "scheduling": "rtprio for this user in limits.conf",
    "cpu": "realtime.cpu is a core of this machine",
}


def rights_rows(settings: RealtimeSettings) -> Iterator[Row]:
    """Say what a session would be granted of what the profile asks for."""
    command = [sys.executable, "-c", _TRY, str(settings.priority), str(settings.cpu)]
    try:
        tried = subprocess.run(
            command, capture_output=True, text=True, timeout=_PATIENCE_S, check=True
        )
        obtained: dict[str, str] = json.loads(tried.stdout)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        yield Row("real time", "rights", f"could not be tried: {error}", "", Verdict.WARNING)
        return
    if settings.priority == 0:
        yield Row("real time", "scheduling", "not asked for", "", Verdict.OK)
    for name, text in obtained.items():
        refused = text.startswith(REFUSED)
        wanted = _REMEDY.get(name, "granted") if refused else ""
        yield Row(
            "real time", name.replace("_", " "), text, wanted, grade(fail=False, warn=refused)
        )
