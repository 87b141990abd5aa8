"""Server of the daemon's socket, which exchanges lines with many, even slow or hostile, clients.

No client can delay the supervisor of a running session noticeably. Lines are short and are handled
one at a time at a bounded rate. Unread output is buffered up to a limit, beyond which the client is
dropped. A connection counts as a client after its first complete line. A `stop` is always obeyed,
with any number of clients.
"""

import asyncio
import errno
import json
import logging
import os
import socket
import threading
import time
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, cast

from rigd.daemon._log import NAME
from rigd.daemon._protocol import (
    LONGEST_LINE,
    AnyRequest,
    CommandError,
    Id,
    RequestError,
    StopSessionRequest,
    WatchRequest,
    parse_request,
)
from rigd.daemon._service import Service
from rigd.daemon._states import Document, Peer, resolve_user
from rigd.daemon.address import peer_of

MOST_CLIENTS = 32
MOST_WATCHERS = 24
"""Limit below `MOST_CLIENTS`, so that short requests always find room."""
MOST_SILENT = 64
"""Limit of the connections that have not sent a complete line yet."""
_BACKLOG = 128
_ACCEPTS_AT_ONCE = 64
_ACCEPT_PAUSE_S = 0.001
"""Pause after so many accepts, so that a flood of connections leaves time for other work."""
_PACE_S = 0.005
"""Least time between two requests of a client."""
_MOST_UNREAD = 262_144
_MOST_WAITING_LINES = 64
_FAREWELL_S = 1.0

_log = logging.getLogger(NAME)


