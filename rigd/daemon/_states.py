"""States of the daemon, their transitions, and the daemon's status as JSON documents."""

import base64
import os
import pwd
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from enum import StrEnum
from math import isfinite
from typing import Any

from rigd.engine.processes import PROCESSES
from rigd.engine.shared_state import Phase
from rigd.live.address import LiveAddress
from rigd.runner.signal_blocks import SignalBlock
from rigd.runner.status import ProcessStatus, RigStatus

_REMEMBERED = 50


class DaemonState(StrEnum):
    """States of the daemon."""

    IDLE = "idle"
    """The devices are closed."""
    READY = "ready"
    """The devices are connected, the torque is off."""
    RUNNING = "running"
    """A session runs, or a pause between two sessions of a series."""
    STOPPING = "stopping"
    """A stop was requested, and the session has not ended yet."""
    FAULT = "fault"
    """No torque is commanded until an operator resets the rig; the reason has the drive report."""


_LEADS_TO: Mapping[DaemonState, frozenset[DaemonState]] = {
    DaemonState.IDLE: frozenset({DaemonState.READY, DaemonState.FAULT}),
    DaemonState.READY: frozenset({DaemonState.RUNNING, DaemonState.IDLE, DaemonState.FAULT}),
    DaemonState.RUNNING: frozenset({DaemonState.STOPPING, DaemonState.READY, DaemonState.FAULT}),
    DaemonState.STOPPING: frozenset({DaemonState.READY, DaemonState.FAULT}),
    DaemonState.FAULT: frozenset({DaemonState.IDLE, DaemonState.READY}),
}

_REMEDIES: Mapping[DaemonState, str] = {
    DaemonState.IDLE: "its devices are being connected; try again in a moment",
    DaemonState.READY: "there is nothing to reset",
    DaemonState.RUNNING: "wait for the session to end, or end it with rigd stop",
    DaemonState.STOPPING: "the session is being stopped; wait for its end",
    DaemonState.FAULT: "remove the cause, then run rigd reset",
}
_ADJECTIVES: Mapping[DaemonState, str] = {state: state.value for state in DaemonState} | {
    DaemonState.FAULT: "in fault"
}
_COMES_FROM: Mapping[str, DaemonState] = {
    "start": DaemonState.READY,
    "tare": DaemonState.READY,
    "zero": DaemonState.READY,
    "reset": DaemonState.FAULT,
}


class IllegalTransitionError(Exception):
    """A transition is not in the table, which is a bug."""


@dataclass(frozen=True, slots=True)
class Transition:
    """One change of state."""

    utc_ns: int
    before: DaemonState
    after: DaemonState
    reason: str


