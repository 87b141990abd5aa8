"""The CiA 402 state machine of a simulated drive: states, commands and automatic transitions."""

from collections.abc import Callable
from enum import Enum

from rigd.sim.wire.canopen_objects import Entry

RAMP_S = 0.05
"""How long a ramp lasts. In a torque mode there is nothing to ramp: the shaft coasts meanwhile."""

_SWITCH_ON, _ENABLE_VOLTAGE, _NO_QUICK_STOP, _ENABLE_OPERATION = 0x01, 0x02, 0x04, 0x08
_FAULT_RESET = 0x80

_STAY_IN_QUICK_STOP = 5
"""From this value of 605A on."""


class State(Enum):
    """State of the drive: its name, and bits 0 to 3, 5 and 6 of the statusword."""

    NOT_READY = ("not ready to switch on", 0x00)
    SWITCH_ON_DISABLED = ("switch on disabled", 0x40)
    READY = ("ready to switch on", 0x21)
    SWITCHED_ON = ("switched on", 0x23)
    OPERATION_ENABLED = ("operation enabled", 0x27)
    QUICK_STOP = ("quick stop active", 0x07)
    FAULT_REACTION = ("fault reaction active", 0x0F)
    FAULT = ("fault", 0x08)

    def __init__(self, label: str, bits: int) -> None:
        self.label = label
        self.bits = bits


_POWERED = (State.READY, State.SWITCHED_ON, State.OPERATION_ENABLED, State.QUICK_STOP)


class StateMachine:
    """States and what leads from one to another.

    Parameters
    ----------
    quick_stop_option, fault_option
        Objects 605A and 605E.
    entered
        Called with the state left after each change; `state` is then the new one.
    may_switch_on
        Asked before the first step up from switch on disabled.
    may_enable
        Asked before operation is enabled.
    may_reset
        Asked at a fault reset, whether no cause of the fault stands.

    Attributes
    ----------
    state : State
        The present one.
    """

    def __init__(
        self,
        quick_stop_option: Entry,
        fault_option: Entry,
        entered: Callable[[State], None],
        may_switch_on: Callable[[], bool],
        may_enable: Callable[[], bool],
        may_reset: Callable[[], bool],
    ) -> None:
        self.state = State.NOT_READY
        self._quick_stop_option = quick_stop_option
        self._fault_option = fault_option
        self._entered = entered
        self._may_switch_on = may_switch_on
        self._may_enable = may_enable
        self._may_reset = may_reset
        self._reset_bit = 0
        self._ramp_since_s: float | None = None

    def start(self) -> None:
        """Go through the self-test after power-on or a reset."""
        self._reset_bit = 0
        self._enter(State.NOT_READY)
        self._enter(State.SWITCH_ON_DISABLED)

    def control(self, word: int) -> None:
        """Take a controlword."""
        reset_bit = word & _FAULT_RESET
        rising, self._reset_bit = reset_bit and not self._reset_bit, reset_bit
        if self.state is State.FAULT:
            if rising and self._may_reset():
                self._enter(State.SWITCH_ON_DISABLED)
        elif not word & _ENABLE_VOLTAGE:
            self.disable_voltage()
        elif not word & _NO_QUICK_STOP:
            self.quick_stop()
        elif not word & _SWITCH_ON:
            self._shut_down(reset_bit)
        else:
            self._switch_on(word, reset_bit)

    def disable_voltage(self) -> None:
        """Switch the power off, whatever is going on; a fault stays one."""
        if self.state in _POWERED:
            self._enter(State.SWITCH_ON_DISABLED)

    def quick_stop(self) -> None:
        """Stop out of operation; out of the states below it, switch the power off."""
        if self.state is State.OPERATION_ENABLED and self._quick_stop_option.value:
            self._enter(State.QUICK_STOP)
        elif self.state is not State.QUICK_STOP:
            self.disable_voltage()

    def fail(self) -> None:
        """Go to fault, by the fault reaction."""
        if self.state in (State.FAULT, State.FAULT_REACTION):
            return
        self._enter(State.FAULT_REACTION)
        if not self._fault_option.value:
            self._enter(State.FAULT)

    def tick(self, now_s: float) -> None:
        """End what takes its time."""
        if self.state not in (State.QUICK_STOP, State.FAULT_REACTION):
            return
        if self._ramp_since_s is None:
            self._ramp_since_s = now_s
        if now_s - self._ramp_since_s < RAMP_S:
            return
        if self.state is State.FAULT_REACTION:
            self._enter(State.FAULT)
        elif self._quick_stop_option.value < _STAY_IN_QUICK_STOP:
            self._enter(State.SWITCH_ON_DISABLED)

    def _shut_down(self, reset_bit: int) -> None:
        if self.state is State.SWITCH_ON_DISABLED:
            if not reset_bit and self._may_switch_on():
                self._enter(State.READY)
        elif self.state in (State.SWITCHED_ON, State.OPERATION_ENABLED):
            self._enter(State.READY)

    def _switch_on(self, word: int, reset_bit: int) -> None:
        """Switch on, enable operation or disable it; upwards only while bit 7 is 0."""
        enable = word & _ENABLE_OPERATION
        if self.state is State.OPERATION_ENABLED and not enable:
            self._enter(State.SWITCHED_ON)
        if reset_bit:
            return
        if self.state is State.READY:
            self._enter(State.SWITCHED_ON)
        stopped = (
            self.state is State.QUICK_STOP and self._quick_stop_option.value >= _STAY_IN_QUICK_STOP
        )
        if enable and (self.state is State.SWITCHED_ON or stopped) and self._may_enable():
            self._enter(State.OPERATION_ENABLED)

    def _enter(self, state: State) -> None:
        left, self.state = self.state, state
        self._ramp_since_s = None
        if left is not state:
            self._entered(left)