class Server:
    """Server through which clients command a service.

    Parameters
    ----------
    listener
        A bound socket, not yet listening.
    """

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._service: Service | None = None
        self._clients: set[_ClientConnection] = set()
        self._leaving: set[_ClientConnection] = set()
        self._silent: dict[socket.socket, _PendingConnection] = {}
        """Connections without a complete line, oldest first."""
        self._answering: set[asyncio.Task[None]] = set()
        self._resolved_uids: set[int] = set()
        self._count = 0
        self._closed = False
        self._spare_fd: int | None = None
        self._reserve_fd()

    def serve(self, service: Service) -> None:
        """Start to accept clients in the running event loop."""
        self._service = service
        self._listener.listen(_BACKLOG)
        self._accept_again()

    def publish(self, event: Document) -> None:
        """Send an event to all clients that watch."""
        watching = [client for client in self._clients if client.wants(event)]
        data = _line(event) if watching else b""
        for client in watching:
            client.write(data)

    async def close(self) -> None:
        """Send the pending output and close all connections."""
        self._closed = True
        asyncio.get_running_loop().remove_reader(self._listener)
        self._listener.close()
        for silent in list(self._silent.values()):
            self._forget_pending(silent)
            silent.link.close()
        for client in list(self._clients):
            self._dismiss(client)
        while self._leaving:  # takes at most `_FAREWELL_S`
            await asyncio.sleep(0.01)
        self._release_fd()

    def forget(self, client: "_ClientConnection") -> None:
        """Remove a client that is gone."""
        self._clients.discard(client)
        self._leaving.discard(client)

    def _dismiss(self, client: "_ClientConnection") -> None:
        self._clients.discard(client)
        self._leaving.add(client)
        client.leave()

    def may_watch(self) -> bool:
        """Return whether another client may watch."""
        return sum(client.watching for client in self._clients) < MOST_WATCHERS

    # Connections without a complete line

    def _accept_again(self) -> None:
        if not self._closed:
            asyncio.get_running_loop().add_reader(self._listener, self._accept_some)

    def _accept_some(self) -> None:
        for _ in range(_ACCEPTS_AT_ONCE):
            try:
                link, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    return
                self._refuse_without_fd()
                break
            self._welcome(link)
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._listener)
        loop.call_later(_ACCEPT_PAUSE_S, self._accept_again)

    def _welcome(self, link: socket.socket) -> None:
        """Accept a new connection and read at once: most have sent their line already."""
        try:
            silent = self._introduced(link)
        except OSError:
            link.close()
        else:
            self._receive(silent)

    def _introduced(self, link: socket.socket) -> "_PendingConnection":
        link.setblocking(False)
        pid, uid = peer_of(link)
        self._count += 1
        return _PendingConnection(link, Peer(self._count, pid, uid))

    def _receive(self, silent: "_PendingConnection") -> None:
        """Read from a connection, and make it a client once its first line is complete."""
        try:
            data = silent.link.recv(LONGEST_LINE)
        except BlockingIOError:
            self._await_line(silent)
            return
        except OSError:
            data = b""
        silent.received += data
        if data and b"\n" not in silent.received and len(silent.received) < LONGEST_LINE:
            self._await_line(silent)
            return
        self._forget_pending(silent)
        if data:
            self._admit(silent)
        else:
            silent.link.close()

    def _await_line(self, silent: "_PendingConnection") -> None:
        """Wait for more data; if too many connections wait, drop one."""
        if silent.link in self._silent:
            return
        if len(self._silent) >= MOST_SILENT:
            self._drop_oldest_pending()
        self._silent[silent.link] = silent
        asyncio.get_running_loop().add_reader(silent.link, self._receive, silent)

    def _drop_oldest_pending(self) -> bool:
        """Drop the oldest waiting connection of the process that has most of them.

        Thus many connections of one process never displace a new connection of another.
        """
        if not self._silent:
            return False
        (pid, _), *_ = Counter(silent.peer.pid for silent in self._silent.values()).most_common(1)
        oldest = next(silent for silent in self._silent.values() if silent.peer.pid == pid)
        self._forget_pending(oldest)
        _send_full(oldest.link)
        return True

    def _forget_pending(self, silent: "_PendingConnection") -> None:
        if self._silent.pop(silent.link, None) is not None:
            asyncio.get_running_loop().remove_reader(silent.link)

    # Clients

    def _admit(self, silent: "_PendingConnection") -> None:
        """Make a connection that has sent its first line a client."""
        assert self._service is not None
        if len(self._clients) >= MOST_CLIENTS and not self._make_room():
            self._answer_if_stop(silent)
            return
        uid = silent.peer.uid
        if uid not in self._resolved_uids:
            self._resolved_uids.add(uid)
            # In a thread, because the user database may be on a network.
            threading.Thread(target=resolve_user, args=(uid,), daemon=True).start()
        client = _ClientConnection(self, self._service, silent.peer, bytes(silent.received))
        self._clients.add(client)
        client.connecting = asyncio.create_task(_connect(silent.link, client))

    def _make_room(self) -> bool:
        """Dismiss an idle client, of the process that has most of them; return whether one was."""
        idle = [client for client in self._clients if client.is_idle]
        if not idle:
            return False
        count = Counter(client.pid for client in idle)
        longest = min(idle, key=lambda client: (-count[client.pid], client.last_received_s))
        longest.write(_FULL)
        self._dismiss(longest)
        return True

    def _answer_if_stop(self, silent: "_PendingConnection") -> None:
        """Refuse a client for which there is no room, but obey its `stop`."""
        line = bytes(silent.received).partition(b"\n")[0]
        with suppress(RequestError):
            request = parse_request(line)
            if isinstance(request, StopSessionRequest):
                task = asyncio.create_task(self._stop_and_close(request, silent))
                self._answering.add(task)
                task.add_done_callback(self._answering.discard)
                return
        _send_full(silent.link)

    async def _stop_and_close(
        self, request: StopSessionRequest, silent: "_PendingConnection"
    ) -> None:
        assert self._service is not None
        _send_last(silent.link, _line(await _reply(self._service, request, silent.peer)))

    def _refuse_without_fd(self) -> None:
        """Accept and refuse a client although no descriptor is free."""
        if self._drop_oldest_pending():
            return  # its descriptor is free now
        if self._spare_fd is None:
            self._reserve_fd()
        self._release_fd()
        with suppress(OSError):
            link, _ = self._listener.accept()
            silent = self._introduced(link)
            with suppress(BlockingIOError):
                silent.received += link.recv(LONGEST_LINE)
            self._answer_if_stop(silent)
        self._reserve_fd()

    def _reserve_fd(self) -> None:
        """Reserve a descriptor, with which a client can be accepted when no other is free."""
        with suppress(OSError):
            self._spare_fd = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def _release_fd(self) -> None:
        spare, self._spare_fd = self._spare_fd, None
        if spare is not None:
            os.close(spare)


@dataclass(slots=True)
class _PendingConnection:
    """A connection that has not sent a complete line yet."""

    link: socket.socket
    peer: Peer
    received: bytearray = field(default_factory=bytearray)


