"""Messages to the pages that are open: each has a queue, so a slow one delays no other."""

import asyncio
import json
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from typing import Any, Final

from aiohttp import WSMsgType, web

Document = dict[str, Any]

MOST_PAGES: Final = 24
_MOST_WAITING: Final = 200
"""Messages for a page, some 5 s of a session; then it is dropped, and may come again."""
_MOST_SAID: Final = 1024
_HEARTBEAT_S: Final = 10.0
_MOST_EVENTS: Final = 200


class OpenPage:
    """One open page.

    Parameters
    ----------
    socket
        Its WebSocket, ready to be written to.
    transport
        Its connection.
    """

    def __init__(self, socket: web.WebSocketResponse, transport: asyncio.Transport | None) -> None:
        self._socket = socket
        self._transport = transport
        self._waiting: deque[str] = deque()
        self._woken = asyncio.Event()

    def put(self, text: str) -> None:
        """Have a message sent; a page that does not read is dropped."""
        if len(self._waiting) >= _MOST_WAITING:
            self.drop()
            return
        self._waiting.append(text)
        self._woken.set()

    def drop(self) -> None:
        """Close its connection now."""
        self._waiting.clear()
        if self._transport is not None:
            self._transport.abort()

    async def write(self) -> None:
        """Send what waits, until cancelled or the page is gone."""
        with suppress(ConnectionError, RuntimeError):
            while True:
                await self._woken.wait()
                self._woken.clear()
                while self._waiting:
                    # Together: each send costs more than what is sent.
                    text = "\n".join(self._waiting)
                    self._waiting.clear()
                    await self._socket.send_str(text)

    async def stop_when(
        self, asked: asyncio.Event, stop: Callable[[], Awaitable[Document]]
    ) -> None:
        """Stop each time that it is asked for, one at a time, and tell the page what came of it."""
        while True:
            await asked.wait()
            asked.clear()
            self.put(_text({"type": "stop", **await stop()}))


class Pages:
    """All open pages, and what one that is opened now has to know."""

    def __init__(self) -> None:
        self._pages: set[OpenPage] = set()
        self._events: deque[Document] = deque(maxlen=_MOST_EVENTS)

    def __len__(self) -> int:
        return len(self._pages)

    def send(self, document: Document | None) -> None:
        """Send a message to all of them; None: there is nothing to send."""
        if document is not None and self._pages:
            text = _text(document)
            for page in list(self._pages):
                page.put(text)

    def note(self, level: str, text: str) -> None:
        """Send a line of the log, and keep it for pages that are opened later."""
        event = {"type": "event", "utc_ns": time.time_ns(), "level": level, "text": text}
        self._events.append(event)
        self.send(event)

    async def follow(
        self,
        request: web.Request,
        first: Iterable[Document],
        stop: Callable[[], Awaitable[Document]],
    ) -> web.StreamResponse:
        """Serve a page until it is closed.

        Parameters
        ----------
        request
            Request for a WebSocket.
        first
            Messages that it gets at once.
        stop
            What its message ``stop`` has done; the result is sent to it as ``stop``.
        """
        if len(self._pages) >= MOST_PAGES:
            raise web.HTTPServiceUnavailable(reason=f"There are {MOST_PAGES} open pages already.")
        socket = web.WebSocketResponse(
            heartbeat=_HEARTBEAT_S, compress=False, max_msg_size=_MOST_SAID
        )
        await socket.prepare(request)
        page = OpenPage(socket, request.transport)
        for document in (*first, *self._events):
            page.put(_text(document))
        self._pages.add(page)
        asked = asyncio.Event()
        beside = [
            asyncio.create_task(page.write()),
            asyncio.create_task(page.stop_when(asked, stop)),
        ]
        try:
            # A browser's requests may wait behind its downloads; this does not. Whatever else
            # comes is the end.
            while (said := await socket.receive()).type is WSMsgType.TEXT and said.data == "stop":
                asked.set()
        finally:
            self._pages.discard(page)
            for task in beside:
                task.cancel()
            page.drop()
        return socket

    def drop_all(self) -> None:
        """Close all connections."""
        for page in list(self._pages):
            page.drop()


_text: Final = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode
