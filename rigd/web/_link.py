"""The page's connection to the daemon's control socket, restored when it is lost."""

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

_STATUS_S: Final = 1.0
"""Period of status requests while signals arrive."""
_ALIVE_S: Final = 0.4
"""Period of status requests while no signals arrive."""
_SILENT_S: Final = 0.85
"""Time without a message after which the daemon is reported as silent."""
_POLL_S: Final = 0.1
_RETRY_S: Final = 0.5
_CONNECT_S: Final = 5.0
_ANSWER_S: Final = 90.0
_LONGEST_LINE: Final = 1 << 20
_CROWD_TRIES: Final = 20
_CROWD_PAUSE_S: Final = 0.1


class DaemonError(Exception):
    """The daemon does not reply; the message is for the operator."""


class BusyError(Exception):
    """A request was not sent; the message is for the operator."""


class DaemonLink:
    """Connection to one daemon, which receives its events and passes requests on.

    Parameters
    ----------
    path
        The daemon's socket.
    on_message
        Called with each event, and with each status reply.
    on_lost
        Called with the reason when the daemon is no longer received.
    """

    def __init__(
        self, path: Path, on_message: Callable[[Document], None], on_lost: Callable[[str], None]
    ) -> None:
        self._path = path
        self._on_message = on_message
        self._on_lost = on_lost
        self._status_requested = asyncio.Event()
        self._held: _Connection | None = None
        self._held_series: float = 0
        self._ended: float = 0
        """Last series that has ended; infinite if the message of its end may have been lost."""
        self._commanding = asyncio.Lock()
        self._stops = 0
        self._last_received_s = 0.0
        self._silent = False
        self._signals_received = False

    async def run(self) -> None:
        """Receive the daemon's events until cancelled."""
        while True:
            try:
                await self._follow()
            except (OSError, ValueError, DaemonError, asyncio.IncompleteReadError) as error:
                self._register_end(math.inf)
                self._on_lost(str(error) if isinstance(error, DaemonError) else _GONE)
            await asyncio.sleep(_RETRY_S)

    def ask_for_status(self) -> None:
        """Request the status soon, because something has changed."""
        self._status_requested.set()

    def note_stop(self) -> None:
        """Register a stop, which cancels requests that are not sent yet."""
        self._stops += 1

    async def ask(self, request: Document) -> Document:
        """Send a request and return the reply.

        The connection that started a series stays open until its end, and with it the control.
        Further requests that need control use the same connection.

        Parameters
        ----------
        request
            Request of docs/control_socket.md.

        Raises
        ------
        BusyError
            If another request is pending, or a stop came before this one was sent.
        DaemonError
            If there is no reply.
        """
        if request.get("command") == "predict":
            return await self._ask_on_new_connection(request)
        # A start that waited here could begin after a stop, which the daemon would not notice.
        if self._commanding.locked():
            raise BusyError("Another request is being answered; try again in a moment.")
        async with self._commanding:
            held = self._held
            if held is not None and (held[0].at_eof() or held[1].is_closing()):
                self._release_control()
            try:
                if self._held is None:
                    reply = await self._ask_on_new_connection(request)
                else:
                    reply = await _exchange(self._held, request)
                if request.get("command") == "start" and reply.get("ok"):
                    self._held_series = reply["series"]
            except DaemonError:
                # Not sent again, because it may have been executed.
                self._release_control()
                raise
            finally:
                if self._held_series <= self._ended:
                    self._release_control()
            return reply

    async def _ask_on_new_connection(self, request: Document) -> Document:
        """Send a request on a new connection; repeat it while the daemon has too many clients."""
        stops = self._stops
        for attempt in range(_CROWD_TRIES):
            if attempt:
                await asyncio.sleep(_CROWD_PAUSE_S)
            try:
                link = await self._connect()
            except (OSError, TimeoutError):
                raise DaemonError(_GONE) from None
            try:
                if self._stops != stops and request.get("command") != "predict":
                    raise BusyError("It was stopped before it began.")
                reply = await _exchange(link, request)
                if request.get("command") == "start" and reply.get("ok"):
                    self._held = link
            finally:
                if self._held is not link:
                    link[1].close()
            if not reply.get("crowded"):
                break
        return reply

    async def _connect(self) -> _Connection:
        opening = asyncio.open_unix_connection(self._path, limit=_LONGEST_LINE)
        return await asyncio.wait_for(opening, _CONNECT_S)

    async def _follow(self) -> None:
        """Receive the messages of one connection until it ends."""
        reader, writer = await self._connect()
        self._last_received_s, self._ended = (
            time.monotonic(),
            0,
        )  # a new daemon numbers its series from 0
        tasks = [
            asyncio.create_task(self._poll_status(writer)),
            asyncio.create_task(self._report_silence()),
        ]
        try:
            writer.write(b'{"command": "watch", "signals": true}\n')
            while True:
                self._take(await reader.readline())
        finally:
            for task in tasks:
                task.cancel()
            writer.close()

    def _take(self, line: bytes) -> None:
        if not line:
            raise DaemonError(_GONE)
        self._last_received_s, self._silent = time.monotonic(), False
        message = json.loads(line)
        if message.get("reply") == "watch" and not message.get("ok"):
            raise DaemonError(str(message.get("error")))
        if message.get("event") == "signals":
            self._signals_received = True
        elif message.get("event") == "series":
            self._register_end(message["series"])
        if "event" in message or message.get("reply") == "status":
            self._on_message(message)

    async def _report_silence(self) -> None:
        """Report a daemon that has been silent for a while."""
        while True:
            left_s = self._last_received_s + _SILENT_S - time.monotonic()
            if left_s <= 0.0 and not self._silent:
                self._silent = True
                self._on_lost(f"The daemon has sent nothing for {_SILENT_S:g} s.")
            await asyncio.sleep(max(left_s, _POLL_S))

    async def _poll_status(self, writer: asyncio.StreamWriter) -> None:
        while True:
            writer.write(b'{"command": "status"}\n')
            self._status_requested.clear()
            # Without signals only the status shows that the daemon is alive.
            pause_s = _STATUS_S if self._signals_received else _ALIVE_S
            self._signals_received = False
            with suppress(TimeoutError):
                await asyncio.wait_for(self._status_requested.wait(), pause_s)

    def _register_end(self, series: float) -> None:
        """Release control after a series, unless a request is pending."""
        self._ended = series
        if not self._commanding.locked():
            self._release_control()

    def _release_control(self) -> None:
        """Release control, by closing its connection."""
        held, self._held = self._held, None
        if held is not None:
            held[1].close()


async def _exchange(link: _Connection, request: Document) -> Document:
    """Send a request and return its reply."""
    reader, writer = link
    try:
        writer.write(json.dumps(request).encode() + b"\n")
        line = await asyncio.wait_for(reader.readline(), _ANSWER_S)
        return dict(json.loads(line))
    except (OSError, ValueError, TimeoutError):
        raise DaemonError("The daemon gave no answer.") from None


_GONE: Final = "The daemon is not running, or cannot be reached; start it with rigd serve."
