"""Server of the daemon's socket, which serves many clients, even slow or hostile ones.

Clients send requests as lines of JSON, and get lines of JSON with replies and events.

No client can delay the supervisor of a running session noticeably. Lines are short, and are
processed one at a time at a limited rate. Unread output is buffered up to a limit, beyond which the
client is disconnected. A connection counts as a client after its first complete line. The request
`stop` is always executed, with any number of clients.
"""

import asyncio
import errno
import json
import logging
import os
import select
import socket
import threading
import time
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, cast

from rigd.daemon._log import LOGGER_NAME
from rigd.daemon._protocol import (
    MAX_LINE_BYTES,
    AnyRequest,
    CommandError,
    RequestError,
    RequestId,
    StopSessionRequest,
    WatchRequest,
    parse_request,
)
from rigd.daemon._service import SHUTTING_DOWN_MESSAGE, Service
from rigd.daemon._states import Document, Peer, resolve_user
from rigd.daemon.address import peer_pid_and_uid

MAX_CLIENTS = 32
"""Maximum number of clients."""
MAX_SUBSCRIBERS = 24
"""Maximum number of clients that subscribe to events. It is below `MAX_CLIENTS`, so that clients
with short requests can always connect."""
MAX_PENDING_CONNECTIONS = 64
"""Maximum number of connections that have not sent a complete line yet."""
_LISTEN_BACKLOG = 128
"""Maximum number of connections that wait to be accepted."""
_MAX_ACCEPTED_CONNECTIONS = 64
"""Number of connections that are accepted before a pause."""
_ACCEPT_PAUSE_S = 0.001
"""Pause in seconds after `_MAX_ACCEPTED_CONNECTIONS` connections, for other work."""
_MIN_REQUEST_INTERVAL_S = 0.005
"""Minimum time in seconds between two requests of a client."""
_MAX_UNREAD_BYTES = 262_144
"""Number of bytes of unread output beyond which a client is disconnected."""
_MAX_WAITING_LINES = 64
"""Number of unprocessed lines beyond which no more are read from a client."""
_GONE_CHECK_INTERVAL_S = 0.1
"""Time in seconds between two checks whether a client that sends no more requests still reads."""
_CLOSE_TIMEOUT_S = 1.0
"""Maximum time in seconds in which a client's last output is sent before it is disconnected."""

_log = logging.getLogger(LOGGER_NAME)


