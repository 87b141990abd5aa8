"""Access control of the page: permissions to read and to act, and protection from other pages.

Any user of this computer may read; acting requires the token in the printed URL. Any page on the
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

LIVE_PATH: Final = "/api/live"
"""URL path of the WebSocket with the live messages."""
ICON_PATH: Final = "/favicon.ico"
"""URL path of the page's icon, which any page may load."""
_PERMITTED_HOSTS: Final = frozenset({"127.0.0.1", "localhost"})
"""Host names under which the page may be requested."""
_ACTION_HEADER: Final = "X-Rigd"
"""HTTP header that the page sends with every request that acts."""
_COMMANDS_WITHOUT_TOKEN: Final = frozenset({"stop", "predict"})
"""Commands without a token: any observer may stop the rig, and a prediction moves nothing."""

_BODY_TIMEOUT_S: Final = 5.0
"""Timeout in seconds for the body of a request."""
_FIRST_REQUEST_TIMEOUT_S: Final = 10.0
"""Timeout in seconds for the first request of a connection."""
_POLL_PERIOD_S: Final = 0.5
"""Interval in seconds at which silent connections are closed."""
_MAX_OPEN_CONNECTIONS: Final = 96
"""Largest number of connections; beyond it the oldest ones without an open page are closed."""

