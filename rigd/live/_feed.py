"""Connection from the publisher to the Rerun server, which never blocks and restores itself.

If its server is absent or frozen, the SDK first buffers silently and then blocks indefinitely.
Therefore each batch of drawings is flushed with a time limit, and the next one is given to the SDK
only when the one before has left. The SDK never buffers more than one batch.
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
"""Timeout of a flush while the server stalls, so that the session is not delayed repeatedly."""
_MOST_STALLED_POLLS: Final = 200
"""Polls of a stalled server after which it is killed: 10 s at the publisher's 20 per second."""


class Feed:
    """Stream of successive sessions' recordings to the present server.

    Parameters
    ----------
    outlet
        Outlet with the server.

    Attributes
    ----------
    connections
        Number of connections so far, each of which began with the frame of the scene.
    stalled
        Whether the server does not accept the last drawings.
    """

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._recording_id = ""
        self._frame: Callable[[], Iterable[Drawing]] = tuple
        self._stream: RecordingStream | None = None
        self._server: int | None = None
        self._laid_out: int | None = None
        self._stalled_polls = 0
        self._breaking: list[threading.Thread] = []
        self.connections = 0
        self.stalled = False

    def begin(self, recording_id: str, frame: "Callable[[], Iterable[Drawing]]") -> None:
        """Start a new recording.

        Parameters
        ----------
        recording_id
            Identifier of the recording; viewers switch to a new one.
        frame
            Returns the first drawings of each connection.
        """
        self._recording_id, self._frame = recording_id, frame

    def ready(self) -> bool:
        """Connect if necessary; return whether drawings can be sent without waiting."""
        if not self._outlet.poll():
            self._discard()
            return False
        assert self._outlet.address is not None
        if self._server != self._outlet.address.server:
            self._discard()
        if self.stalled and not self._recovered():
            return False
        if self._stream is not None and self._stream.get_recording_id() != self._recording_id:
            self._close()
        if self._stream is None and self._recording_id and self._outlet.answers():
            self._connect()
        return self._stream is not None and not self.stalled

    def send(self, drawings: "Iterable[Drawing]") -> bool:
        """Send drawings; return whether the stream has accepted them.

        If the server stalls, they wait in the SDK until it recovers.
        """
        if self._stream is None:
            return False
        for draw in drawings:
            draw(self._stream)
        self._flush(_PATIENCE_S)
        return self._stream is not None

    def _recovered(self) -> bool:
        """Return whether a stalled server has recovered; kill it if it never does."""
        self._flush(_STALLED_PATIENCE_S)
        if self.stalled:
            self._stalled_polls += 1
            if self._stalled_polls > _MOST_STALLED_POLLS:
                self._outlet.kill_server()
        # If the connection broke instead, the state of the server is checked first.
        return self._stream is not None and not self.stalled

    def _flush(self, patience_s: float) -> None:
        """Flush the SDK with a timeout, and detect a stalled server or a broken connection."""
        assert self._stream is not None
        try:
            self._stream.flush(timeout_sec=patience_s)
        except RuntimeError as error:
            if "timed out" in str(error):
                self.stalled = True
            else:
                # The connection is broken, and a stream cannot connect again.
                self._discard()
        else:
            self.stalled = False
            self._stalled_polls = 0

    def _close(self) -> None:
        """Close a stream that has sent everything."""
        assert self._stream is not None
        # The clean-up of a stream waits for all others that are closing, and they for it.
        forget = not any(thread.is_alive() for thread in self._breaking)
        _in_background(_close_stream, [self._stream], forget)
        self._stream = None

    def _discard(self) -> None:
        """Close a stream whose server is gone or replaced."""
        if self._stream is not None:
            # In the background, because it tries to reach its server for up to 10 s.
            self._breaking = [thread for thread in self._breaking if thread.is_alive()]
            self._breaking.append(_in_background(_close_stream, [self._stream], False))
        self._stream = None
        self.stalled = False
        self._stalled_polls = 0

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
    """A stream to viewers that already have their layout.

    It preserves changes of the layout by the operator. (Each blueprint also costs the SDK 2 MB and
    two threads that it never releases.)
    """

    def __init__(self, stream: "RecordingStream") -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)

    def send_blueprint(self, *_: object, **__: object) -> None:
        """Do nothing, so that the layout is unchanged."""


def _in_background(function: Callable[..., None], *arguments: object) -> threading.Thread:
    thread = threading.Thread(target=function, args=arguments, daemon=True)
    thread.start()
    return thread


def _close_stream(streams: "list[RecordingStream]", forget: bool) -> None:
    """Close the only reference to a stream; `forget`: release its resources in the SDK."""
    from rerun_bindings import flush_and_cleanup_orphaned_recordings

    with contextlib.suppress(RuntimeError):
        streams.pop().disconnect()
        if forget:
            flush_and_cleanup_orphaned_recordings()
