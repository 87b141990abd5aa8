"""States of the daemon and their transitions, and JSON documents of the daemon's status."""

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

from rigd.engine.shared_state import Phase
from rigd.engine.workers import PROCESSES
from rigd.live.address import LiveAddress
from rigd.runner.signal_blocks import SignalBlock
from rigd.runner.status import ProcessStatus, RigStatus

_MAX_STORED_TRANSITIONS = 50
"""Largest number of transitions that the daemon's status lists."""


class DaemonState(StrEnum):
    """State of the daemon."""

    IDLE = "idle"
    """The devices are not connected."""
    READY = "ready"
    """The devices are connected, and the torque is off."""
    RUNNING = "running"
    """A series of sessions is running, including the pauses between its sessions."""
    STOPPING = "stopping"
    """A stop was requested, and the session has not ended yet."""
    FAULT = "fault"
    """Something failed, and no torque is commanded until an operator resets the rig."""


_NEXT_STATES: Mapping[DaemonState, frozenset[DaemonState]] = {
    DaemonState.IDLE: frozenset({DaemonState.READY, DaemonState.FAULT}),
    DaemonState.READY: frozenset({DaemonState.RUNNING, DaemonState.IDLE, DaemonState.FAULT}),
    DaemonState.RUNNING: frozenset({DaemonState.STOPPING, DaemonState.READY, DaemonState.FAULT}),
    DaemonState.STOPPING: frozenset({DaemonState.READY, DaemonState.FAULT}),
    DaemonState.FAULT: frozenset({DaemonState.IDLE, DaemonState.READY}),
}
"""State → states that may follow it."""

_STATE_ADVICE: Mapping[DaemonState, str] = {
    DaemonState.IDLE: "its devices are being connected; try again in a moment",
    DaemonState.READY: "there is nothing to reset",
    DaemonState.RUNNING: "wait for the session to end, or end it with rigd stop",
    DaemonState.STOPPING: "the session is being stopped; wait for its end",
    DaemonState.FAULT: "remove the cause, then run rigd reset",
}
"""State in which a command is refused → advice for the operator."""
_STATE_DESCRIPTIONS: Mapping[DaemonState, str] = {state: state.value for state in DaemonState} | {
    DaemonState.FAULT: "in fault"
}
"""State → description for a sentence on the rig."""
_REQUIRED_STATES: Mapping[str, DaemonState] = {
    "start": DaemonState.READY,
    "tare": DaemonState.READY,
    "zero": DaemonState.READY,
    "reset": DaemonState.FAULT,
}
"""Command → state that it requires."""


class IllegalTransitionError(Exception):
    """Raised if a transition of the daemon's state is not permitted, which is a bug."""


@dataclass(frozen=True, slots=True)
class Transition:
    """Change of the daemon's state, with its time (ns since the Unix epoch) and its reason."""

    utc_ns: int
    old_state: DaemonState
    new_state: DaemonState
    reason: str


