"""The page's connection to the daemon: by the public control socket, made again when it is lost."""

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
"""Time from one question for the status to the next, where signals come meanwhile."""
_ALIVE_S: Final = 0.4
"""Likewise, where they do not."""
_SILENT_S: Final = 0.85
"""A daemon from which nothing is heard for so long is told of."""
_LOOK_S: Final = 0.1
_RETRY_S: Final = 0.5
_CONNECT_S: Final = 5.0
_ANSWER_S: Final = 90.0
_LONGEST_LINE: Final = 1 << 20
_CROWD_TRIES: Final = 20
_CROWD_PAUSE_S: Final = 0.1


class DaemonError(Exception):
    """The daemon cannot be asked; the message is for the operator."""


class BusyError(Exception):
    """A request was not sent; the message is for the operator."""


class DaemonLink:
    """Follows one daemon, and passes requests on.

    Parameters
    ----------
    path
        The daemon's socket.
    on_message
        Called with each event, and with each status reply.
    on_lost
        Called with the reason when the daemon is not heard any more.
    """

    def __init__(
        self, path: Path, on_message: Callable[[Document], None], on_lost: Callable[[str], None]
    ) -> None:
        self._path = path
        self._on_message = on_message
        self._on_lost = on_lost
        self._asking = asyncio.Event()
        self._held: _Connection | None = None
        self._held_series: float = 0
        self._ended: float = 0
        """The last series that has ended; infinite where its end may not have been heard."""
        self._commanding = asyncio.Lock()
        self._stops = 0
        self._heard_s = 0.0
        self._silent = False
        self._told_signals = False

    async def run(self) -> None:
        """Follow the daemon, until cancelled."""
        while True:
            try:
                await self._follow()
            except (OSError, ValueError, DaemonError, asyncio.IncompleteReadError) as error:
                self._note_end(math.inf)
                self._on_lost(str(error) if isinstance(error, DaemonError) else _GONE)
            await asyncio.sleep(_RETRY_S)

    def ask_for_status(self) -> None:
        """Have the status come soon: something has changed."""
        self._asking.set()

    def note_stop(self) -> None:
        """Take note of a stop: what has not been sent yet will not be."""
        self._stops += 1

    async def ask(self, request: Document) -> Document:
        """Pass a request on and return the reply.

        A session that was started keeps its connection until its series ends, and with it the
        control; further requests that need it take the same one.

        Parameters
        ----------
        request
            As docs/control_socket.md has it.

        Raises
        ------
        BusyError
            If another request is being answered, or a stop came before this one was sent.
        DaemonError
            If there is no reply.
        """
        if request.get("command") == "predict":
            return await self._ask_anew(request)
        # A start that waited here would begin after a stop, of which the daemon would know nothing.
        if self._commanding.locked():
            raise BusyError("Another request is being answered; try again in a moment.")
        async with self._commanding:
            held = self._held
            if held is not None and (held[0].at_eof() or held[1].is_closing()):
                self._let_go()
            try:
                if self._held is None:
                    reply = await self._ask_anew(request)
                else:
                    reply = await _exchange(self._held, request)
                if request.get("command") == "start" and reply.get("ok"):
                    self._held_series = reply["series"]
            except DaemonError:
                # Not sent again: it may have been obeyed.
                self._let_go()
                raise
            finally:
                if self._held_series <= self._ended:
                    self._let_go()
            return reply

    async def _ask_anew(self, request: Document) -> Document:
        """Ask over a new connection; a daemon that has too many clients is asked again."""
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
        """Read what one connection brings, to its end."""
        reader, writer = await self._connect()
        self._heard_s, self._ended = time.monotonic(), 0  # a new daemon counts from 0
        beside = [
            asyncio.create_task(self._keep_asking(writer)),
            asyncio.create_task(self._note_silence()),
        ]
        try:
            writer.write(b'{"command": "watch", "signals": true}\n')
            while True:
                self._take(await reader.readline())
        finally:
            for task in beside:
                task.cancel()
            writer.close()

    def _take(self, line: bytes) -> None:
        if not line:
            raise DaemonError(_GONE)
        self._heard_s, self._silent = time.monotonic(), False
        message = json.loads(line)
        if message.get("reply") == "watch" and not message.get("ok"):
            raise DaemonError(str(message.get("error")))
        if message.get("event") == "signals":
            self._told_signals = True
        elif message.get("event") == "series":
            self._note_end(message["series"])
        if "event" in message or message.get("reply") == "status":
            self._on_message(message)

    async def _note_silence(self) -> None:
        """Tell of a daemon from which nothing has come for a while."""
        while True:
            left_s = self._heard_s + _SILENT_S - time.monotonic()
            if left_s <= 0.0 and not self._silent:
                self._silent = True
                self._on_lost(f"The daemon has said nothing for {_SILENT_S:g} s.")
            await asyncio.sleep(max(left_s, _LOOK_S))

    async def _keep_asking(self, writer: asyncio.StreamWriter) -> None:
        while True:
            writer.write(b'{"command": "status"}\n')
            self._asking.clear()
            # Where no signals come, nothing else shows that the daemon is alive.
            pause_s = _STATUS_S if self._told_signals else _ALIVE_S
            self._told_signals = False
            with suppress(TimeoutError):
                await asyncio.wait_for(self._asking.wait(), pause_s)

    def _note_end(self, series: float) -> None:
        """Give control back after a series, but not under a request that is being answered."""
        self._ended = series
        if not self._commanding.locked():
            self._let_go()

    def _let_go(self) -> None:
        """Give control back."""
        held, self._held = self._held, None
        if held is not None:
            held[1].close()


async def _exchange(link: _Connection, request: Document) -> Document:
    """Send a request and wait for its reply."""
    reader, writer = link
    try:
        writer.write(json.dumps(request).encode() + b"\n")
        line = await asyncio.wait_for(reader.readline(), _ANSWER_S)
        return dict(json.loads(line))
    except (OSError, ValueError, TimeoutError):
        raise DaemonError("The daemon gave no answer.") from None


_GONE: Final = "The daemon is not running, or cannot be reached; start it with rigd serve."