_PAGE_POLICY: Final = "; ".join(  # Content security policy of the page
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
"""Content security policy of reports, which are files with inline style.

It permits no scripts, and gives reports no origin."""
_SECURITY_HEADERS: Final = {  # Security headers of all responses
    "Content-Security-Policy": _PAGE_POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


class WebAccess:
    """Checks where each request comes from, and whether it may act on the rig.

    A request must contain the secret `token` to act.
    """

    def __init__(self, token: str) -> None:
        self._token = token.encode()

    @web.middleware
    async def check_and_respond(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Return the response to a permitted request; otherwise a refusal or an error as JSON."""
        try:
            request_refusal = _refusal_of_other_pages(request)
            response = await handler(request) if request_refusal is None else request_refusal
        except web.HTTPException as error:
            response = refusal_response(error.status, error.reason)
        except UserError as error:
            response = refusal_response(400, str(error))
        except Exception as error:  # reported to the client, not on the terminal
            response = refusal_response(500, f"The page's server failed: {error!r}")
        return response

    @staticmethod
    async def add_security_headers(_: web.Request, response: web.StreamResponse) -> None:
        """Add the security headers to a response that is about to be sent."""
        for header_name, header_value in _SECURITY_HEADERS.items():
            response.headers.setdefault(header_name, header_value)

    def may_act(self, request: web.Request) -> bool:
        """Return whether a request has the token, and thus may act on the rig."""
        auth_scheme, _, given_token = request.headers.get("Authorization", "").partition(" ")
        return auth_scheme == "Bearer" and hmac.compare_digest(
            given_token.encode(errors="surrogateescape"), self._token
        )

    def may_command(self, request: web.Request, command: str, parameters: object) -> bool:
        """Return whether a request of a browser may send a command to the daemon.

        A prediction from a file requires the token, because the daemon would read that file.
        """
        if self.may_act(request):
            return True
        reads_file = command == "predict" and isinstance(parameters, dict) and "path" in parameters
        return command in _COMMANDS_WITHOUT_TOKEN and not reads_file


async def read_json_object(request: web.Request) -> dict[str, Any]:
    """Return the JSON object in a request's body.

    Raise `HTTPException` if the body is no JSON object, or does not arrive in time.
    """
    try:
        request_object = json.loads(await asyncio.wait_for(request.read(), _BODY_TIMEOUT_S))
    except TimeoutError:
        raise web.HTTPRequestTimeout(reason="The request is incomplete.") from None
    except (ValueError, RecursionError):
        request_object = None
    if not isinstance(request_object, dict):
        raise web.HTTPBadRequest(reason="The request is not a JSON object.")
    return request_object


def refusal_response(status: int, text: str) -> web.Response:
    """Return the JSON response that refuses a request, with a sentence for the operator."""
    return web.json_response({"ok": False, "error": text, "wrong_use": True}, status=status)


def _refusal_of_other_pages(request: web.Request) -> web.Response | None:
    """Return the refusal of a request from another page; None if it is from this server's page."""
    host_name = request.headers.get("Host", "")
    # The port may differ because of a tunnel, but the name must be local.
    if _host_name_of(host_name) not in _PERMITTED_HOSTS:
        return refusal_response(403, "Open this page as http://127.0.0.1:PORT/.")
    origin_url = request.headers.get("Origin")
    if origin_url is not None and origin_url != f"http://{host_name}":
        return refusal_response(403, "Requests from other pages are refused.")
    # A sandboxed report counts as another origin, and its browser requests the icon.
    fetch_site = request.headers.get("Sec-Fetch-Site", "same-origin")
    if fetch_site not in ("same-origin", "none") and request.path != ICON_PATH:
        return refusal_response(403, "Requests from other pages are refused.")
    if request.method not in ("GET", "HEAD", "POST"):
        return refusal_response(405, "Only GET, HEAD and POST are accepted.")
    if request.method == "POST" and (
        request.headers.get(_ACTION_HEADER) != "1" or request.content_type != "application/json"
    ):
        return refusal_response(
            403, f"A request for an action must be JSON and have the header {_ACTION_HEADER}: 1."
        )
    return None


def _host_name_of(host_header: str) -> str:
    """Return the host name in a Host header; "" if the header has more than a name and a port."""
    try:
        parsed_url = urlsplit(f"//{host_header}")
        port_number = parsed_url.port
    except ValueError:
        return ""
    name_and_port = (
        parsed_url.hostname if port_number is None else f"{parsed_url.hostname}:{port_number}"
    )
    return (parsed_url.hostname or "") if name_and_port == host_header else ""


# Connections


class Connections:
    """Limits the number of connections and the time until their first request.

    Attributes
    ----------
    http_server
        HTTP server of the connections; it must be set before the first connection.
    """

    http_server: web.Server

    def __init__(self) -> None:
        self._first_request_deadlines: dict[RequestHandler, float] = {}
        """Deadline of each connection that has sent no request yet."""
        self._pages: set[RequestHandler] = set()
        """Connections of open pages."""

    def close_silent_connections(self) -> None:
        """Close connections that have sent no request in time, now and at regular intervals."""
        now_s, open_connections = time.monotonic(), set(self.http_server.connections)
        self._first_request_deadlines = {
            handler: deadline_s
            for handler, deadline_s in self._first_request_deadlines.items()
            if handler in open_connections
        }
        for request_handler, deadline_s in self._first_request_deadlines.items():
            if deadline_s < now_s and request_handler.transport is not None:
                request_handler.transport.abort()
        asyncio.get_running_loop().call_later(_POLL_PERIOD_S, self.close_silent_connections)

    def accept_connection(self) -> asyncio.Protocol:
        """Return the handler of a new connection; if there are too many, close the oldest ones.

        Connections of open pages are not closed.
        """
        open_connections = [
            (handler, handler.transport)
            for handler in self.http_server.connections
            if handler.transport is not None and not handler.transport.is_closing()
        ]
        excess_count = max(0, len(open_connections) - _MAX_OPEN_CONNECTIONS + 1)
        # The newest client may want to stop the rig.
        for old_transport in [
            handler[1] for handler in open_connections if handler[0] not in self._pages
        ][:excess_count]:
            old_transport.abort()
        request_handler = self.http_server()
        self._first_request_deadlines[request_handler] = time.monotonic() + _FIRST_REQUEST_TIMEOUT_S
        return request_handler

    @web.middleware
    async def register_request(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Return the response to a request, and register that its connection is not silent.

        The connection with the live messages is that of an open page for as long as it lasts.
        """
        self._first_request_deadlines.pop(request.protocol, None)
        if request.path != LIVE_PATH:
            return await handler(request)
        self._pages.add(request.protocol)
        try:
            return await handler(request)
        finally:
            self._pages.discard(request.protocol)
