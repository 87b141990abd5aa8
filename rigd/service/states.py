"""The states of the daemon, and what leads from one to another. Nothing here does anything."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum

_REMEMBERED = 50


class State(StrEnum):
    """Where the daemon is."""

    IDLE = "idle"
    """The devices are closed."""
    READY = "ready"
    """The devices are connected, the torque is off."""
    RUNNING = "running"
    """A session, or the pause between two of a series."""
    STOPPING = "stopping"
    """A stop was asked for, and the session has not ended yet."""
    FAULT = "fault"
    """Nothing commands a torque until an operator resets the rig; the reason says what the drive
    showed."""


_LEADS_TO: Mapping[State, frozenset[State]] = {
    State.IDLE: frozenset({State.READY, State.FAULT}),
    State.READY: frozenset({State.RUNNING, State.IDLE, State.FAULT}),
    State.RUNNING: frozenset({State.STOPPING, State.READY, State.FAULT}),
    State.STOPPING: frozenset({State.READY, State.FAULT}),
    State.FAULT: frozenset({State.IDLE, State.READY}),
}

_REMEDIES: Mapping[State, str] = {
    State.IDLE: "its devices are being connected; try again in a moment",
    State.READY: "there is nothing to reset",
    State.RUNNING: "wait for the session to end, or end it with rigd stop",
    State.STOPPING: "the session is being stopped; wait for its end",
    State.FAULT: "remove the cause, then run rigd reset",
}
_ADJECTIVES: Mapping[State, str] = {state: state.value for state in State} | {
    State.FAULT: "in fault"
}
_COMES_FROM: Mapping[str, State] = {
    "start": State.READY,
    "tare": State.READY,
    "zero": State.READY,
    "reset": State.FAULT,
}


class IllegalTransitionError(Exception):
    """A transition that there is not: a mistake in the program."""


@dataclass(frozen=True, slots=True)
class Transition:
    """One change of state."""

    utc_ns: int
    before: State
    after: State
    reason: str


class StateMachine:
    """The present state and how it came about.

    Parameters
    ----------
    on_change
        Called with each transition, after it.
    utc_ns
        The wall clock, for tests.

    Attributes
    ----------
    state
        The present one.
    history
        The last transitions, oldest first.
    """

    def __init__(
        self,
        on_change: Callable[[Transition], None] = lambda _: None,
        utc_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._on_change = on_change
        self._utc_ns = utc_ns
        self._began_utc_ns = utc_ns()
        self.state = State.IDLE
        self.history: deque[Transition] = deque(maxlen=_REMEMBERED)

    @property
    def since_utc_ns(self) -> int:
        """When the present state began."""
        return self.history[-1].utc_ns if self.history else self._began_utc_ns

    @property
    def reason(self) -> str:
        """Why it is the present one."""
        return self.history[-1].reason if self.history else "the daemon was started"

    def move(self, after: State, reason: str) -> None:
        """Go to another state.

        Raises
        ------
        IllegalTransitionError
            If nothing leads there from the present one.
        """
        if after not in _LEADS_TO[self.state]:
            raise IllegalTransitionError(f"{self.state} does not lead to {after} ({reason}).")
        transition = Transition(self._utc_ns(), self.state, after, reason)
        self.state = after
        self.history.append(transition)
        self._on_change(transition)

    def refusal(self, command: str) -> str:
        """Say why a command cannot be obeyed in the present state; empty if it can."""
        wanted = _COMES_FROM.get(command, self.state)
        if wanted is self.state:
            return ""
        why = f" ({self.reason.rstrip('.')})" if self.state is State.FAULT else ""
        return (
            f"{command} is for a rig that is {_ADJECTIVES[wanted]}, and this one is "
            f"{_ADJECTIVES[self.state]}{why}: {_REMEDIES[self.state]}."
        )
