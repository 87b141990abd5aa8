"""Connection from the publisher to the Rerun server that never blocks and reconnects by itself.

If its server is absent or frozen, the SDK first buffers silently and then blocks indefinitely.
Therefore each batch of drawings is flushed with a timeout, and the next batch is passed to the SDK
only after the previous one has been sent. The SDK never buffers more than one batch.
"""

import contextlib
import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Final

from rigd.live._server import RerunServer
from rigd.view.plots import APPLICATION_ID

if TYPE_CHECKING:
    from rerun import RecordingStream

    from rigd.view import Drawing

_FLUSH_TIMEOUT_S: Final = 0.2
"""Timeout of a flush in seconds."""
_STALLED_FLUSH_TIMEOUT_S: Final = 0.02
"""Timeout in seconds of a flush while the server stalls.

It is short so that the view of the session is not delayed repeatedly."""
_MAX_STALLED_POLLS: Final = 200
"""Number of polls of a stalled server after which the server is killed.

It corresponds to 10 s at the publisher's 20 polls per second."""


class DrawingStream:
    """Sends the drawings of one session after another to the present Rerun server.

    A server that ends is replaced. `connections` counts the connections so far, each of which began
    with the drawings of `Scene.initial_drawings`; `stalled` states that the last drawings are not
    yet accepted.
    """

    def __init__(self, server_program: RerunServer) -> None:
        self._server_program = server_program
        self._recording_id = ""
        self._make_frame_drawings: Callable[[], Iterable[Drawing]] = tuple
        self._stream: RecordingStream | None = None
        self._server: int | None = None
        self._server_with_layout: int | None = None
        self._stalled_polls = 0
        self._closing_threads: list[threading.Thread] = []
        self.connections = 0
        self.stalled = False

    def begin(
        self, recording_id: str, make_frame_drawings: "Callable[[], Iterable[Drawing]]"
    ) -> None:
        """Start a new Rerun recording for a session; open viewers switch to it.

        `make_frame_drawings` returns the functions that draw first on each connection.
        """
        self._recording_id, self._make_frame_drawings = recording_id, make_frame_drawings

    def ready(self) -> bool:
        """Connect to the Rerun server if necessary, and return whether it accepts drawings now."""
        if not self._server_program.poll():
            self._discard_connection()
            return False
        assert self._server_program.address is not None
        if self._server != self._server_program.address.server:
            self._discard_connection()
        if self.stalled and not self._has_recovered():
            return False
        if self._stream is not None and self._stream.get_recording_id() != self._recording_id:
            self._close_connection()
        if (
            self._stream is None
            and self._recording_id
            and self._server_program.accepts_connections()
        ):
            self._connect_to_server()
        return self._stream is not None and not self.stalled

    def send(self, drawings: "Iterable[Drawing]") -> bool:
        """Send drawings to the server, and return whether the connection to it still exists.

        If the server stalls, the SDK buffers the drawings until it recovers.
        """
        if self._stream is None:
            return False
        for draw in drawings:
            draw(self._stream)
        self._flush_drawings(_FLUSH_TIMEOUT_S)
        return self._stream is not None

    def _has_recovered(self) -> bool:
        """Return whether a stalled server accepts drawings again; kill it if that takes long."""
        self._flush_drawings(_STALLED_FLUSH_TIMEOUT_S)
        if self.stalled:
            self._stalled_polls += 1
            if self._stalled_polls > _MAX_STALLED_POLLS:
                self._server_program.kill_server()
        # After a broken connection the next call first checks the state of the server.
        return self._stream is not None and not self.stalled

    def _flush_drawings(self, timeout_s: float) -> None:
        """Flush the SDK's buffer, and detect a stalled server or a broken connection."""
        assert self._stream is not None
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except RuntimeError as error:
            if "timed out" in str(error):
                self.stalled = True
            else:
                # The connection is broken, and a stream cannot connect again.
                self._discard_connection()
        else:
            self.stalled = False
            self._stalled_polls = 0

    def _close_connection(self) -> None:
        """Close the connection to the Rerun server after all drawings were sent."""
        assert self._stream is not None
        # The SDK's clean-up would wait for streams that are still closing, and they for it.
        releases_resources = not any(
            closing_thread.is_alive() for closing_thread in self._closing_threads
        )
        _start_thread(_close_stream, [self._stream], releases_resources)
        self._stream = None

    def _discard_connection(self) -> None:
        """Close the connection to a Rerun server that has ended or was replaced."""
        if self._stream is not None:
            # In the background, because the SDK tries to reach the server for up to 10 s.
            self._closing_threads = [
                closing_thread
                for closing_thread in self._closing_threads
                if closing_thread.is_alive()
            ]
            self._closing_threads.append(_start_thread(_close_stream, [self._stream], False))
        self._stream = None
        self.stalled = False
        self._stalled_polls = 0

    def _connect_to_server(self) -> None:
        """Connect to the present server, and send the first drawings of the session."""
        import rerun as rr

        server_address = self._server_program.address
        assert server_address is not None
        self._stream = rerun_stream = rr.RecordingStream(
            APPLICATION_ID, recording_id=self._recording_id
        )
        rerun_stream.connect_grpc(server_address.proxy_url)
        self._server = server_address.server
        self.connections += 1
        has_layout = self._server_with_layout == self._server
        drawing_target: Any = _StreamWithoutLayout(rerun_stream) if has_layout else rerun_stream
        for draw in self._make_frame_drawings():
            draw(drawing_target)
        self._flush_drawings(_FLUSH_TIMEOUT_S)
        if self._stream is not None:
            self._server_with_layout = self._server


class _StreamWithoutLayout:
    """Rerun stream that does not send the layout, for viewers that have it already.

    Changes of the layout by the operator are thus preserved. (Each layout that is sent also costs
    the SDK 2 MB and two threads, which it never releases.)
    """

    def __init__(self, stream: "RecordingStream") -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the stream has
        return getattr(self._stream, name)

    def send_blueprint(self, *_: object, **__: object) -> None:
        """Send nothing, so that the layout of the viewers does not change."""


def _start_thread(function: Callable[..., None], *arguments: object) -> threading.Thread:
    """Start a function in a daemon thread, and return the thread."""
    new_thread = threading.Thread(target=function, args=arguments, daemon=True)
    new_thread.start()
    return new_thread


def _close_stream(streams: "list[RecordingStream]", releases_resources: bool) -> None:
    """Disconnect the Rerun stream in a list of one, and remove it from the list.

    With `releases_resources` the SDK also releases the stream's resources.
    """
    from rerun_bindings import flush_and_cleanup_orphaned_recordings

    with contextlib.suppress(RuntimeError):
        streams.pop().disconnect()
        if releases_resources:
            flush_and_cleanup_orphaned_recordings()
