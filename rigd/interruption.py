"""Ctrl-C as an exception, for the command lines: under a name of its own, and never lost."""

import signal
import sys
from types import FrameType
from typing import Final, NoReturn

_REPEAT_S: Final = 0.01


class Interruption(KeyboardInterrupt):
    """A signal that asks for the end; its number is the argument.

    `python -m` ends by the signal, whatever exit code it is asked for, once a plain
    `KeyboardInterrupt` has passed through an `exec` of text; what defines a named tuple or a
    dataclass is one.
    """


def raise_on(*numbers: int) -> None:
    """Have these signals raise an :class:`Interruption`, wherever the program is."""
    if hasattr(signal, "SIGALRM"):  # not on Windows
        sys.unraisablehook = _unraisable
    for number in numbers:
        signal.signal(number, interrupt)


def interrupt(number: int, _frame: FrameType | None) -> NoReturn:
    """Handle a signal as Ctrl-C."""
    raise Interruption(number)


def let_pass() -> None:
    """Ignore what has been handled so far: a user may press once more, and has been heard.

    Python gives each signal that is handled its default action back before it has cleaned up, and
    would end by it.
    """
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_IGN)


def _unraisable(dropped: "sys.UnraisableHookArgs") -> None:
    """Repeat a signal whose exception Python has dropped, as it does at the end of an object.

    Objects end anywhere; the locks of the import system, for one, have callbacks for it. What is
    raised in here would be dropped as well, so the signal comes again a little later, to whatever
    handles it by then.
    """
    lost = dropped.exc_value
    if not isinstance(lost, Interruption):
        sys.__unraisablehook__(dropped)
        return
    (number,) = lost.args
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
    signal.setitimer(signal.ITIMER_REAL, _REPEAT_S)