class _ClientConnection(asyncio.Protocol):
    """Connection of one client."""

    def __init__(self, server: Server, service: Service, peer: Peer, received: bytes) -> None:
        self._server = server
        self._service = service
        self._peer = peer
        self._received = received
        """Bytes received before the connection became a client."""
        self._transport: asyncio.Transport | None = None
        self._pending = bytearray()
        self._lines: deque[bytes] = deque()
        self._pump: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._ended = False
        self._leaving = False
        self.connecting: asyncio.Task[None] | None = None
        self.watching = False
        self._wants_signals = False
        self.last_received_s = time.monotonic()

    @property
    def is_idle(self) -> bool:
        """Whether the client neither watches nor controls nor waits for a reply."""
        return not (
            self._received
            or self.watching
            or self._tasks
            or self._lines
            or self._service.controller == self._peer
        )

    @property
    def pid(self) -> int:
        """Process id of the client."""
        return self._peer.pid

    def wants(self, event: Document) -> bool:
        """Return whether the client subscribed to an event."""
        return self.watching and (self._wants_signals or event["event"] != "signals")

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Handle the lines received so far."""
        self._transport = cast("asyncio.Transport", transport)
        # Beyond this limit the client is dropped; pausing the writer would not help.
        self._transport.set_write_buffer_limits(high=_MOST_UNREAD)
        if self._leaving:  # it was dismissed before it began
            self.drop()
            return
        received, self._received = self._received, b""
        self.data_received(received)

    def data_received(self, data: bytes) -> None:
        """Handle received bytes, split at any position."""
        self._pending += data
        *lines, rest = self._pending.split(b"\n")
        self._pending = rest
        self._lines.extend(bytes(line) for line in lines)
        if len(rest) >= LONGEST_LINE or any(len(line) >= LONGEST_LINE for line in lines):
            self.write(_line(_refusal(None, f"A line has at most {LONGEST_LINE} bytes.")))
            self.leave()
        elif self._pump is None and self._lines:
            self._handle_next()
        if len(self._lines) > _MOST_WAITING_LINES and self._transport is not None:
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        """Answer the pending requests and close; a disconnected client is the same."""
        self._ended = True
        self._leave_if_done()
        return True

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's
        """Forget the client; its sessions continue."""
        if self._pump is not None:
            self._pump.cancel()
        self._lines.clear()
        self._transport = None
        self._service.release(self._peer)
        self._server.forget(self)

    def write(self, data: bytes) -> None:
        """Send data; drop the client if too much output is unread."""
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(data)
        if self._transport.get_write_buffer_size() > _MOST_UNREAD:
            self.drop()

    def leave(self) -> None:
        """Close once all output is sent, or after a short time."""
        self._leaving = True
        self._lines.clear()
        if self._transport is not None and not self._transport.is_closing():
            self._transport.close()
            asyncio.get_running_loop().call_later(_FAREWELL_S, self.drop)

    def drop(self) -> None:
        """Close the connection at once."""
        if self._transport is not None:
            self._transport.abort()

    def _handle_next(self) -> None:
        """Handle one request, and schedule the next one."""
        self._pump = None
        if not self._lines:
            self._leave_if_done()
            return
        line = self._lines.popleft()
        self.last_received_s = time.monotonic()
        self._handle(line)
        if self._transport is None or self._transport.is_closing():
            return
        self._pump = asyncio.get_running_loop().call_later(_PACE_S, self._handle_next)
        if not self._lines:
            self._transport.resume_reading()

    def _handle(self, line: bytes) -> None:
        try:
            request = parse_request(line)
        except RequestError as error:
            self.write(_line(_refusal(error.request_id, str(error))))
            return
        if request.command == "watch" and not self.watching:
            if not self._server.may_watch():
                text = f"{MOST_WATCHERS} clients are watching already; use status instead."
                self.write(_line(_refusal(request.id, text, command="watch", wrong_use=False)))
                return
            self.watching = True
        if isinstance(request, WatchRequest):
            self._wants_signals |= request.signals
        task = asyncio.create_task(self._answer(request))
        self._tasks.add(task)
        task.add_done_callback(self._answered)

    async def _answer(self, request: AnyRequest) -> None:
        self.write(_line(await _reply(self._service, request, self._peer)))

    def _answered(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        self._leave_if_done()

    def _leave_if_done(self) -> None:
        if self._ended and not (self._tasks or self._lines):
            self.leave()


async def _reply(service: Service, request: AnyRequest, peer: Peer) -> Document:
    """Execute a request and return the reply."""
    try:
        reply = await service.handle(request, peer)
    except CommandError as error:
        return _refusal(request.id, str(error), command=request.command, wrong_use=error.wrong_use)
    except Exception as error:
        _log.exception("unexpected error in a request")
        text = f"Unexpected error in the daemon ({error!r}); its log says more."
        return _refusal(request.id, text, command=request.command, wrong_use=False)
    reply = {"reply": request.command, "ok": True, **reply}
    return reply if request.id is None else reply | {"id": request.id}


async def _connect(link: socket.socket, client: _ClientConnection) -> None:
    try:
        await asyncio.get_running_loop().connect_accepted_socket(lambda: client, link)
    except OSError:
        link.close()
        client.connection_lost(None)


_text: Final = json.JSONEncoder(allow_nan=False).encode


def _line(document: Document) -> bytes:
    return _text(document).encode() + b"\n"


def _refusal(
    request_id: Id | None, text: str, *, command: str | None = None, wrong_use: bool = True
) -> Document:
    reply = {"reply": command, "ok": False, "error": text, "wrong_use": wrong_use}
    return reply if request_id is None else reply | {"id": request_id}


_FULL = _line(
    _refusal(None, "There are too many clients; try again later.", wrong_use=False)
    | {"crowded": True}
)


def _send_last(link: socket.socket, line: bytes) -> None:
    """Send a last line without waiting, and close."""
    with link, suppress(OSError):
        link.send(line)


def _send_full(link: socket.socket) -> None:
    """Refuse a connection because there are too many."""
    _send_last(link, _FULL)
