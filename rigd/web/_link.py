"""Connection of the page's server to the daemon's control socket, which reconnects by itself."""

import asyncio
import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

Document = dict[str, Any]
_Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]

_STATUS_PERIOD_S: Final = 1.0
"""Interval in seconds of status requests while signals arrive."""
_STATUS_PERIOD_WITHOUT_SIGNALS_S: Final = 0.4
"""Interval in seconds of status requests while no signals arrive."""
_SILENCE_TIMEOUT_S: Final = 0.85
"""Seconds without a message after which the daemon is reported as silent."""
_MIN_CHECK_PERIOD_S: Final = 0.1
"""Shortest interval in seconds between checks for silence of the daemon."""
_RECONNECT_PAUSE_S: Final = 0.5
"""Pause in seconds before a lost connection is opened again."""
_CONNECT_TIMEOUT_S: Final = 5.0
"""Timeout in seconds for a new connection."""
_REPLY_TIMEOUT_S: Final = 90.0
"""Timeout in seconds for the daemon's reply to a request."""
_MAX_LINE_BYTES: Final = 1 << 20
"""Largest size of a message of the daemon in bytes."""
_MAX_CROWDED_ATTEMPTS: Final = 20
"""Number of attempts to connect while the daemon has too many clients."""
_CROWDED_PAUSE_S: Final = 0.1
"""Pause in seconds between attempts to connect while the daemon has too many clients."""


class DaemonError(Exception):
    """Raised if the daemon does not reply to a request; the message is for the operator."""


class BusyError(Exception):
    """Raised if a request is not sent because another one, or a stop, has precedence."""


