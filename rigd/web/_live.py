"""Messages to the open pages, each of which has its own queue: a slow page delays no other."""

import asyncio
import json
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from typing import Any, Final

from aiohttp import WSMsgType, web

Document = dict[str, Any]

MAX_OPEN_PAGES: Final = 24
"""Largest number of open pages."""
_MAX_QUEUED_MESSAGES: Final = 200
"""Largest number of queued messages of a page, about 5 s of a session.

Beyond it the page's connection is closed."""
_MAX_MESSAGE_BYTES: Final = 1024
"""Largest size in bytes of a message from a page."""
_PING_PERIOD_S: Final = 10.0
"""Period in seconds of the WebSocket's pings."""
_STORED_LOG_LINES: Final = 200
"""Number of log lines that are stored for new pages."""


class OpenPage:
    """Connection to one open page, by a WebSocket ready for writing, with a queue of messages."""

    def __init__(
        self, web_socket: web.WebSocketResponse, transport: asyncio.Transport | None
    ) -> None:
        self._socket = web_socket
        self._transport = transport
        self._queue: deque[str] = deque()
        self._message_queued = asyncio.Event()

    def queue_message(self, message_text: str) -> None:
        """Queue a message to the page, or close its connection if the queue is full."""
        if len(self._queue) >= _MAX_QUEUED_MESSAGES:
            self.close_connection()
            return
        self._queue.append(message_text)
        self._message_queued.set()

    def close_connection(self) -> None:
        """Close the connection of the page at once."""
        self._queue.clear()
        if self._transport is not None:
            self._transport.abort()

    async def send_queued_messages(self) -> None:
        """Send the queued messages until cancelled or until the page has disconnected."""
        with suppress(ConnectionError, RuntimeError):
            while True:
                await self._message_queued.wait()
                self._message_queued.clear()
                while self._queue:
                    # In one message, because the cost of a message hardly depends on its size.
                    message_text = "\n".join(self._queue)
                    self._queue.clear()
                    await self._socket.send_str(message_text)

    async def stop_on_request(
        self, stop_requested: asyncio.Event, stop_session: Callable[[], Awaitable[Document]]
    ) -> None:
        """Stop the session at each event `stop_requested`, and send the page the result."""
        while True:
            await stop_requested.wait()
            stop_requested.clear()
            self.queue_message(_to_json({"type": "stop", **await stop_session()}))


class Pages:
    """Connections to all open pages, and the last log lines for new pages."""

    def __init__(self) -> None:
        self._pages: set[OpenPage] = set()
        self._events: deque[Document] = deque(maxlen=_STORED_LOG_LINES)

    def __len__(self) -> int:
        """Return the number of open pages."""
        return len(self._pages)

    def send(self, message_document: Document | None) -> None:
        """Send a message to all open pages; None is ignored."""
        if message_document is not None and self._pages:
            message_text = _to_json(message_document)
            for open_page in list(self._pages):
                open_page.queue_message(message_text)

    def log_message(self, level: str, log_text: str) -> None:
        """Send a line of the log to all open pages, and store it for pages that open later."""
        log_event = {"type": "event", "utc_ns": time.time_ns(), "level": level, "text": log_text}
        self._events.append(log_event)
        self.send(log_event)

    async def serve(
        self,
        request: web.Request,
        first_messages: Iterable[Document],
        stop_session: Callable[[], Awaitable[Document]],
    ) -> web.StreamResponse:
        """Send live messages to a new page until it is closed.

        `stop_session`, which stops the session, is called for each message ``stop`` of the page;
        its result is sent to the page.
        """
        if len(self._pages) >= MAX_OPEN_PAGES:
            raise web.HTTPServiceUnavailable(
                reason=f"There are {MAX_OPEN_PAGES} open pages already."
            )
        web_socket = web.WebSocketResponse(
            heartbeat=_PING_PERIOD_S, compress=False, max_msg_size=_MAX_MESSAGE_BYTES
        )
        await web_socket.prepare(request)
        open_page = OpenPage(web_socket, request.transport)
        for document in (*first_messages, *self._events):
            open_page.queue_message(_to_json(document))
        self._pages.add(open_page)
        stop_requested = asyncio.Event()
        page_tasks = [
            asyncio.create_task(open_page.send_queued_messages()),
            asyncio.create_task(open_page.stop_on_request(stop_requested, stop_session)),
        ]
        try:
            # Unlike a request, this does not wait for downloads of the browser. Any other message
            # ends the connection.
            while (
                first_message := await web_socket.receive()
            ).type is WSMsgType.TEXT and first_message.data == "stop":
                stop_requested.set()
        finally:
            self._pages.discard(open_page)
            for page_task in page_tasks:
                page_task.cancel()
            open_page.close_connection()
        return web_socket

    def close_all_connections(self) -> None:
        """Close the connections of all pages."""
        for open_page in list(self._pages):
            open_page.close_connection()


_to_json: Final = json.JSONEncoder(allow_nan=False, separators=(",", ":")).encode
"""Function that converts a document into compact JSON text."""