class Server:
    """Server of the daemon's socket: passes the requests of clients to the service.

    The listener is a bound socket that does not listen yet.
    """

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._service: Service | None = None
        self._clients: set[_ClientConnection] = set()
        self._leaving_clients: set[_ClientConnection] = set()
        self._pending_connections: dict[socket.socket, _PendingConnection] = {}
        """Connections without a complete line, oldest first."""
        self._stop_tasks: set[asyncio.Task[None]] = set()
        self._resolved_uids: set[int] = set()
        self._connection_count = 0
        self._closed = False
        self._spare_fd: int | None = None
        self._reserve_spare_fd()

    def serve(self, service: Service) -> None:
        """Start to accept clients, whose requests are passed to `service`, in the event loop."""
        self._service = service
        self._listener.listen(_LISTEN_BACKLOG)
        self._await_connections()

    def publish(self, event: Document) -> None:
        """Send an event to all clients that have subscribed to it."""
        subscribers = [client for client in self._clients if client.is_subscribed_to(event)]
        event_line = _json_line(event) if subscribers else b""
        for client in subscribers:
            client.write(event_line)

    async def close(self) -> None:
        """Stop accepting clients, send the pending output, and close all connections.

        The service has ended, so that the requests that still wait for a reply are refused.
        """
        self._closed = True
        asyncio.get_running_loop().remove_reader(self._listener)
        self._listener.close()
        for pending_connection in list(self._pending_connections.values()):
            self._forget_pending(pending_connection)
            pending_connection.client_socket.close()
        for client in list(self._clients):
            client.refuse_pending_requests()
            self._disconnect_when_sent(client)
        while self._leaving_clients:  # takes at most `_CLOSE_TIMEOUT_S`
            await asyncio.sleep(0.01)
        self._release_spare_fd()

    def remove_client(self, client: "_ClientConnection") -> None:
        """Remove a client whose connection was lost."""
        self._clients.discard(client)
        self._leaving_clients.discard(client)

    def _disconnect_when_sent(self, client: "_ClientConnection") -> None:
        """Remove a client, and disconnect it after its last output was sent."""
        self._clients.discard(client)
        self._leaving_clients.add(client)
        client.close_when_sent()

    def can_subscribe(self) -> bool:
        """Return whether another client may subscribe to events."""
        return sum(client.is_subscribed for client in self._clients) < MAX_SUBSCRIBERS

    # Connections without a complete line

    def _await_connections(self) -> None:
        """Let the event loop call `_accept_connections` when a connection waits to be accepted."""
        if not self._closed:
            asyncio.get_running_loop().add_reader(self._listener, self._accept_connections)

    def _accept_connections(self) -> None:
        """Accept waiting connections; pause briefly after `_MAX_ACCEPTED_CONNECTIONS` of them."""
        for _ in range(_MAX_ACCEPTED_CONNECTIONS):
            try:
                new_socket, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    return
                self._refuse_without_fd()
                break
            self._read_new_connection(new_socket)
        event_loop = asyncio.get_running_loop()
        event_loop.remove_reader(self._listener)
        event_loop.call_later(_ACCEPT_PAUSE_S, self._await_connections)

    def _read_new_connection(self, new_socket: socket.socket) -> None:
        """Read from a new connection at once, because most clients have sent a request already."""
        try:
            pending_connection = self._identified_connection(new_socket)
        except OSError:
            new_socket.close()
        else:
            self._receive(pending_connection)

    def _identified_connection(self, new_socket: socket.socket) -> "_PendingConnection":
        """Return an accepted connection with its number, process id and user id."""
        new_socket.setblocking(False)
        pid, uid = peer_pid_and_uid(new_socket)
        self._connection_count += 1
        return _PendingConnection(new_socket, Peer(self._connection_count, pid, uid))

    def _receive(self, pending_connection: "_PendingConnection") -> None:
        """Read from a new connection, which becomes a client when its first line is complete."""
        try:
            received_bytes = pending_connection.client_socket.recv(MAX_LINE_BYTES)
        except BlockingIOError:
            self._await_line(pending_connection)
            return
        except OSError:
            received_bytes = b""
        pending_connection.received_bytes += received_bytes
        if (
            received_bytes
            and b"\n" not in pending_connection.received_bytes
            and len(pending_connection.received_bytes) < MAX_LINE_BYTES
        ):
            self._await_line(pending_connection)
            return
        self._forget_pending(pending_connection)
        if received_bytes:
            self._make_client(pending_connection)
        else:
            pending_connection.client_socket.close()

    def _await_line(self, pending_connection: "_PendingConnection") -> None:
        """Wait for more data of a connection; if too many are waiting, close the oldest."""
        if pending_connection.client_socket in self._pending_connections:
            return
        if len(self._pending_connections) >= MAX_PENDING_CONNECTIONS:
            self._drop_oldest_pending()
        self._pending_connections[pending_connection.client_socket] = pending_connection
        asyncio.get_running_loop().add_reader(
            pending_connection.client_socket, self._receive, pending_connection
        )

    def _drop_oldest_pending(self) -> bool:
        """Close a connection that has sent no complete line; return False if there is none.

        It is the oldest one of the process that has the most. Many connections of one process
        therefore never displace a new connection of another process.
        """
        if not self._pending_connections:
            return False
        (pid, _), *_ = Counter(
            pending.peer.pid for pending in self._pending_connections.values()
        ).most_common(1)
        oldest_pending = next(
            pending for pending in self._pending_connections.values() if pending.peer.pid == pid
        )
        self._forget_pending(oldest_pending)
        _refuse_connection(oldest_pending.client_socket)
        return True

    def _forget_pending(self, pending_connection: "_PendingConnection") -> None:
        """Stop waiting for the data of a connection."""
        if self._pending_connections.pop(pending_connection.client_socket, None) is not None:
            asyncio.get_running_loop().remove_reader(pending_connection.client_socket)

    # Clients

    def _make_client(self, pending_connection: "_PendingConnection") -> None:
        """Make a connection with a complete first line a client; refuse it if there is no room."""
        assert self._service is not None
        if len(self._clients) >= MAX_CLIENTS and not self._disconnect_idle_client():
            self._refuse_unless_stop(pending_connection)
            return
        uid = pending_connection.peer.uid
        if uid not in self._resolved_uids:
            self._resolved_uids.add(uid)
            # This runs in a thread, because the user database may be on a network.
            threading.Thread(target=resolve_user, args=(uid,), daemon=True).start()
        client = _ClientConnection(
            self, self._service, pending_connection.peer, bytes(pending_connection.received_bytes)
        )
        self._clients.add(client)
        client.connecting = asyncio.create_task(_connect(pending_connection.client_socket, client))

    def _disconnect_idle_client(self) -> bool:
        """Disconnect an idle client to make room for another; return False if none is idle.

        It is the longest idle client of the process that has the most idle clients.
        """
        idle_clients = [client for client in self._clients if client.is_idle]
        if not idle_clients:
            return False
        idle_count_by_pid = Counter(client.pid for client in idle_clients)
        longest_idle_client = min(
            idle_clients,
            key=lambda client: (-idle_count_by_pid[client.pid], client.last_received_s),
        )
        longest_idle_client.write(_TOO_MANY_CLIENTS_LINE)
        self._disconnect_when_sent(longest_idle_client)
        return True

    def _refuse_unless_stop(self, pending_connection: "_PendingConnection") -> None:
        """Refuse a connection for which there is no room, unless it requests a `stop`."""
        request_line = bytes(pending_connection.received_bytes).partition(b"\n")[0]
        with suppress(RequestError):
            request = parse_request(request_line)
            if isinstance(request, StopSessionRequest):
                stop_task = asyncio.create_task(self._stop_and_close(request, pending_connection))
                self._stop_tasks.add(stop_task)
                stop_task.add_done_callback(self._stop_tasks.discard)
                return
        _refuse_connection(pending_connection.client_socket)

    async def _stop_and_close(
        self, request: StopSessionRequest, pending_connection: "_PendingConnection"
    ) -> None:
        """Execute the request `stop` of a connection, send the reply, and close the connection."""
        assert self._service is not None
        _send_last_line(
            pending_connection.client_socket,
            _json_line(await _reply(self._service, request, pending_connection.peer)),
        )

    def _refuse_without_fd(self) -> None:
        """Make room for a new connection, or refuse it, if there is no free file descriptor."""
        if self._drop_oldest_pending():
            return  # the descriptor of the closed connection is free now
        if self._spare_fd is None:
            self._reserve_spare_fd()
        self._release_spare_fd()
        with suppress(OSError):
            new_socket, _ = self._listener.accept()
            pending_connection = self._identified_connection(new_socket)
            with suppress(BlockingIOError):
                pending_connection.received_bytes += new_socket.recv(MAX_LINE_BYTES)
            self._refuse_unless_stop(pending_connection)
        self._reserve_spare_fd()

    def _reserve_spare_fd(self) -> None:
        """Reserve a file descriptor, with which a connection can be accepted if none is free."""
        with suppress(OSError):
            self._spare_fd = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def _release_spare_fd(self) -> None:
        """Release the reserved file descriptor."""
        spare_fd, self._spare_fd = self._spare_fd, None
        if spare_fd is not None:
            os.close(spare_fd)


