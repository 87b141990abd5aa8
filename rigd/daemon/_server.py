"""Server on the daemon's socket: lines in, lines out, for many clients, slow and rude ones too.

Nothing that a client does may cost the supervisor of a running session more than a moment: lines
are short, taken one at a time, and at a bounded pace; what a client does not read is kept up to a
limit, beyond which it is dropped. A connection counts as a client once it has said a whole line,
and a `stop` is always obeyed, with any number of clients.
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
from rigd.daemon._states import Document, Peer, look_up_user
from rigd.daemon.address import peer_of

MOST_CLIENTS = 32
MOST_WATCHERS = 24
"""So that there is room for those who ask and go."""
MOST_SILENT = 64
"""Connections that have not said a whole line yet."""
_BACKLOG = 128
_ACCEPTS_AT_ONCE = 64
_ACCEPT_PAUSE_S = 0.001
"""Pause after that many at once: a crowd that keeps connecting leaves time for the rest."""
_PACE_S = 0.005
"""Least time between two requests of a client."""
_MOST_UNREAD = 262_144
_MOST_WAITING_LINES = 64
_FAREWELL_S = 1.0

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
        self._clients: set[_ClientConnection] = set()
        self._leaving: set[_ClientConnection] = set()
        self._silent: dict[socket.socket, _PendingConnection] = {}
        """Silent connections, in the order in which they came."""
        self._answering: set[asyncio.Task[None]] = set()
        self._looked_up: set[int] = set()
        self._count = 0
        self._closed = False
        self._spare: int | None = None
        self._hold_a_spare()

    def serve(self, service: Service) -> None:
        """Accept clients from now on, from the running event loop."""
        self._service = service
        self._listener.listen(_BACKLOG)
        self._accept_again()

    def publish(self, event: Document) -> None:
        """Send an event to all who watch."""
        watching = [client for client in self._clients if client.wants(event)]
        data = _line(event) if watching else b""
        for client in watching:
            client.write(data)

    async def close(self) -> None:
        """Send what is still to be sent, and let everybody go."""
        self._closed = True
        asyncio.get_running_loop().remove_reader(self._listener)
        self._listener.close()
        for silent in list(self._silent.values()):
            self._part_from(silent)
            silent.link.close()
        for client in list(self._clients):
            self._dismiss(client)
        while self._leaving:  # which takes no longer than `_FAREWELL_S`
            await asyncio.sleep(0.01)
        self._give_the_spare()

    def forget(self, client: "_ClientConnection") -> None:
        """Take note that a client is gone."""
        self._clients.discard(client)
        self._leaving.discard(client)

    def _dismiss(self, client: "_ClientConnection") -> None:
        self._clients.discard(client)
        self._leaving.add(client)
        client.leave()

    def may_watch(self) -> bool:
        """Whether there is room for one more who watches."""
        return sum(client.watching for client in self._clients) < MOST_WATCHERS

    # Connections that have not said anything yet

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
                self._turn_away()
                break
            self._welcome(link)
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._listener)
        loop.call_later(_ACCEPT_PAUSE_S, self._accept_again)

    def _welcome(self, link: socket.socket) -> None:
        """Take a new connection, and at once what it has said: most have, or are gone again."""
        try:
            silent = self._introduced(link)
        except OSError:
            link.close()
        else:
            self._hear(silent)

    def _introduced(self, link: socket.socket) -> "_PendingConnection":
        link.setblocking(False)
        pid, uid = peer_of(link)
        self._count += 1
        return _PendingConnection(link, Peer(self._count, pid, uid))

    def _hear(self, silent: "_PendingConnection") -> None:
        """Take what a connection says; once it is a line, it is a client's."""
        try:
            data = silent.link.recv(LONGEST_LINE)
        except BlockingIOError:
            self._wait_for(silent)
            return
        except OSError:
            data = b""
        silent.said += data
        if data and b"\n" not in silent.said and len(silent.said) < LONGEST_LINE:
            self._wait_for(silent)
            return
        self._part_from(silent)
        if data:
            self._admit(silent)
        else:
            silent.link.close()

    def _wait_for(self, silent: "_PendingConnection") -> None:
        """Wait until it says more; if too many are silent, one of them is let go."""
        if silent.link in self._silent:
            return
        if len(self._silent) >= MOST_SILENT:
            self._let_a_silent_one_go()
        self._silent[silent.link] = silent
        asyncio.get_running_loop().add_reader(silent.link, self._hear, silent)

    def _let_a_silent_one_go(self) -> bool:
        """Let go the oldest connection of the process that has most of them.

        One that has just connected, and whose line is on its way, is never pushed out by the
        crowd of another process.
        """
        if not self._silent:
            return False
        (pid, _), *_ = Counter(silent.peer.pid for silent in self._silent.values()).most_common(1)
        oldest = next(silent for silent in self._silent.values() if silent.peer.pid == pid)
        self._part_from(oldest)
        _say_full(oldest.link)
        return True

    def _part_from(self, silent: "_PendingConnection") -> None:
        if self._silent.pop(silent.link, None) is not None:
            asyncio.get_running_loop().remove_reader(silent.link)

    # Clients

    def _admit(self, silent: "_PendingConnection") -> None:
        """Make a client of a connection that has said its first line."""
        assert self._service is not None
        if len(self._clients) >= MOST_CLIENTS and not self._make_room():
            self._answer_if_stop(silent)
            return
        uid = silent.peer.uid
        if uid not in self._looked_up:
            self._looked_up.add(uid)
            # Not waited for: the user data base may be on a network.
            threading.Thread(target=look_up_user, args=(uid,), daemon=True).start()
        client = _ClientConnection(self, self._service, silent.peer, bytes(silent.said))
        self._clients.add(client)
        client.connecting = asyncio.create_task(_connect(silent.link, client))

    def _make_room(self) -> bool:
        """Let a client go that only sits there, if any: of the process that has most of them."""
        idle = [client for client in self._clients if client.only_sits_there]
        if not idle:
            return False
        count = Counter(client.pid for client in idle)
        longest = min(idle, key=lambda client: (-count[client.pid], client.heard_s))
        longest.write(_FULL)
        self._dismiss(longest)
        return True

    def _answer_if_stop(self, silent: "_PendingConnection") -> None:
        """Obey a `stop` from a client for which there is no room, and turn it away."""
        line = bytes(silent.said).partition(b"\n")[0]
        with suppress(RequestError):
            request = parse_request(line)
            if isinstance(request, StopSessionRequest):
                task = asyncio.create_task(self._obey_and_part(request, silent))
                self._answering.add(task)
                task.add_done_callback(self._answering.discard)
                return
        _say_full(silent.link)

    async def _obey_and_part(
        self, request: StopSessionRequest, silent: "_PendingConnection"
    ) -> None:
        assert self._service is not None
        _say(silent.link, _line(await _reply(self._service, request, silent.peer)))

    def _turn_away(self) -> None:
        """Take a client off the queue although there is no descriptor for it."""
        if self._let_a_silent_one_go():
            return  # its descriptor is free now
        if self._spare is None:
            self._hold_a_spare()
        self._give_the_spare()
        with suppress(OSError):
            link, _ = self._listener.accept()
            silent = self._introduced(link)
            with suppress(BlockingIOError):
                silent.said += link.recv(LONGEST_LINE)
            self._answer_if_stop(silent)
        self._hold_a_spare()

    def _hold_a_spare(self) -> None:
        """Keep a descriptor with which somebody can be accepted when there are no others left."""
        with suppress(OSError):
            self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def _give_the_spare(self) -> None:
        spare, self._spare = self._spare, None
        if spare is not None:
            os.close(spare)


