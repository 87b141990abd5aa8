"""Access to the page: permissions to read and to act, and protection against other pages.

Any user of the port may read; acting needs the token of the printed address. Any page on the
internet can resolve its own name to loopback (DNS rebinding) and send requests there. Requests
therefore need a name of this computer as Host, the same origin, and a header that no form can send,
and there are no cross-origin permissions.
"""

import asyncio
import hmac
import json
import time
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from aiohttp import web

from rigd.errors import UserError

if TYPE_CHECKING:
    from aiohttp.web_protocol import RequestHandler

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

LIVE: Final = "/api/live"
"""Path of the live messages, with a limit on the open pages."""
ICON: Final = "/favicon.ico"
"""Path of the icon, which any page may load."""
_OWN_NAMES: Final = frozenset({"127.0.0.1", "localhost"})
_OWN_HEADER: Final = "X-Rigd"
_FREE_COMMANDS: Final = frozenset({"stop", "predict"})
"""Commands without a token: any observer may stop the rig, and a prediction moves nothing."""

_READ_S: Final = 5.0
"""Timeout of a request's body."""
_SILENT_S: Final = 10.0
"""Timeout of a connection's first request."""
_POLL_S: Final = 0.5
_MOST_CONNECTIONS: Final = 96

_POLICY: Final = "; ".join(
    (
        "default-src 'self'",
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
REPORT_POLICY: Final = "; ".join(
    (
        "default-src 'none'",
        "style-src 'unsafe-inline'",
        "img-src 'self' data:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
        "sandbox allow-popups allow-downloads",
    )
)
"""Policy of reports, which are single files with inline style: no scripts, and no origin."""
_HEADERS: Final = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


class WebAccess:
    """Access control, which checks each request first.

    Parameters
    ----------
    token
        Secret needed to act.
    """

    def __init__(self, token: str) -> None:
        self._token = token.encode()

    @web.middleware
    async def guard(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Handle a permitted request; return refusals and errors as JSON."""
        try:
            refusal = _refusal(request)
            response = await handler(request) if refusal is None else refusal
        except web.HTTPException as error:
            response = refused(error.status, error.reason)
        except UserError as error:
            response = refused(400, str(error))
        except Exception as error:  # reported to the client, not on the terminal
            response = refused(500, f"The page's server failed: {error!r}")
        return response

    @staticmethod
    async def protect(_: web.Request, response: web.StreamResponse) -> None:
        """Add the page's policy to a response that is about to be sent."""
        for name, value in _HEADERS.items():
            response.headers.setdefault(name, value)

    def may_act(self, request: web.Request) -> bool:
        """Return whether a request has the token."""
        scheme, _, given = request.headers.get("Authorization", "").partition(" ")
        return scheme == "Bearer" and hmac.compare_digest(
            given.encode(errors="surrogateescape"), self._token
        )

    def may_command(self, request: web.Request, command: str, parameters: object) -> bool:
        """Return whether a request may send a command to the control socket.

        Parameters
        ----------
        request
            Request with the command.
        command, parameters
            Members of the command. A prediction from a file makes the daemon read that file.
        """
        if self.may_act(request):
            return True
        reads_a_file = (
            command == "predict" and isinstance(parameters, dict) and "path" in parameters
        )
        return command in _FREE_COMMANDS and not reads_a_file


async def object_of(request: web.Request) -> dict[str, Any]:
    """Return the JSON object in a request's body.

    Parameters
    ----------
    request
        Request whose body is read.

    Raises
    ------
    HTTPException
        If the body is no JSON object, or does not arrive in time.
    """
    try:
        given = json.loads(await asyncio.wait_for(request.read(), _READ_S))
    except TimeoutError:
        raise web.HTTPRequestTimeout(reason="The request did not come to its end.") from None
    except (ValueError, RecursionError):
        given = None
    if not isinstance(given, dict):
        raise web.HTTPBadRequest(reason="The request is not a JSON object.")
    return given


def refused(status: int, text: str) -> web.Response:
    """Return a refusal for the page.

    Parameters
    ----------
    status
        HTTP status.
    text
        Sentence for the operator.
    """
    return web.json_response({"ok": False, "error": text, "wrong_use": True}, status=status)


def _refusal(request: web.Request) -> web.Response | None:
    """Return the refusal of a request that this server's page would not send; None if permitted."""
    host = request.headers.get("Host", "")
    # The port may differ because of a tunnel, but the name must be local.
    if _name_of(host) not in _OWN_NAMES:
        return refused(403, "Open this page as http://127.0.0.1:PORT/.")
    origin = request.headers.get("Origin")
    if origin is not None and origin != f"http://{host}":
        return refused(403, "Requests from other pages are refused.")
    # A sandboxed report counts as another origin, and its browser requests the icon.
    site = request.headers.get("Sec-Fetch-Site", "same-origin")
    if site not in ("same-origin", "none") and request.path != ICON:
        return refused(403, "Requests from other pages are refused.")
    if request.method not in ("GET", "HEAD", "POST"):
        return refused(405, "Only GET, HEAD and POST are answered.")
    if request.method == "POST" and (
        request.headers.get(_OWN_HEADER) != "1" or request.content_type != "application/json"
    ):
        return refused(403, f"A request that acts is JSON and has the header {_OWN_HEADER}: 1.")
    return None


def _name_of(host: str) -> str:
    """Return the name in a Host header; empty if it is not just a name and a port."""
    try:
        split = urlsplit(f"//{host}")
        port = split.port
    except ValueError:
        return ""
    plain = split.hostname if port is None else f"{split.hostname}:{port}"
    return (split.hostname or "") if plain == host else ""


# Connections


class Connections:
    """Limits of the number of connections and of their time without a request.

    Attributes
    ----------
    serving
        Server of the connections; set it before the first one.
    """

    serving: web.Server

    def __init__(self) -> None:
        self._silent: dict[RequestHandler, float] = {}
        """Deadlines of the connections that have sent no request yet."""
        self._pages: set[RequestHandler] = set()

    def close_silent(self) -> None:
        """Close connections that send no request in time, periodically from now on."""
        now_s, open_now = time.monotonic(), set(self.serving.connections)
        self._silent = {each: end_s for each, end_s in self._silent.items() if each in open_now}
        for protocol, end_s in self._silent.items():
            if end_s < now_s and protocol.transport is not None:
                protocol.transport.abort()
        asyncio.get_running_loop().call_later(_POLL_S, self.close_silent)

    def welcome(self) -> asyncio.Protocol:
        """Return the protocol of a new connection; the oldest one without a page may close."""
        open_now = [
            (each, each.transport)
            for each in self.serving.connections
            if each.transport is not None and not each.transport.is_closing()
        ]
        too_many = max(0, len(open_now) - _MOST_CONNECTIONS + 1)
        # The newest client may want to stop the rig.
        for transport in [each[1] for each in open_now if each[0] not in self._pages][:too_many]:
            transport.abort()
        protocol = self.serving()
        self._silent[protocol] = time.monotonic() + _SILENT_S
        return protocol

    @web.middleware
    async def note_request(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Register the request of a connection, and connections of open pages."""
        self._silent.pop(request.protocol, None)
        if request.path != LIVE:
            return await handler(request)
        self._pages.add(request.protocol)
        try:
            return await handler(request)
        finally:
            self._pages.discard(request.protocol)
