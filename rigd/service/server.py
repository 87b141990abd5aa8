"""The daemon's socket: lines in, lines out, and clients that may be slow, rude, or a thousand.

Nothing that a client does may cost the supervisor of a running session more than a moment: lines
are short, taken one at a time, and at a bounded pace; what a client does not read is kept up to a
limit, beyond which it is dropped; and there is always room for one more who wants to stop the rig.
"""

import asyncio
import errno
import json
import logging
import os
import socket
import struct
import threading
import time
from collections import deque
from contextlib import suppress
from typing import cast

from rigd.service.documents import Document, Peer, look_up_user
from rigd.service.log import NAME
from rigd.service.messages import LONGEST_LINE, AnyRequest, Id, RequestError, parse_request
from rigd.service.service import CommandError, Service

MOST_CLIENTS = 32
MOST_WATCHERS = 24
"""So that there is room for those who ask and go."""
_BACKLOG = 64
_ACCEPTS_AT_ONCE = 16
_PACE_S = 0.005
"""From one request of a client to its next."""
_MOST_UNREAD = 262_144
_MOST_WAITING_LINES = 64
_FAREWELL_S = 1.0
_CREDENTIALS = struct.Struct("3i")

_log = logging.getLogger(NAME)


class Server:
    """Lets clients command a service.

    Parameters
    ----------
    listener
        A bound socket, not yet listening.
    """

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._service: Service | None = None
        self._clients: set[_Client] = set()
        self._leaving: set[_Client] = set()
        self._count = 0
        self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def serve(self, service: Service) -> None:
        """Accept clients from now on, from the running event loop."""
        self._service = service
        self._listener.listen(_BACKLOG)
        asyncio.get_running_loop().add_reader(self._listener, self._accept_some)

    def publish(self, event: Document) -> None:
        """Send an event to all who watch."""
        data = _line(event)
        for client in list(self._clients):
            if client.watching:
                client.write(data)

    async def close(self) -> None:
        """Send what is still to be sent, and let everybody go."""
        asyncio.get_running_loop().remove_reader(self._listener)
        self._listener.close()
        for client in list(self._clients):
            self._dismiss(client)
        while self._leaving:  # which takes no longer than `_FAREWELL_S`
            await asyncio.sleep(0.01)
        os.close(self._spare)

    def forget(self, client: "_Client") -> None:
        """Take note that a client is gone."""
        self._clients.discard(client)
        self._leaving.discard(client)

    def _dismiss(self, client: "_Client") -> None:
        self._clients.discard(client)
        self._leaving.add(client)
        client.leave()

    def may_watch(self) -> bool:
        """Whether there is room for one more who watches."""
        return sum(client.watching for client in self._clients) < MOST_WATCHERS

    def _accept_some(self) -> None:
        for _ in range(_ACCEPTS_AT_ONCE):
            try:
                link, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in (errno.EMFILE, errno.ENFILE):
                    self._turn_away()
                return
            self._welcome(link)

    def _welcome(self, link: socket.socket) -> None:
        if len(self._clients) >= MOST_CLIENTS and not self._make_room():
            _say_full(link)
            return
        link.setblocking(False)
        self._count += 1
        try:
            pid, uid, _ = _CREDENTIALS.unpack(
                link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
            )
        except OSError:
            link.close()
            return
        # Not waited for: the user data base may be on a network.
        threading.Thread(target=look_up_user, args=(uid,), daemon=True).start()
        assert self._service is not None
        client = _Client(self, self._service, Peer(self._count, pid, uid))
        self._clients.add(client)
        client.connecting = asyncio.create_task(_connect(link, client))

    def _make_room(self) -> bool:
        """Let the client go that has been silent for longest, if any only sits there."""
        idle = [client for client in self._clients if client.only_sits_there]
        if not idle:
            return False
        longest = min(idle, key=lambda client: client.heard_s)
        longest.write(_FULL)
        self._dismiss(longest)
        return True

    def _turn_away(self) -> None:
        """Take a client off the queue although there is no descriptor for it: the spare one is."""
        os.close(self._spare)
        with suppress(OSError):
            link, _ = self._listener.accept()
            _say_full(link)
        self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)


