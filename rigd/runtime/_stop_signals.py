r"""Signals that request the end of a program or of its session, and how the processes react.

Ctrl-C, Ctrl-\, Ctrl-Z and the closing of a terminal send a signal to all processes of the terminal,
and a service manager sends SIGTERM to all processes. A command ends by an exception
(`raise_on_signals`). The supervisor and the control process stop their session safely at each of
these signals (`StopRequest`), because a suspended control process would leave its last torque on.
The recorder and the live publisher ignore the signals (`ignore`), and are ended by the supervisor.
"""

import contextlib
import ctypes
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


def raise_on_signals(*numbers: int) -> None:
    """Make the given signals raise an :class:`Interruption` in the main thread."""
    if hasattr(signal, "SIGALRM"):  # not on Windows
        sys.unraisablehook = _repeat_dropped_signal
    for signal_number in numbers:
        signal.signal(signal_number, interrupt)


def interrupt(signal_number: int, _frame: FrameType | None) -> NoReturn:
    """Raise an :class:`Interruption`; installed as a signal handler."""
    raise Interruption(signal_number)


def ignore_handled_signals() -> None:
    """Ignore all signals that have a handler, so that no Ctrl-C interrupts the final cleanup.

    Otherwise Python would restore the default action of these signals before its cleanup has ended,
    and a signal would end the process.
    """
    for signal_number in signal.valid_signals():
        if callable(signal.getsignal(signal_number)):
            signal.signal(signal_number, signal.SIG_IGN)


def _repeat_dropped_signal(dropped: "sys.UnraisableHookArgs") -> None:
    """Repeat a signal whose :class:`Interruption` Python dropped; installed as unraisable hook.

    Python drops an exception in the finalizer of an object, which may run anywhere. An exception
    raised here would be dropped, too. The signal is therefore sent again a little later.
    """
    interruption = dropped.exc_value
    if not isinstance(interruption, Interruption):
        sys.__unraisablehook__(dropped)
        return
    (signal_number,) = interruption.args
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal_number))
    signal.setitimer(signal.ITIMER_REAL, _SIGNAL_REPEAT_DELAY_S)


def signal_when_orphaned(signal_number: int) -> None:
    """Make the system send a signal to this process when its parent ends (Linux only).

    A suspended process is also continued.
    """
    with contextlib.suppress(AttributeError):  # other systems have no such call
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal_number)


# In the processes of a rig

STOP_SIGNAL: Final = signal.SIGUSR1
"""Signal that requests a process to stop its sessions, after which a daemon continues to run.

The process table shows how each process reacts to the signal, and thus whether it may run sessions.
The default action means that the process is starting, a handler that it may run a session, and an
ignored signal that it runs no more sessions.
"""

_END_SIGNALS = (
    *(signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP),
    STOP_SIGNAL,
)


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Block the signals that request an end in the context, for a process that is started there.

    The process inherits the block. It unblocks the signals by :meth:`StopRequest.catch` or
    :func:`ignore` when it can handle them.
    """
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, _END_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def ignore() -> None:
    """Make this process ignore the signals that request an end, such as SIGINT and SIGTERM."""
    for signal_number in _END_SIGNALS:
        signal.signal(signal_number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _END_SIGNALS)


class StopRequest:
    """Flag that states whether the operator has requested a stop, which signals can set.

    Attributes
    ----------
    requested
        Whether a stop was requested.
    on_request
        Function that is called at each request, by the signal handler if a signal requests it.
    """

    def __init__(self) -> None:
        self.requested = False
        self.on_request: Callable[[], None] = lambda: None

    def catch(self) -> None:
        """Make the signals that request an end set this flag, except for ignored ones (nohup)."""
        for signal_number in _END_SIGNALS:
            if signal.getsignal(signal_number) != signal.SIG_IGN:
                signal.signal(signal_number, lambda *_: self.request())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _END_SIGNALS)

    def ignore_stop_signal(self) -> None:
        """Ignore `STOP_SIGNAL`, so that the process table shows that no more sessions follow."""
        if callable(signal.getsignal(STOP_SIGNAL)):
            with contextlib.suppress(ValueError):  # not in the main thread
                signal.signal(STOP_SIGNAL, signal.SIG_IGN)

    def request(self) -> None:
        """Set the flag, and call `on_request`."""
        self.requested = True
        self.on_request()
