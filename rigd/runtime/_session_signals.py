r"""Signals that request the end of a rig's session, and how its processes react (POSIX only).

Ctrl-C, Ctrl-\, Ctrl-Z and the closing of a terminal send a signal to all processes of the terminal,
and a service manager sends SIGTERM to all processes. The supervisor and the control process stop
their session safely at each of these signals (`StopRequest`), because a suspended control process
would leave its last torque on. The recorder and the live publisher ignore the signals
(`ignore_end_signals`), and are ended by the supervisor. The analyser, which runs on every system,
does not import this module.
"""

import contextlib
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

STOP_SIGNAL: Final = signal.SIGUSR1
"""Signal that requests a process to stop its sessions; a daemon continues to run without them.

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
    """Block, within this context, the signals that request an end.

    A process that is started in the context inherits the block. It unblocks the signals by
    :meth:`StopRequest.catch_signals` or :func:`ignore_end_signals` when it can handle them.
    """
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, _END_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def ignore_end_signals() -> None:
    """Make this process ignore the signals that request an end, such as SIGINT and SIGTERM."""
    for signal_number in _END_SIGNALS:
        signal.signal(signal_number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _END_SIGNALS)


class StopRequest:
    """Flag that is set when the operator requests a stop, by a signal or by a command.

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

    def catch_signals(self) -> None:
        """Make the signals that request an end set this flag, except ignored ones (nohup)."""
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