class DaemonStateMachine:
    """State of the daemon, with its permitted transitions and a history of the last ones.

    `on_change` is called after each change of state; `utc_ns` is the clock, in ns since the Unix
    epoch.
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
        self.history: deque[Transition] = deque(maxlen=_MAX_STORED_TRANSITIONS)

    @property
    def since_utc_ns(self) -> int:
        """Time at which the present state began, in nanoseconds since the Unix epoch."""
        return self.history[-1].utc_ns if self.history else self._began_utc_ns

    @property
    def reason(self) -> str:
        """Reason for which the present state was entered."""
        return self.history[-1].reason if self.history else "the daemon was started"

    def change_to(self, next_state: DaemonState, reason: str) -> None:
        """Change the daemon's state for a reason.

        Raise `IllegalTransitionError` if this state must not follow the present state.
        """
        if next_state not in _NEXT_STATES[self.state]:
            raise IllegalTransitionError(f"{self.state} does not lead to {next_state} ({reason}).")
        transition = Transition(self._utc_ns(), self.state, next_state, reason)
        self.state = next_state
        self.history.append(transition)
        self._on_change(transition)

    def refusal_text(self, command: str) -> str:
        """Return a sentence that refuses a command in the present state; "" if it is permitted."""
        required_state = _REQUIRED_STATES.get(command, self.state)
        if required_state is self.state:
            return ""
        fault_text = f" ({self.reason.rstrip('.')})" if self.state is DaemonState.FAULT else ""
        return (
            f"{command} needs a rig that is {_STATE_DESCRIPTIONS[required_state]}; this one is "
            f"{_STATE_DESCRIPTIONS[self.state]}{fault_text}: {_STATE_ADVICE[self.state]}."
        )


# Documents

Document = dict[str, Any]


_USER_NAME_BY_UID: dict[int, str] = {}
"""User id → user name, for the users resolved so far."""


def resolve_user(uid: int) -> None:
    """Find the name of a user and store it for :class:`Peer`; this may take a long time."""
    if uid not in _USER_NAME_BY_UID:
        with suppress(KeyError):
            _USER_NAME_BY_UID[uid] = pwd.getpwuid(uid).pw_name


@dataclass(frozen=True, slots=True)
class Peer:
    """Client of the daemon, with the process id and user id that the kernel reports."""

    number: int
    """Number of the client's connection."""
    pid: int
    """Process id of the client."""
    uid: int
    """User id of the client."""

    @property
    def user(self) -> str:
        """Name of the client's user, or the user id while the name is unknown."""
        return _USER_NAME_BY_UID.get(self.uid, str(self.uid))

    def __str__(self) -> str:
        return f"process {self.pid} of {self.user}"


def peer_document(peer: Peer | None) -> Document | None:
    """Return process id and user of a client as a dictionary for JSON, or None without client."""
    return None if peer is None else {"pid": peer.pid, "uid": peer.uid, "user": peer.user}


def transition_document(transition: Transition) -> Document:
    """Return a transition of the daemon's state as a dictionary for JSON."""
    return {
        "utc_ns": transition.utc_ns,
        "from": transition.old_state.value,
        "to": transition.new_state.value,
        "reason": transition.reason,
    }


def rig_document(status: RigStatus, rates_hz: Mapping[str, float | None]) -> Document:
    """Return the status of the rig and of its processes as a dictionary for JSON.

    `rates_hz` are the measured numbers of messages per second, by topic.
    """
    return {
        "phase": status.phase.name.lower(),
        "angle_rad": status.angle_rad,
        "coupling_torque_nm": status.coupling_torque_nm,
        "torque_command_nm": status.torque_command_nm,
        "signals": None if status.signals is None else _finite_or_none(asdict(status.signals())),
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
            asdict(process) | {"state": _process_state(process, status.phase)}
            for process in status.processes
        ],
        "topics": [
            {
                "name": topic.name,
                "written": topic.written,
                "waiting": topic.waiting,
                "rate_hz": rates_hz.get(topic.name),
                "expected_hz": topic.expected_hz,
            }
            for topic in status.topics
        ],
    }


def signals_document(
    signal_block: SignalBlock, rate_hz: float, frequency_hz: float | None
) -> Document:
    """Return the event with a block of signals as a dictionary for JSON.

    `rate_hz` is the sample rate, and `frequency_hz` the frequency of the excitation at the block's
    last tick, or None.
    """
    return {
        "event": "signals",
        "first_tick": signal_block.first_tick,
        "count": signal_block.tick_count,
        "rate_hz": rate_hz,
        "t_ns": signal_block.t_ns,
        **{
            signal_name: base64.b64encode(signal_values.astype("<f4").tobytes()).decode("ascii")
            for signal_name, signal_values in signal_block.signals.items()
        },
        "gauges": None
        if signal_block.gauges is None
        else {
            signal_name: {
                "value": gauge.value,
                "limit": gauge.limit,
                "unit": gauge.unit,
                "fraction": gauge.fraction,
            }
            for signal_name, gauge in signal_block.gauges.items()
        },
        "frequency_hz": frequency_hz,
    }


def _finite_or_none(numbers_by_name: Mapping[str, float]) -> Document:
    """Return a copy of a mapping in which None replaces NaN and infinity, for JSON."""
    return {
        quantity_name: quantity_value if isfinite(quantity_value) else None
        for quantity_name, quantity_value in numbers_by_name.items()
    }


def _view_document(live_view: LiveAddress | None) -> Document | None:
    """Return the address of the live view as a dictionary for JSON, or None without live view."""
    return None if live_view is None else {"url": live_view.page_url, **asdict(live_view)}