@dataclass(slots=True)
class _PendingConnection:
    """Connection that has not sent a complete line yet."""

    client_socket: socket.socket
    peer: Peer
    received_bytes: bytearray = field(default_factory=bytearray)


class _ClientConnection(asyncio.Protocol):
    """Connection of a client: reads its requests, and sends replies and events."""

    def __init__(self, server: Server, service: Service, peer: Peer, received_bytes: bytes) -> None:
        self._server = server
        self._service = service
        self._peer = peer
        self._received_bytes = received_bytes
        """Bytes that were received before the connection became a client."""
        self._transport: asyncio.Transport | None = None
        self._pending = bytearray()
        self._waiting_lines: deque[bytes] = deque()
        self._next_line_timer: asyncio.TimerHandle | None = None
        self._requests: dict[asyncio.Task[None], AnyRequest] = {}
        """Task of a request that awaits its reply → the request."""
        self._has_ended = False
        self._is_leaving = False
        self.connecting: asyncio.Task[None] | None = None
        self.is_subscribed = False
        self._is_subscribed_to_signals = False
        self.last_received_s = time.monotonic()

    @property
    def is_idle(self) -> bool:
        """Whether the client has no subscription, does not control the rig and awaits no reply."""
        return not (
            self._received_bytes
            or self.is_subscribed
            or self._requests
            or self._waiting_lines
            or self._service.controller == self._peer
        )

    @property
    def pid(self) -> int:
        """Process id of the client."""
        return self._peer.pid

    def is_subscribed_to(self, event: Document) -> bool:
        """Return whether the client has subscribed to an event."""
        return self.is_subscribed and (
            self._is_subscribed_to_signals or event["event"] != "signals"
        )

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Process the lines that were received before the connection became a client."""
        self._transport = cast("asyncio.Transport", transport)
        # Beyond this limit the client is disconnected, because pausing the writer would not help.
        self._transport.set_write_buffer_limits(high=_MAX_UNREAD_BYTES)
        if self._is_leaving:  # the client was dismissed before its connection was made
            self.disconnect()
            return
        received_bytes, self._received_bytes = self._received_bytes, b""
        self.data_received(received_bytes)

    def data_received(self, data: bytes) -> None:
        """Split received bytes, which may end within a line, into lines to be processed."""
        self._pending += data
        *complete_lines, incomplete_line = self._pending.split(b"\n")
        self._pending = incomplete_line
        self._waiting_lines.extend(bytes(complete_line) for complete_line in complete_lines)
        if len(incomplete_line) >= MAX_LINE_BYTES or any(
            len(complete_line) >= MAX_LINE_BYTES for complete_line in complete_lines
        ):
            self.write(
                _json_line(_refusal_document(None, f"A line has at most {MAX_LINE_BYTES} bytes."))
            )
            self.close_when_sent()
        elif self._next_line_timer is None and self._waiting_lines:
            self._process_next_line()
        if len(self._waiting_lines) > _MAX_WAITING_LINES and self._transport is not None:
            self._transport.pause_reading()

    def eof_received(self) -> bool:
        """Reply to the pending requests and close, because the client sends no more requests."""
        self._has_ended = True
        self._close_if_done()
        self._disconnect_if_gone()
        return True

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 - asyncio's
        """Remove the client, because its connection was lost; its sessions continue."""
        if self._next_line_timer is not None:
            self._next_line_timer.cancel()
        self._waiting_lines.clear()
        self._transport = None
        self._service.release_control(self._peer)
        self._server.remove_client(self)

    def write(self, output_bytes: bytes) -> None:
        """Send bytes to the client; disconnect it if too much output is unread."""
        if self._transport is None or self._transport.is_closing():
            return
        self._transport.write(output_bytes)
        if self._transport.get_write_buffer_size() > _MAX_UNREAD_BYTES:
            self.disconnect()

    def refuse_pending_requests(self) -> None:
        """Refuse the requests that wait for a reply, because the daemon ends."""
        for task, request in self._requests.items():
            if not task.done():  # otherwise it has sent its reply
                refusal_document = _refusal_document(
                    request.id, SHUTTING_DOWN_MESSAGE, command=request.command, wrong_use=False
                )
                self.write(_json_line(refusal_document))

    def close_when_sent(self) -> None:
        """Close the connection when all output is sent, or after a second."""
        self._is_leaving = True
        self._waiting_lines.clear()
        if self._transport is not None and not self._transport.is_closing():
            self._transport.close()
            asyncio.get_running_loop().call_later(_CLOSE_TIMEOUT_S, self.disconnect)

    def disconnect(self) -> None:
        """Close the connection at once."""
        if self._transport is not None:
            self._transport.abort()

    def _disconnect_if_gone(self) -> None:
        """Disconnect a client that has died or no longer reads; otherwise check again soon.

        It then loses control, and its requests that wait are not executed.
        """
        if self._transport is None or self._transport.is_closing():
            return
        if _is_gone(self._transport.get_extra_info("socket")):
            self.disconnect()
        else:
            asyncio.get_running_loop().call_later(_GONE_CHECK_INTERVAL_S, self._disconnect_if_gone)

    def _process_next_line(self) -> None:
        """Process one waiting line, and schedule the next."""
        self._next_line_timer = None
        if not self._waiting_lines:
            self._close_if_done()
            return
        request_line = self._waiting_lines.popleft()
        self.last_received_s = time.monotonic()
        self._process_line(request_line)
        if self._transport is None or self._transport.is_closing():
            return
        self._next_line_timer = asyncio.get_running_loop().call_later(
            _MIN_REQUEST_INTERVAL_S, self._process_next_line
        )
        if not self._waiting_lines:
            self._transport.resume_reading()

    def _process_line(self, request_line: bytes) -> None:
        """Parse a line, and start to execute the request; refuse an invalid line."""
        try:
            request = parse_request(request_line)
        except RequestError as error:
            self.write(_json_line(_refusal_document(error.request_id, str(error))))
            return
        if request.command == "watch" and not self.is_subscribed:
            if not self._server.can_subscribe():
                refusal_text = (
                    f"{MAX_SUBSCRIBERS} clients are watching already; use status instead."
                )
                self.write(
                    _json_line(
                        _refusal_document(
                            request.id, refusal_text, command="watch", wrong_use=False
                        )
                    )
                )
                return
            self.is_subscribed = True
        if isinstance(request, WatchRequest):
            self._is_subscribed_to_signals |= request.signals
        reply_task = asyncio.create_task(self._execute_and_reply(request))
        self._requests[reply_task] = request
        reply_task.add_done_callback(self._remove_task)

    async def _execute_and_reply(self, request: AnyRequest) -> None:
        """Execute a request, and send the reply."""
        self.write(_json_line(await _reply(self._service, request, self._peer)))

    def _remove_task(self, task: "asyncio.Task[None]") -> None:
        """Remove the task of a request after the reply was sent."""
        self._requests.pop(task, None)
        self._close_if_done()

    def _close_if_done(self) -> None:
        """Close the connection if the client sends no more requests and has all replies."""
        if self._has_ended and not (self._requests or self._waiting_lines):
            self.close_when_sent()


async def _reply(service: Service, request: AnyRequest, peer: Peer) -> Document:
    """Execute a request, and return the reply; if the request fails, return a refusal."""
    try:
        reply_document = await service.execute(request, peer)
    except CommandError as error:
        return _refusal_document(
            request.id, str(error), command=request.command, wrong_use=error.wrong_use
        )
    except Exception as error:
        _log.exception("unexpected error in a request")
        error_text = f"Unexpected error in the daemon ({error!r}); its log says more."
        return _refusal_document(request.id, error_text, command=request.command, wrong_use=False)
    reply_document = {"reply": request.command, "ok": True, **reply_document}
    return reply_document if request.id is None else reply_document | {"id": request.id}


async def _connect(client_socket: socket.socket, client: _ClientConnection) -> None:
    """Pass an accepted socket to the event loop as the connection of a client."""
    try:
        await asyncio.get_running_loop().connect_accepted_socket(lambda: client, client_socket)
    except OSError:
        client_socket.close()
        client.connection_lost(None)


def _is_gone(client_socket: socket.socket) -> bool:
    """Return whether the other end is closed, and not only for sending."""
    poller = select.poll()
    poller.register(client_socket, 0)  # the kernel reports POLLHUP also if no event is requested
    return bool(poller.poll(0))


_encode_json: Final = json.JSONEncoder(allow_nan=False).encode


def _json_line(document: Document) -> bytes:
    """Return a reply or an event as a line of JSON."""
    return _encode_json(document).encode() + b"\n"


def _refusal_document(
    request_id: RequestId | None,
    refusal_text: str,
    *,
    command: str | None = None,
    wrong_use: bool = True,
) -> Document:
    """Return the reply that refuses a request, with the reason."""
    refusal_reply = {"reply": command, "ok": False, "error": refusal_text, "wrong_use": wrong_use}
    return refusal_reply if request_id is None else refusal_reply | {"id": request_id}


_TOO_MANY_CLIENTS_LINE = _json_line(
    _refusal_document(None, "There are too many clients; try again later.", wrong_use=False)
    | {"crowded": True}
)


def _send_last_line(client_socket: socket.socket, last_line: bytes) -> None:
    """Send a last line to a client without waiting, and close the connection."""
    with client_socket, suppress(OSError):
        client_socket.send(last_line)


def _refuse_connection(client_socket: socket.socket) -> None:
    """Refuse and close a connection because there are too many clients."""
    _send_last_line(client_socket, _TOO_MANY_CLIENTS_LINE)