class DaemonLink:
    """Receives the events of a daemon, and sends requests to it.

    `on_message` receives each event and each status reply, `on_connection_lost` the reason when no
    messages arrive any more.
    """

    def __init__(
        self,
        daemon_socket_path: Path,
        on_message: Callable[[Document], None],
        on_connection_lost: Callable[[str], None],
    ) -> None:
        self._path = daemon_socket_path
        self._on_message = on_message
        self._on_lost = on_connection_lost
        self._status_requested = asyncio.Event()
        self._control_connection: _Connection | None = None
        self._controlled_series: float = 0
        self._last_ended_series: float = 0
        """Number of the last series that has ended.

        It is infinite if the message of a series' end may have been lost."""
        self._request_lock = asyncio.Lock()
        self._stop_count = 0
        self._last_received_s = 0.0
        self._silent = False
        self._signals_received = False

    async def run(self) -> None:
        """Receive the daemon's events until cancelled."""
        while True:
            try:
                await self._receive_messages()
            except (OSError, ValueError, DaemonError, asyncio.IncompleteReadError) as error:
                self._register_end(math.inf)
                self._on_lost(str(error) if isinstance(error, DaemonError) else _NO_DAEMON_MESSAGE)
            await asyncio.sleep(_RECONNECT_PAUSE_S)

    def request_status(self) -> None:
        """Request the daemon's status at once instead of with the next poll, as it has changed."""
        self._status_requested.set()

    def register_stop(self) -> None:
        """Register that a stop was requested; requests that are not sent yet are cancelled."""
        self._stop_count += 1

    async def send_request(self, request: Document) -> Document:
        """Send a request to the daemon (docs/control_socket.md), and return its reply.

        The connection that started a series controls the rig, and remains open until the end of the
        series. Further requests that need control use the same connection. Raise `BusyError` if
        another request is pending, or a stop was requested before this request was sent, and
        `DaemonError` without a reply.
        """
        if request.get("command") == "predict":
            return await self._send_on_new_connection(request)
        # A start that waited here could be sent after a stop, and would then not be stopped.
        if self._request_lock.locked():
            raise BusyError("Another request is being answered; try again in a moment.")
        async with self._request_lock:
            control_connection = self._control_connection
            if control_connection is not None and (
                control_connection[0].at_eof() or control_connection[1].is_closing()
            ):
                self._release_control()
            try:
                if self._control_connection is None:
                    daemon_reply = await self._send_on_new_connection(request)
                else:
                    daemon_reply = await _send_and_receive(self._control_connection, request)
                if request.get("command") == "start" and daemon_reply.get("ok"):
                    self._controlled_series = daemon_reply["series"]
            except DaemonError:
                # Not sent again, because it may have been executed.
                self._release_control()
                raise
            finally:
                if self._controlled_series <= self._last_ended_series:
                    self._release_control()
            return daemon_reply

    async def _send_on_new_connection(self, request: Document) -> Document:
        """Send a request on a new connection, and return the reply.

        The request is repeated while the daemon has too many clients.
        """
        stop_count = self._stop_count
        for attempt_number in range(_MAX_CROWDED_ATTEMPTS):
            if attempt_number:
                await asyncio.sleep(_CROWDED_PAUSE_S)
            try:
                connection = await self._connect()
            except (OSError, TimeoutError):
                raise DaemonError(_NO_DAEMON_MESSAGE) from None
            try:
                if self._stop_count != stop_count and request.get("command") != "predict":
                    raise BusyError("It was stopped before it began.")
                daemon_reply = await _send_and_receive(connection, request)
                if request.get("command") == "start" and daemon_reply.get("ok"):
                    self._control_connection = connection
            finally:
                if self._control_connection is not connection:
                    connection[1].close()
            if not daemon_reply.get("crowded"):
                break
        return daemon_reply

    async def _connect(self) -> _Connection:
        """Open a connection to the daemon's socket."""
        opening_task = asyncio.open_unix_connection(self._path, limit=_MAX_LINE_BYTES)
        return await asyncio.wait_for(opening_task, _CONNECT_TIMEOUT_S)

    async def _receive_messages(self) -> None:
        """Receive the messages of one connection until it ends."""
        reader, writer = await self._connect()
        self._last_received_s, self._last_ended_series = (
            time.monotonic(),
            0,
        )  # a new daemon numbers its series from 0
        connection_tasks = [
            asyncio.create_task(self._poll_status(writer)),
            asyncio.create_task(self._report_silence()),
        ]
        try:
            writer.write(b'{"command": "watch", "signals": true}\n')
            while True:
                self._process_message(await reader.readline())
        finally:
            for connection_task in connection_tasks:
                connection_task.cancel()
            writer.close()

    def _process_message(self, json_line: bytes) -> None:
        """Decode a line that the daemon sent; pass it to `on_message` if an event or a status."""
        if not json_line:
            raise DaemonError(_NO_DAEMON_MESSAGE)
        self._last_received_s, self._silent = time.monotonic(), False
        message = json.loads(json_line)
        if message.get("reply") == "watch" and not message.get("ok"):
            raise DaemonError(str(message.get("error")))
        if message.get("event") == "signals":
            self._signals_received = True
        elif message.get("event") == "series":
            self._register_end(message["series"])
        if "event" in message or message.get("reply") == "status":
            self._on_message(message)

    async def _report_silence(self) -> None:
        """Report whenever the daemon sends no message in time; run until cancelled."""
        while True:
            remaining_s = self._last_received_s + _SILENCE_TIMEOUT_S - time.monotonic()
            if remaining_s <= 0.0 and not self._silent:
                self._silent = True
                self._on_lost(f"The daemon has sent nothing for {_SILENCE_TIMEOUT_S:g} s.")
            await asyncio.sleep(max(remaining_s, _MIN_CHECK_PERIOD_S))

    async def _poll_status(self, writer: asyncio.StreamWriter) -> None:
        """Request the daemon's status periodically; run until cancelled."""
        while True:
            writer.write(b'{"command": "status"}\n')
            self._status_requested.clear()
            # Without signals only the status shows that the daemon is alive.
            status_period_s = (
                _STATUS_PERIOD_S if self._signals_received else _STATUS_PERIOD_WITHOUT_SIGNALS_S
            )
            self._signals_received = False
            with suppress(TimeoutError):
                await asyncio.wait_for(self._status_requested.wait(), status_period_s)

    def _register_end(self, series_number: float) -> None:
        """Register the end of a series, and release the rig unless a request is pending."""
        self._last_ended_series = series_number
        if not self._request_lock.locked():
            self._release_control()

    def _release_control(self) -> None:
        """Close the connection that controls the rig, so that others can control it."""
        control_connection, self._control_connection = self._control_connection, None
        if control_connection is not None:
            control_connection[1].close()


async def _send_and_receive(connection: _Connection, request: Document) -> Document:
    """Send a request on a connection, and return its reply."""
    reader, writer = connection
    try:
        writer.write(json.dumps(request).encode() + b"\n")
        json_line = await asyncio.wait_for(reader.readline(), _REPLY_TIMEOUT_S)
        return dict(json.loads(json_line))
    except (OSError, ValueError, TimeoutError):
        raise DaemonError("The daemon gave no answer.") from None


_NO_DAEMON_MESSAGE: Final = (
    "The daemon is not running, or cannot be reached; start it with rigd serve."
)
"""Message for the operator if there is no connection to the daemon."""