def _process_state(process: ProcessStatus, phase: Phase) -> str:
    """Return the state of a process, as the status reports it.

    A process that runs for one session only is ``done``, not ``ended``, after the session.
    """
    is_process_per_session = any(p.is_per_session and p.name == process.name for p in PROCESSES)
    return (
        "done"
        if process.state == "ended" and is_process_per_session and phase is Phase.OFF
        else process.state
    )


_PUBLISHED_FIT_KEYS = (
    *("tick", "duration_s", "whole", "problem", "doubt", "warnings", "findings"),
    *("type", "validity", "modes", "parameters", "search", "text"),
)
"""Keys of a fit that clients receive; other values, such as the covariance, are too long."""
_MAX_LIST_ITEMS, _MAX_TEXT_CHARACTERS = 16, 400
_OMITTED_FIT_KEYS = frozenset({"pieces", "constants"})
"""Keys that are left out of a fit because their values are too long: the segments of a search, and
the modal constants of the test of a uniform beam."""


def fit_document(fit: Mapping[str, Any]) -> Document:
    """Return a fit of the record as a dictionary for JSON that has a limited size.

    `fit` has the format of `SessionResult.fit`.
    """
    return {
        fit_key: _shortened_value(fit[fit_key]) for fit_key in _PUBLISHED_FIT_KEYS if fit_key in fit
    }


def _shortened_value(json_value: Any) -> Any:  # noqa: ANN401 - what JSON has
    """Return a JSON value in which lists are cut to 16 items, and texts to 400 characters."""
    if isinstance(json_value, str):
        return json_value[:_MAX_TEXT_CHARACTERS]
    if isinstance(json_value, Mapping):
        return {
            key: _shortened_value(member_name)
            for key, member_name in json_value.items()
            if key not in _OMITTED_FIT_KEYS
        }
    if isinstance(json_value, list | tuple):
        return [_shortened_value(list_item) for list_item in json_value[:_MAX_LIST_ITEMS]]
    return json_value


def progress_document(status: RigStatus, record_ticks: int, rate_hz: float | None) -> Document:
    """Return the progress of a session as a dictionary for JSON.

    `record_ticks` is the number of ticks of the record. `rate_hz` is the sample rate, or None
    under the virtual clock, for which no remaining time is stated.
    """
    # A status that was read just before the session has the counts of the previous session.
    remaining_ticks = max(0, record_ticks - status.tick)
    return {
        "phase": status.phase.name.lower(),
        "activity": status.activity.value,
        "tick": status.tick,
        "total": record_ticks,
        "percent": round(100.0 * status.tick / record_ticks, 1) if record_ticks else 100.0,
        "time_left_s": None if rate_hz is None else round(remaining_ticks / rate_hz, 1),
        "missed": status.missed,
        "late": status.late,
        "lost": status.lost,
    }


def daemon_document(
    profile_name: str,
    session_folder: str,
    *,
    moving_target: str,
    moves_hardware: bool,
    target_description: str,
    uses_virtual_clock: bool,
    with_live_view: bool,
    page_address: str | None,
    calibration: Mapping[str, Any] | None,
    makes_quick_looks: bool,
    failed_checks: list[Document],
    began_utc_ns: int,
) -> Document:
    """Return the description of the daemon, such as its profile, as a dictionary for JSON."""
    from rigd import __version__

    return {
        "pid": os.getpid(),
        "version": __version__,
        "profile": profile_name,
        "moving": moving_target,
        "hardware": moves_hardware,
        "what_moves": target_description,
        "output": session_folder,
        "fast": uses_virtual_clock,
        "live": with_live_view,
        "web": page_address,
        "calibration": None
        if calibration is None
        else {
            "serial": str(calibration.get("serial_number", "")),
            "age": str(calibration.get("calibration_date", "")),
        },
        "quick_looks": makes_quick_looks,
        "failed_checks": failed_checks,
        "since_utc_ns": began_utc_ns,
    }


def transition_documents(transitions: Iterable[Transition]) -> list[Document]:
    """Return transitions of the daemon's state as a list of dictionaries for JSON."""
    return [transition_document(transition) for transition in transitions]
