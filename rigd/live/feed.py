"""The way from the publisher to the viewers, which never blocks and heals by itself.

With its server absent or frozen the SDK first buffers without telling, and then blocks for ever.
Therefore every block is flushed with a time limit, and nothing more is handed to the SDK until
everything before it has left: what waits in the SDK is never more than one block.
"""

import contextlib
import threading
import time
import uuid
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from rigd.live.server import Ports, Server, ServerError
from rigd.view import APPLICATION_ID, blueprint, send_samples

if TYPE_CHECKING:
    from rerun import RecordingStream

_START_S = 8.0
_RESTART_S = 1.0
_FLUSH_S = 0.2


class Feed:
    """A Rerun server and the stream of samples into it, each replaced when it fails.

    Parameters
    ----------
    name
        Of the recording.

    Raises
    ------
    ServerError
        If the server does not start.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._recording_id = uuid.uuid4()
        self._stream: RecordingStream | None = None
        self._stalled = False
        self._started = time.monotonic()
        self._server = Server(Ports())
        import rerun  # noqa: F401 - half a second, spent while the server starts

        while (ports := self._server.ports) is None:
            if not self._server.running:
                raise ServerError(f"The Rerun server ended: {self._server.last_words}.")
            if time.monotonic() - self._started > _START_S:
                self._server.kill()
                raise ServerError(f"The Rerun server does not answer: {self._server.last_words}.")
            time.sleep(0.01)
        self._ports = ports
        self._connect()

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return self._ports.viewer_url

    def offer(self, samples: npt.NDArray[Any]) -> bool:
        """Send samples (n,) unless they would have to wait; say whether they were sent."""
        if not self._server.running:
            self._restart()
        if self._stream is None and self._server.ports is not None:
            self._connect()
        if self._stalled:
            self._flush()
        if self._stream is None or self._stalled:
            return False
        send_samples(self._stream, samples)
        # If that stalls they wait in the SDK, and are sent when the server goes on.
        self._flush()
        return self._stream is not None

    def close(self) -> None:
        """End the server; the stream is left to the end of the process.

        Closing a stream whose server does not answer takes seconds or for ever.
        """
        self._server.kill()

    def _flush(self) -> None:
        """Wait a moment for the SDK to have sent everything; notice if it stalls or is cut off."""
        if self._stream is None:
            return
        try:
            self._stream.flush(timeout_sec=_FLUSH_S)
        except RuntimeError as error:
            if "timed out" in str(error):
                self._stalled = True
            else:
                # The connection is broken, and a stream never connects a second time.
                self._discard()
        else:
            self._stalled = False

    def _discard(self) -> None:
        # Up to 10 s in which it tries to reach its server once more; not for us to wait.
        if self._stream is not None:
            threading.Thread(target=self._stream.disconnect, daemon=True).start()
        self._stream = None
        self._stalled = False

    def _restart(self) -> None:
        self._discard()
        if time.monotonic() - self._started > _RESTART_S:
            self._started = time.monotonic()
            with contextlib.suppress(ServerError):  # to be tried again
                self._server = Server(self._ports)

    def _connect(self) -> None:
        import rerun as rr

        stream = rr.RecordingStream(APPLICATION_ID, recording_id=self._recording_id)
        stream.connect_grpc(self._ports.proxy_url)
        stream.send_recording_name(self._name)
        stream.send_blueprint(blueprint())
        self._stream = stream
