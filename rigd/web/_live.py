"""Messages to the open pages: each has its own queue, so that a slow page delays no other."""

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
"""Limit of a page's queue, about 5 s of a session; beyond it the page is dropped."""
_MOST_MESSAGE_BYTES: Final = 1024
_HEARTBEAT_S: Final = 10.0
_MOST_EVENTS: Final = 200


class OpenPage:
    """Connection to one open page.

    Parameters
    ----------
    socket
        WebSocket of the page, ready for writing.
    transport
        Transport of the connection.
    """

    def __init__(self, socket: web.WebSocketResponse, transport: asyncio.Transport | None) -> None:
        self._socket = socket
        self._transport = transport
        self._waiting: deque[str] = deque()
        self._woken = asyncio.Event()

    def put(self, text: str) -> None:
        """Queue a message; drop the page if its queue is full."""
        if len(self._waiting) >= _MOST_WAITING:
            self.drop()
            return
        self._waiting.append(text)
        self._woken.set()

    def drop(self) -> None:
        """Close the connection at once."""
        self._waiting.clear()
        if self._transport is not None:
            self._transport.abort()

    async def write(self) -> None:
        """Send the queued messages until cancelled or the page is gone."""
        with suppress(ConnectionError, RuntimeError):
            while True:
                await self._woken.wait()
                self._woken.clear()
                while self._waiting:
                    # In one message, because the cost of a message hardly depends on its size.
                    text = "\n".join(self._waiting)
                    self._waiting.clear()
                    await self._socket.send_str(text)

    async def stop_on_request(
        self, stop_requested: asyncio.Event, stop: Callable[[], Awaitable[Document]]
    ) -> None:
        """Execute each requested stop, one at a time, and send the result to the page."""
        while True:
            await stop_requested.wait()
            stop_requested.clear()
            self.put(_text({"type": "stop", **await stop()}))


class Pages:
    """All open pages, and the last log lines for new pages."""

    def __init__(self) -> None:
        self._pages: set[OpenPage] = set()
        self._events: deque[Document] = deque(maxlen=_MOST_EVENTS)

    def __len__(self) -> int:
        return len(self._pages)

    def send(self, document: Document | None) -> None:
        """Send a message to all pages; None is ignored."""
        if document is not None and self._pages:
            text = _text(document)
            for page in list(self._pages):
                page.put(text)

    def note(self, level: str, text: str) -> None:
        """Send a log line, and store it for pages that open later."""
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
            First messages for the page.
        stop
            Called for each message ``stop`` of the page, which gets the result as ``stop``.
        """
        if len(self._pages) >= MOST_PAGES:
            raise web.HTTPServiceUnavailable(reason=f"There are {MOST_PAGES} open pages already.")
        socket = web.WebSocketResponse(
            heartbeat=_HEARTBEAT_S, compress=False, max_msg_size=_MOST_MESSAGE_BYTES
        )
        await socket.prepare(request)
        page = OpenPage(socket, request.transport)
        for document in (*first, *self._events):
            page.put(_text(document))
        self._pages.add(page)
        stop_requested = asyncio.Event()
        tasks = [
            asyncio.create_task(page.write()),
            asyncio.create_task(page.stop_on_request(stop_requested, stop)),
        ]
        try:
            # Unlike a request, this does not wait for downloads of the browser. Any other message
            # ends the connection.
            while (
                message := await socket.receive()
            ).type is WSMsgType.TEXT and message.data == "stop":
                stop_requested.set()
        finally:
            self._pages.discard(page)
            for task in tasks:
                task.cancel()
            page.drop()
        return socket

    def drop_all(self) -> None:
        """Close the connections of all pages."""
        for page in list(self._pages):
            page.drop()


_text: Final = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode
