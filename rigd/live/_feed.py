"""Connection from the publisher to the Rerun server, which never blocks and restores itself.

With its server absent or frozen the SDK first buffers without telling, then blocks indefinitely.
Therefore whatever is sent is flushed with a time limit, and nothing more is handed to the SDK until
everything before it has left: what waits in the SDK is never more than what was sent at once.
"""

import contextlib
import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Final

from rigd.live._server import Outlet
from rigd.view.plots import APPLICATION_ID

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.view import Drawing

_PATIENCE_S: Final = 0.2
_STALLED_PATIENCE_S: Final = 0.02
"""Once it stalls, the session must not be kept waiting again and again."""
_MOST_STALLED_LOOKS: Final = 200
"""Looks after which the server is killed: at 20 a second, as the publisher looks, 10 s."""


class Feed:
    """The recording of one session after the other, sent to the server there is.

    Parameters
    ----------
    outlet
        Outlet whose server passes it on.

    Attributes
    ----------
    connections
        Number of connections that began, each with the frame of what is shown.
    stalled
        The server does not take what was sent.
    """

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._recording_id = ""
        self._frame: Callable[[], Iterable[Drawing]] = tuple
        self._stream: RecordingStream | None = None
        self._server: int | None = None
        self._laid_out: int | None = None
        self._stalled_looks = 0
        self._breaking: list[threading.Thread] = []
        self.connections = 0
        self.stalled = False

    def begin(self, recording_id: str, frame: "Callable[[], Iterable[Drawing]]") -> None:
        """Send to a new recording from now on.

        Parameters
        ----------
        recording_id
            Viewers show the latest that comes with another one.
        frame
            Asked for what each new connection needs first.
        """
        self._recording_id, self._frame = recording_id, frame

    def ready(self) -> bool:
        """Connect if need be; say whether something can be sent without waiting."""
        if not self._outlet.attend():
            self._discard()
            return False
        assert self._outlet.address is not None
        if self._server != self._outlet.address.server:
            self._discard()
        if self.stalled and not self._goes_on():
            return False
        if self._stream is not None and self._stream.get_recording_id() != self._recording_id:
            self._close()
        if self._stream is None and self._recording_id and self._outlet.answers():
            self._connect()
        return self._stream is not None and not self.stalled

    def send(self, drawings: "Iterable[Drawing]") -> bool:
        """Send drawings, when ready; say whether they are on their way.

        If the server stalls they wait in the SDK, and are sent when it goes on.
        """
        if self._stream is None:
            return False
        for draw in drawings:
            draw(self._stream)
        self._flush(_PATIENCE_S)
        return self._stream is not None

    def _goes_on(self) -> bool:
        """Whether the server goes on after having stalled; one that never does is ended."""
        self._flush(_STALLED_PATIENCE_S)
        if self.stalled:
            self._stalled_looks += 1
            if self._stalled_looks > _MOST_STALLED_LOOKS:
                self._outlet.kill_server()
        # Where the connection broke instead, it is to be seen first what became of the server.
        return self._stream is not None and not self.stalled

    def _flush(self, patience_s: float) -> None:
        """Wait a moment for the SDK to have sent everything; notice if it stalls or is cut off."""
        assert self._stream is not None
        try:
            self._stream.flush(timeout_sec=patience_s)
        except RuntimeError as error:
            if "timed out" in str(error):
                self.stalled = True
            else:
                # The connection is broken, and a stream never connects a second time.
                self._discard()
        else:
            self.stalled = False
            self._stalled_looks = 0

    def _close(self) -> None:
        """End a stream that has sent everything."""
        assert self._stream is not None
        # Forgetting a stream waits for all that are being let go, and others wait for it.
        forget = not any(thread.is_alive() for thread in self._breaking)
        _in_background(_let_go, [self._stream], forget)
        self._stream = None

    def _discard(self) -> None:
        """Let go of a stream whose server is gone or another one."""
        if self._stream is not None:
            # For up to 10 s it tries to reach its server once more; not for us to wait.
            self._breaking = [thread for thread in self._breaking if thread.is_alive()]
            self._breaking.append(_in_background(_let_go, [self._stream], False))
        self._stream = None
        self.stalled = False
        self._stalled_looks = 0

    def _connect(self) -> None:
        import rerun as rr

        address = self._outlet.address
        assert address is not None
        self._stream = stream = rr.RecordingStream(APPLICATION_ID, recording_id=self._recording_id)
        stream.connect_grpc(address.proxy_url)
        self._server = address.server
        self.connections += 1
        laid_out = self._laid_out == self._server
        target: Any = _LaidOut(stream) if laid_out else stream
        for draw in self._frame():
            draw(target)
        self._flush(_PATIENCE_S)
        if self._stream is not None:
            self._laid_out = self._server


class _LaidOut:
    """A stream to viewers that have their layout already.

    What the operator has moved since stays where it was moved. (Each blueprint that is sent also
    costs the SDK 2 MB and two threads that it does not give back.)
    """

    def __init__(self, stream: "RecordingStream") -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)

    def send_blueprint(self, *_: object, **__: object) -> None:
        """Leave the layout as it is."""


def _in_background(function: Callable[..., None], *arguments: object) -> threading.Thread:
    thread = threading.Thread(target=function, args=arguments, daemon=True)
    thread.start()
    return thread


def _let_go(streams: "list[RecordingStream]", forget: bool) -> None:
    """End a stream to which nothing else refers; `forget`: have the SDK give back what it took."""
    from rerun_bindings import flush_and_cleanup_orphaned_recordings

    with contextlib.suppress(RuntimeError):
        streams.pop().disconnect()
        if forget:
            flush_and_cleanup_orphaned_recordings()
