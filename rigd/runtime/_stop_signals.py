r"""Signals that request an end, and the reaction of each process.

Ctrl-C, Ctrl-\, Ctrl-Z and the closing of a terminal reach all its processes; a service manager
sends SIGTERM to all processes. A command ends by an exception (`raise_on`). For the supervisor and
the control process each of the signals means a safe stop (`StopRequest`); a suspended control
process would leave its last torque on. The recorder and the live publisher ignore them (`ignore`)
and are ended by the supervisor.
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
    """Signal that requests the end; its number is the argument.

    After a plain `KeyboardInterrupt` has passed through an `exec` of text, as in the definition of
    a named tuple or dataclass, `python -m` ends by the signal and ignores the exit code.
    """


def raise_on(*numbers: int) -> None:
    """Make these signals raise an :class:`Interruption`."""
    if hasattr(signal, "SIGALRM"):  # not on Windows
        sys.unraisablehook = _unraisable
    for number in numbers:
        signal.signal(number, interrupt)


def interrupt(number: int, _frame: FrameType | None) -> NoReturn:
    """Raise an :class:`Interruption` for a signal."""
    raise Interruption(number)


def ignore_handled_signals() -> None:
    """Ignore the signals handled so far, so that another Ctrl-C does not interrupt the cleanup.

    Otherwise Python restores the default action of handled signals before its cleanup has ended,
    and a signal would end the process.
    """
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_IGN)


def _unraisable(dropped: "sys.UnraisableHookArgs") -> None:
    """Repeat a signal whose exception Python dropped, as in the finalizer of an object.

    Finalizers run anywhere, for example in callbacks of the locks of the import system. An
    exception raised here would also be dropped, so the signal is sent again a little later.
    """
    lost = dropped.exc_value
    if not isinstance(lost, Interruption):
        sys.__unraisablehook__(dropped)
        return
    (number,) = lost.args
    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
    signal.setitimer(signal.ITIMER_REAL, _REPEAT_S)


def signal_when_orphaned(number: int) -> None:
    """Make the system send a signal to this process when its parent ends.

    A suspended process is also continued, because nothing else would wake it.
    """
    with contextlib.suppress(AttributeError):  # Linux has it, others do without
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


# In the processes of a rig

STOP_SIGNAL: Final = signal.SIGUSR1
"""Requests a stop of the sessions of a process; a daemon itself continues.

The process table shows whether there may be sessions: a process with the default action has not yet
begun, a process that handles the signal may run one, a process that ignores it has finished.
"""

_STOPPING = (
    *(signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP),
    STOP_SIGNAL,
)


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Block these signals; a process started in this context inherits the block.

    It unblocks them with :meth:`StopRequest.catch` or :func:`ignore` when it can handle them.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore() -> None:
    """Ignore the signals that request an end."""
    for number in _STOPPING:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPPING)


class StopRequest:
    """Stop request of the operator, set by signals.

    Attributes
    ----------
    requested
        Whether a stop was requested.
    on_request
        Called from the signal handler at each request.
    """

    def __init__(self) -> None:
        self.requested = False
        self.on_request: Callable[[], None] = lambda: None

    def catch(self) -> None:
        """Handle the signals from now on, except those that were ignored before (nohup)."""
        for number in _STOPPING:
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, lambda *_: self.request())
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPPING)

    def sessions_are_over(self) -> None:
        """Show in the process table that this process runs no more sessions."""
        if callable(signal.getsignal(STOP_SIGNAL)):
            with contextlib.suppress(ValueError):  # not in the main thread
                signal.signal(STOP_SIGNAL, signal.SIG_IGN)

    def request(self) -> None:
        """Request a stop."""
        self.requested = True
        self.on_request()
