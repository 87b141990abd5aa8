r"""Signals that ask for an end: what each process makes of them.

Ctrl-C, Ctrl-\, Ctrl-Z and the closing of a terminal reach every process in it; a service manager
sends SIGTERM to all at once. To the supervisor and to the control process each of them means: stop
safely. (A suspended control process would leave its last torque on.) The recorder and the live
publisher let them pass: they end when the supervisor has no more use for them.
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)


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
    """Let these signals pass."""
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

    def request(self) -> None:
        """Ask for a stop."""
        self.requested = True
        self.on_request()