class DaemonStateMachine:
    """State machine of the daemon, with its last transitions.

    Parameters
    ----------
    on_change
        Called with each transition, after it.
    utc_ns
        Wall clock, which tests replace.

    Attributes
    ----------
    state
        Present state.
    history
        Last transitions, oldest first.
    """

    def __init__(
        self,
        on_change: Callable[[Transition], None] = lambda _: None,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._on_change = on_change
        self._utc_ns = utc_ns
        self._began_utc_ns = utc_ns()
        self.state = DaemonState.IDLE
        self.history: deque[Transition] = deque(maxlen=_REMEMBERED)

    @property
    def since_utc_ns(self) -> int:
        """Time at which the present state began."""
        return self.history[-1].utc_ns if self.history else self._began_utc_ns

    @property
    def reason(self) -> str:
        """Reason of the present state."""
        return self.history[-1].reason if self.history else "the daemon was started"

    def move(self, after: DaemonState, reason: str) -> None:
        """Change to another state.

        Raises
        ------
        IllegalTransitionError
            If there is no such transition.
        """
        if after not in _LEADS_TO[self.state]:
            raise IllegalTransitionError(f"{self.state} does not lead to {after} ({reason}).")
        transition = Transition(self._utc_ns(), self.state, after, reason)
        self.state = after
        self.history.append(transition)
        self._on_change(transition)

    def refusal(self, command: str) -> str:
        """Return why a command is refused in the present state; empty if it is not."""
        wanted = _COMES_FROM.get(command, self.state)
        if wanted is self.state:
            return ""
        why = f" ({self.reason.rstrip('.')})" if self.state is DaemonState.FAULT else ""
        return (
            f"{command} needs a rig that is {_ADJECTIVES[wanted]}; this one is "
            f"{_ADJECTIVES[self.state]}{why}: {_REMEDIES[self.state]}."
        )


# Documents

Document = dict[str, Any]


_USERS: dict[int, str] = {}
"""Names of users by their numbers."""


def resolve_user(uid: int) -> None:
    """Find the name of a user for :class:`Peer`, which may take long."""
    if uid not in _USERS:
        with suppress(KeyError):
            _USERS[uid] = pwd.getpwuid(uid).pw_name


@dataclass(frozen=True, slots=True)
class Peer:
    """A client, as the kernel identifies it."""

    number: int
    """Number of its connection."""
    pid: int
    uid: int

    @property
    def user(self) -> str:
        """Name of its user, or the number while the name is unknown."""
        return _USERS.get(self.uid, str(self.uid))

    def __str__(self) -> str:
        return f"process {self.pid} of {self.user}"


def peer_document(peer: Peer | None) -> Document | None:
    """Return the client that holds control as a JSON document."""
    return None if peer is None else {"pid": peer.pid, "uid": peer.uid, "user": peer.user}


def transition_document(transition: Transition) -> Document:
    """Return a transition as a JSON document."""
    return {
        "utc_ns": transition.utc_ns,
        "from": transition.before.value,
        "to": transition.after.value,
        "reason": transition.reason,
    }


def rig_document(status: RigStatus, rates: Mapping[str, float | None]) -> Document:
    """Return the status of the rig and its processes as a JSON document.

    Parameters
    ----------
    status
        Status of the rig.
    rates
        Measured records per second, by topic.
    """
    return {
        "phase": status.phase.name.lower(),
        "angle_rad": status.angle_rad,
        "coupling_torque_nm": status.coupling_torque_nm,
        "torque_command_nm": status.torque_command_nm,
        "signals": None if status.signals is None else _finite(asdict(status.signals())),
        "health": {
            "missed": status.missed,
            "late": status.late,
            "lost": status.lost,
            "bus_load_percent": status.bus_load_percent,
            "bus_errors": status.bus_errors,
            "sensor_status": status.sensor_status,
            "disk_free_mb": status.disk_free_mb,
            "view_dropped": status.view_dropped,
        },
        "live_view": _view_document(status.live_view),
        "processes": [
            asdict(process) | {"state": _state(process, status.phase)}
            for process in status.processes
        ],
        "topics": [
            {
                "name": topic.name,
                "written": topic.written,
                "waiting": topic.waiting,
                "rate_hz": rates.get(topic.name),
                "expected_hz": topic.expected_hz,
            }
            for topic in status.topics
        ],
    }


def signals_document(block: SignalBlock, rate_hz: float, frequency_hz: float | None) -> Document:
    """Return a block of signals as a JSON document.

    Parameters
    ----------
    block
        Signals and gauges.
    rate_hz
        Ticks per second.
    frequency_hz
        Frequency of the excitation at the last tick.
    """
    return {
        "event": "signals",
        "first_tick": block.first_tick,
        "count": block.count,
        "rate_hz": rate_hz,
        "t_ns": block.t_ns,
        **{
            name: base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")
            for name, values in block.signals.items()
        },
        "gauges": None
        if block.gauges is None
        else {
            name: {
                "value": gauge.value,
                "limit": gauge.limit,
                "unit": gauge.unit,
                "fraction": gauge.fraction,
            }
            for name, gauge in block.gauges.items()
        },
        "frequency_hz": frequency_hz,
    }


def _finite(values: Mapping[str, float]) -> Document:
    """Return numbers for JSON, with null for values that are not finite."""
    return {name: value if isfinite(value) else None for name, value in values.items()}


def _view_document(view: LiveAddress | None) -> Document | None:
    """Return the address of the live view as a JSON document."""
    return None if view is None else {"url": view.page_url, **asdict(view)}


def _state(process: ProcessStatus, phase: Phase) -> str:
    """Return the state of a process; one that lasts for one session ends as ``done``."""
    passing = any(p.for_one_session and p.name == process.name for p in PROCESSES)
    return "done" if process.state == "ended" and passing and phase is Phase.OFF else process.state


_OF_A_FIT = (
    *("tick", "duration_s", "whole", "problem", "doubt", "warnings", "findings"),
    *("type", "validity", "modes", "parameters", "search", "text"),
)
"""Members of a fit that clients receive; others, such as the covariance, are too long."""
_MOST_ITEMS, _LONGEST_TEXT = 16, 400
_LONG = frozenset({"pieces", "constants"})
"""Omitted members of these: segments of a search (they are in the file), and the modal constants of
the test of uniformity."""


def fit_document(fit: Mapping[str, Any]) -> Document:
    """Return a fit of the record as a JSON document of bounded size.

    Parameters
    ----------
    fit
        The fit, as in `RunResult.fit`.
    """
    return {name: _bounded(fit[name]) for name in _OF_A_FIT if name in fit}


def _bounded(value: Any) -> Any:  # noqa: ANN401 - what JSON has
    """Return lists and texts shortened to a bounded size."""
    if isinstance(value, str):
        return value[:_LONGEST_TEXT]
    if isinstance(value, Mapping):
        return {key: _bounded(member) for key, member in value.items() if key not in _LONG}
    if isinstance(value, list | tuple):
        return [_bounded(item) for item in value[:_MOST_ITEMS]]
    return value


def progress_document(status: RigStatus, total: int, rate_hz: float | None) -> Document:
    """Return the progress of a session as a JSON document.

    Parameters
    ----------
    status
        Status of the rig.
    total
        Ticks of the record.
    rate_hz
        Ticks per second of real time; None with the virtual clock.
    """
    # Until tick 0 the shared state may have the counts of the session before.
    left = max(0, total - status.tick)
    return {
        "phase": status.phase.name.lower(),
        "activity": status.activity.value,
        "tick": status.tick,
        "total": total,
        "percent": round(100.0 * status.tick / total, 1) if total else 100.0,
        "time_left_s": None if rate_hz is None else round(left / rate_hz, 1),
        "missed": status.missed,
        "late": status.late,
        "lost": status.lost,
    }


def daemon_document(
    profile: str,
    output: str,
    *,
    moving: str,
    hardware: bool,
    moving_text: str,
    fast: bool,
    live: bool,
    web: str | None,
    calibration: Mapping[str, Any] | None,
    quick_looks: bool,
    failed_checks: list[Document],
    began_utc_ns: int,
) -> Document:
    """Return the description of the daemon as a JSON document."""
    from rigd import __version__

    return {
        "pid": os.getpid(),
        "version": __version__,
        "profile": profile,
        "moving": moving,
        "hardware": hardware,
        "what_moves": moving_text,
        "output": output,
        "fast": fast,
        "live": live,
        "web": web,
        "calibration": None
        if calibration is None
        else {
            "serial": str(calibration.get("serial_number", "")),
            "age": str(calibration.get("calibration_date", "")),
        },
        "quick_looks": quick_looks,
        "failed_checks": failed_checks,
        "since_utc_ns": began_utc_ns,
    }


def histories(transitions: Iterable[Transition]) -> list[Document]:
    """Return the last transitions as JSON documents."""
    return [transition_document(transition) for transition in transitions]