@dataclass(slots=True)
class _PendingConnection:
    """A connection that has not said a whole line yet."""

    link: socket.socket
    peer: Peer
    said: bytearray = field(default_factory=bytearray)


class _ClientConnection(asyncio.Protocol):
    """One connection."""

    def __init__(self, server: Server, service: Service, peer: Peer, said: bytes) -> None:
        self._server = server
        self._service = service
        self._peer = peer
        self._said = said
        """Bytes received before it became a client."""
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
        self.heard_s = time.monotonic()

    @property
    def only_sits_there(self) -> bool:
        """It neither watches nor controls nor waits for an answer."""
        return not (
            self._said
            or self.watching
            or self._tasks
            or self._lines
            or self._service.controller == self._peer
        )

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._peer.pid

    def wants(self, event: Document) -> bool:
        """Whether it is to be told of an event."""
        return self.watching and (self._wants_signals or event["event"] != "signals")

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        self._transport = cast("asyncio.Transport", transport)
        # Beyond, the client is dropped; pausing the writer would be of no use here.
        self._transport.set_write_buffer_limits(high=_MOST_UNREAD)
        if self._leaving:  # there was no time to begin
            self.drop()
            return
        said, self._said = self._said, b""
        self.data_received(said)

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
    """Have a request obeyed, and return what is said of it."""
    try:
        told = await service.handle(request, peer)
    except CommandError as error:
        return _refusal(request.id, str(error), command=request.command, wrong_use=error.wrong_use)
    except Exception as error:
        _log.exception("unexpected error in a request")
        text = f"Unexpected error in the daemon ({error!r}); its log says more."
        return _refusal(request.id, text, command=request.command, wrong_use=False)
    told = {"reply": request.command, "ok": True, **told}
    return told if request.id is None else told | {"id": request.id}


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
    told = {"reply": command, "ok": False, "error": text, "wrong_use": wrong_use}
    return told if request_id is None else told | {"id": request_id}


_FULL = _line(
    _refusal(None, "There are too many clients; try again later.", wrong_use=False)
    | {"crowded": True}
)


def _say(link: socket.socket, line: bytes) -> None:
    """Send a last line without waiting for a reader."""
    with link, suppress(OSError):
        link.send(line)


def _say_full(link: socket.socket) -> None:
    """Turn a connection away."""
    _say(link, _FULL)
