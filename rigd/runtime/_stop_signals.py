"""Signals that request the end of a command: they raise an exception in it, on every system."""

import contextlib
import ctypes
import signal
import sys
from types import FrameType
from typing import Final, NoReturn

_SIGNAL_REPEAT_DELAY_S: Final = 0.01
"""Delay in seconds after which a signal is repeated whose exception was dropped."""
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h


class Interruption(KeyboardInterrupt):
    """Raised by a signal that requests the program's end; the argument is the signal's number.

    It differs from `KeyboardInterrupt` because of a peculiarity of Python: if a plain
    `KeyboardInterrupt` passes through an `exec` of text, as in the definition of a named tuple or
    dataclass, `python -m` ends by the signal and ignores the exit code.
    """


def raise_on_signals(*signal_numbers: int) -> None:
    """Make the given signals raise an :class:`Interruption` in the main thread."""
    if hasattr(signal, "SIGALRM"):  # not on Windows
        sys.unraisablehook = _repeat_dropped_signal
    for signal_number in signal_numbers:
        signal.signal(signal_number, interrupt)


def interrupt(signal_number: int, _frame: FrameType | None) -> NoReturn:
    """Raise an :class:`Interruption`; installed as a signal handler."""
    raise Interruption(signal_number)


def ignore_handled_signals() -> None:
    """Ignore all signals that have a handler, so that no Ctrl-C interrupts the final cleanup.

    Otherwise Python would restore the default action of these signals during its cleanup, and a
    signal would then end the process.
    """
    for signal_number in signal.valid_signals():
        if callable(signal.getsignal(signal_number)):
            signal.signal(signal_number, signal.SIG_IGN)


def _repeat_dropped_signal(dropped_exception: "sys.UnraisableHookArgs") -> None:
    """Repeat a signal whose :class:`Interruption` Python dropped; installed as unraisable hook.

    Python drops an exception that is raised while an object's finalizer runs, which may be at any
    time. An exception raised here would be dropped, too. The signal is therefore sent again a
    little later.
    """
    interruption = dropped_exception.exc_value
    if not isinstance(interruption, Interruption):
        sys.__unraisablehook__(dropped_exception)
        return
    (signal_number,) = interruption.args
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal_number))
    signal.setitimer(signal.ITIMER_REAL, _SIGNAL_REPEAT_DELAY_S)


def signal_when_orphaned(signal_number: int) -> None:
    """Make the system send a signal to this process when its parent ends (Linux only).

    If this process is then suspended, it is also continued.
    """
    with contextlib.suppress(AttributeError):  # other systems have no such call
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal_number)
