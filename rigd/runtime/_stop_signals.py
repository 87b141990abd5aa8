r"""Signals that ask for an end, and what each process makes of them.

Ctrl-C, Ctrl-\, Ctrl-Z and the closing of a terminal reach every process in it; a service manager
sends SIGTERM to all at once. A command ends by an exception (`raise_on`). To the supervisor and to
the control process each of the signals means: stop safely (`StopRequest`); a suspended control
process would leave its last torque on. The recorder and the live publisher let them pass
(`ignore`): they end when the supervisor has no more use for them.
"""

import contextlib
import ctypes
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final, NoReturn

_REPEAT_S: Final = 0.01
_PR_SET_PDEATHSIG: Final = 1  # linux/prctl.h


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


def signal_when_orphaned(number: int) -> None:
    """Have the system send this process a signal when the one that started it ends.

    A process that is suspended gets it too, because nothing else would wake it.
    """
    with contextlib.suppress(AttributeError):  # Linux has it, others do without
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


# In the processes of a rig

STOP_SIGNAL: Final = signal.SIGUSR1
"""Asks the process that runs sessions for their end, and for nothing else: a daemon goes on.

The process table shows whether there can be any: by default they have not begun, a process that
handles the signal may run one, a process that ignores it runs none any more.
"""

_STOPPING = (
    *(signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP),
    STOP_SIGNAL,
)


@contextmanager
def held_back() -> Iterator[None]:
    """Delay these signals; a process started meanwhile goes on delaying them.

    It has them delivered by :meth:`StopRequest.catch` or :func:`ignore`, once it can handle them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore() -> None:
    """Ignore the signals that ask for an end."""
    for number in _STOPPING:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPPING)


class StopRequest:
    """Remembers that a stop was asked for.

    Attributes
    ----------
    requested
        Whether it was.
    on_request
        Called from the signal handler, each time.
    """

    def __init__(self) -> None:
        self.requested = False
        self.on_request: Callable[[], None] = lambda: None

    def catch(self) -> None:
        """Handle the signals from now on; one that was ignored before stays so (nohup)."""
        for number in _STOPPING:
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, lambda *_: self.request())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPPING)

    def sessions_are_over(self) -> None:
        """Show in the process table that this process runs no session any more."""
        if callable(signal.getsignal(STOP_SIGNAL)):
            with contextlib.suppress(ValueError):  # not in the main thread
                signal.signal(STOP_SIGNAL, signal.SIG_IGN)

    def request(self) -> None:
        """Ask for a stop."""
        self.requested = True
        self.on_request()
