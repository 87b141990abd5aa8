"""What the daemon tells, as JSON: sessions, plans, the state of the rig."""

import os
import pwd
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any

from rigd.engine.board import Phase
from rigd.engine.processes import PROCESSES
from rigd.live.address import LiveAddress
from rigd.planning import Plan
from rigd.service.states import Transition
from rigd.supervisor.status import ProcessStatus, RigStatus

Document = dict[str, Any]


_USERS: dict[int, str] = {}
"""Names by number."""


def look_up_user(uid: int) -> None:
    """Find out the name of a user, which may take its time, for :class:`Peer`."""
    if uid not in _USERS:
        with suppress(KeyError):
            _USERS[uid] = pwd.getpwuid(uid).pw_name


@dataclass(frozen=True, slots=True)
class Peer:
    """A client, as the kernel knows it."""

    number: int
    """Of its connection."""
    pid: int
    uid: int

    @property
    def user(self) -> str:
        """Its user's name, as far as that was looked up."""
        return _USERS.get(self.uid, str(self.uid))

    def __str__(self) -> str:
        return f"process {self.pid} of {self.user}"


def peer_document(peer: Peer | None) -> Document | None:
    """Tell who controls."""
    return None if peer is None else {"pid": peer.pid, "uid": peer.uid, "user": peer.user}


def plan_document(plan: Plan, record_s: float) -> Document:
    """Tell what a session is predicted to do."""
    return {
        "record_s": record_s,
        **asdict(plan.prediction),
        "tip_in_words": plan.tip_in_words,
        "warnings": list(plan.warnings),
    }


def transition_document(transition: Transition) -> Document:
    """Tell of one change of state."""
    return {
        "utc_ns": transition.utc_ns,
        "from": transition.before.value,
        "to": transition.after.value,
        "reason": transition.reason,
    }


def rig_document(look: RigStatus, rates: Mapping[str, float | None]) -> Document:
    """Tell how the rig and its processes are.

    Parameters
    ----------
    look
        At the board.
    rates
        Measured records a second, by topic.
    """
    return {
        "phase": look.phase.name.lower(),
        "angle_rad": look.angle_rad,
        "coupling_torque_nm": look.coupling_torque_nm,
        "torque_command_nm": look.torque_command_nm,
        "signals": None if look.signals is None else _finite(asdict(look.signals)),
        "health": {
            "missed": look.missed,
            "late": look.late,
            "lost": look.lost,
            "bus_load_percent": look.bus_load_percent,
            "bus_errors": look.bus_errors,
            "sensor_status": look.sensor_status,
            "disk_free_mb": look.disk_free_mb,
            "view_dropped": look.view_dropped,
        },
        "live_view": _view_document(look.live_view),
        "processes": [
            asdict(process) | {"state": _state(process, look.phase)} for process in look.processes
        ],
        "topics": [
            {
                "name": topic.name,
                "written": topic.written,
                "waiting": topic.waiting,
                "rate_hz": rates.get(topic.name),
                "expected_hz": topic.expected_hz,
            }
            for topic in look.topics
        ],
    }


def _finite(values: Mapping[str, float]) -> Document:
    """Return numbers as JSON can have them."""
    return {name: value if isfinite(value) else None for name, value in values.items()}


def _view_document(view: LiveAddress | None) -> Document | None:
    """Tell where the live view is."""
    return None if view is None else {"url": view.page_url, **asdict(view)}


def _state(process: ProcessStatus, phase: Phase) -> str:
    """Return a process's state; of one that is started for each session its end is no news."""
    passing = any(p.for_one_session and p.name == process.name for p in PROCESSES)
    return "done" if process.state == "ended" and passing and phase is Phase.OFF else process.state


def progress_document(look: RigStatus, total: int, rate_hz: float | None) -> Document:
    """Tell how far a session is.

    Parameters
    ----------
    look
        At the board.
    total
        Ticks of the record.
    rate_hz
        Ticks a second of real time; None where time is skipped.
    """
    # Until tick 0 the board may still have the counts of the session before.
    left = max(0, total - look.tick)
    return {
        "phase": look.phase.name.lower(),
        "tick": look.tick,
        "total": total,
        "percent": round(100.0 * look.tick / total, 1) if total else 100.0,
        "time_left_s": None if rate_hz is None else round(left / rate_hz, 1),
        "missed": look.missed,
        "late": look.late,
        "lost": look.lost,
    }


def daemon_document(
    profile: str,
    output: str,
    *,
    moving: str,
    hardware: bool,
    told: str,
    fast: bool,
    live: bool,
    began_utc_ns: int,
) -> Document:
    """Tell which daemon this is."""
    from rigd import __version__

    return {
        "pid": os.getpid(),
        "version": __version__,
        "profile": profile,
        "moving": moving,
        "hardware": hardware,
        "what_moves": told,
        "output": output,
        "fast": fast,
        "live": live,
        "since_utc_ns": began_utc_ns,
    }


def histories(transitions: Iterable[Transition]) -> list[Document]:
    """Tell of the last changes of state."""
    return [transition_document(transition) for transition in transitions]