class _Client(asyncio.Protocol):
    """One connection."""

    def __init__(self, server: Server, service: Service, peer: Peer) -> None:
        self._server = server
        self._service = service
        self._peer = peer
        self._transport: asyncio.Transport | None = None
        self._pending = bytearray()
        self._lines: deque[bytes] = deque()
        self._pump: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._ended = False
        self._leaving = False
        self.connecting: asyncio.Task[None] | None = None
        self.watching = False
        self.heard_s = time.monotonic()

    @property
    def only_sits_there(self) -> bool:
        """It neither watches nor controls nor waits for an answer."""
        return not (
            self.watching or self._tasks or self._lines or self._service.controller == self._peer
        )

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        self._transport = cast("asyncio.Transport", transport)
        # Beyond, the client is dropped; pausing the writer would be of no use here.
        self._transport.set_write_buffer_limits(high=_MOST_UNREAD)
        if self._leaving:  # others came so quickly that there was no time to begin
            self.drop()

    def data_received(self, data: bytes) -> None:
        """Take bytes, in whatever pieces they come."""
        self._pending += data
        *lines, rest = self._pending.split(b"\n")
        self._pending = rest
        self._lines.extend(bytes(line) for line in lines)
        if len(rest) >= LONGEST_LINE or any(len(line) >= LONGEST_LINE for line in lines):
            self.write(_line(_refusal(None, f"A line has at most {LONGEST_LINE} bytes.")))
            self.leave()
        elif self._pump is None and self._lines:
            self._obey_next()
        if len(self._lines) > _MOST_WAITING_LINES and self._transport is not None:
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        """Answer what was asked, and let go: who is gone altogether looks no different."""
        self._ended = True
        self._leave_if_done()
        return True

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's
        """Forget it; whatever it started goes on."""
        if self._pump is not None:
            self._pump.cancel()
        self._lines.clear()
        self._transport = None
        self._service.release(self._peer)
        self._server.forget(self)

    def write(self, data: bytes) -> None:
        """Send, unless too much of what was sent before has not been read."""
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(data)
        if self._transport.get_write_buffer_size() > _MOST_UNREAD:
            self.drop()

    def leave(self) -> None:
        """Close once all is sent, or soon."""
        self._leaving = True
        self._lines.clear()
        if self._transport is not None and not self._transport.is_closing():
            self._transport.close()
            asyncio.get_running_loop().call_later(_FAREWELL_S, self.drop)

    def drop(self) -> None:
        """Close now."""
        if self._transport is not None:
            self._transport.abort()

    def _obey_next(self) -> None:
        """Take one request, and the next one a moment later."""
        self._pump = None
        if not self._lines:
            self._leave_if_done()
            return
        line = self._lines.popleft()
        self.heard_s = time.monotonic()
        self._obey(line)
        if self._transport is None or self._transport.is_closing():
            return
        self._pump = asyncio.get_running_loop().call_later(_PACE_S, self._obey_next)
        if not self._lines:
            self._transport.resume_reading()

    def _obey(self, line: bytes) -> None:
        try:
            request = parse_request(line)
        except RequestError as error:
            self.write(_line(_refusal(error.request_id, str(error))))
            return
        if request.command == "watch" and not self.watching:
            if not self._server.may_watch():
                text = f"There are {MOST_WATCHERS} who watch already; ask for status instead."
                self.write(_line(_refusal(request.id, text, command="watch", wrong_use=False)))
                return
            self.watching = True
        task = asyncio.create_task(self._answer(request))
        self._tasks.add(task)
        task.add_done_callback(self._answered)

    async def _answer(self, request: AnyRequest) -> None:
        try:
            told = await self._service.handle(request, self._peer)
        except CommandError as error:
            told = _refusal(
                request.id, str(error), command=request.command, wrong_use=error.wrong_use
            )
        except Exception as error:
            _log.exception("a request was not foreseen")
            text = f"The daemon failed in an unforeseen way ({error!r}); its log says more."
            told = _refusal(request.id, text, command=request.command, wrong_use=False)
        else:
            told = {"reply": request.command, "ok": True, **told}
            if request.id is not None:
                told["id"] = request.id
        self.write(_line(told))

    def _answered(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        self._leave_if_done()

    def _leave_if_done(self) -> None:
        if self._ended and not (self._tasks or self._lines):
            self.leave()


async def _connect(link: socket.socket, client: _Client) -> None:
    try:
        await asyncio.get_running_loop().connect_accepted_socket(lambda: client, link)
    except OSError:
        link.close()
        client.connection_lost(None)


def _line(document: Document) -> bytes:
    return json.dumps(document, allow_nan=False).encode() + b"\n"


def _refusal(
    request_id: Id | None, text: str, *, command: str | None = None, wrong_use: bool = True
) -> Document:
    told = {"reply": command, "ok": False, "error": text, "wrong_use": wrong_use}
    return told if request_id is None else told | {"id": request_id}


_FULL = _line(_refusal(None, "There are too many clients; try again later.", wrong_use=False))


def _say_full(link: socket.socket) -> None:
    """Refuse a client without waiting for it."""
    with link, suppress(OSError):
        link.setblocking(False)
        link.send(_FULL)
