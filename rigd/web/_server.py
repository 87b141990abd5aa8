"""HTTP server of the operator's page: its routes, its live messages, and its program."""

import asyncio
import logging
import os
import re
from collections.abc import Awaitable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from rigd.beam import Beam, Damping
from rigd.daemon.client import DaemonUnreachableError, RefusedByDaemonError, stop_session
from rigd.engine.messages import OperatorPageServed, ProcessFailed
from rigd.engine.processes import SupervisorConnection
from rigd.excitation import KINDS, excitation_options
from rigd.profile import specimen_files
from rigd.runner.quick_looks import QuickLook
from rigd.runtime import ignore_end_signals
from rigd.sweep_response import sweep_ticks
from rigd.units import UNITS
from rigd.web._access import (
    ICON_PATH,
    LIVE_PATH,
    Connections,
    WebAccess,
    read_json_object,
    refusal_response,
)
from rigd.web._jobs import JobQueue
from rigd.web._library import Library
from rigd.web._link import BusyError, DaemonError, DaemonLink
from rigd.web._live import Pages
from rigd.web._signals import PageSignalBlock, SessionResponse, SignalEnvelopes, nominal_document

Document = dict[str, Any]

_LOOPBACK_ADDRESS: Final = "127.0.0.1"
"""Address on which the page is served."""
_PAGE_COMMANDS: Final = frozenset({"start", "stop", "tare", "zero", "reset", "predict", "check"})
"""Commands that the page may send to the daemon."""
_MAX_SIMULTANEOUS_STOPS: Final = 4
"""Largest number of simultaneous stops; each has its own thread."""
_MAX_REQUEST_BYTES: Final = 65_536
"""Largest size of a request's body in bytes."""
_KEEP_ALIVE_S: Final = 15.0
"""Seconds for which an idle connection remains open."""
_LINGERING_TIME_S: Final = 1.0
"""Seconds for which the server reads what remains of a request before it disconnects."""
_FREQUENCY_RESPONSE_PERIOD_S: Final = 1.0
"""Interval in seconds at which the frequency response of a running session is sent."""
_LAST_MESSAGES_TIMEOUT_S: Final = 0.3
"""Seconds for the last messages to reach the pages before the process ends."""
_SESSION_STATES: Final = ("running", "stopping")
"""States of the daemon in which a session runs."""
_FAILED_MESSAGE: Final = "The page's server has failed; the daemon starts it again."
"""Message to the open pages before a failed server ends."""
_STATIC_FILE_NAME: Final = re.compile(r"[a-z0-9_]+\.(html|css|js|svg|png|ico|webmanifest)")
"""Pattern of the names of the page's static files."""


class OperatorPageServer:
    """Serves the operator's page of one rig.

    `page_job` has the data of the rig that the daemon sends at the start: see `rigd.daemon._page`.
    """

    def __init__(self, page_job: Document) -> None:
        self._page_job = page_job
        self._socket = Path(page_job["socket"])
        self._access = WebAccess(page_job["token"])
        self.pages = Pages()
        self._jobs = JobQueue(Path(page_job["folder"]), self.pages.send)
        self._library = Library(Path(page_job["folder"]), self._access, self._jobs)
        self._stopping = ThreadPoolExecutor(_MAX_SIMULTANEOUS_STOPS, "stop")
        self._link = DaemonLink(self._socket, self._process_message, self._report_loss)
        self._excitations = dict(_excitations())
        self._nominal_response = self._nominal_message(page_job)
        self._specimens: list[str] = []
        self._status: Document | None = None
        self._lost_message: Document | None = None
        self._gauges_message: Document | None = None
        self._envelopes = SignalEnvelopes()
        self._session: str | None = None
        self._latest_session = ""
        self._response: SessionResponse | None = None
        self._shown: Document | None = None
        self._last_response: Document | None = None
        self._searches: set[asyncio.Task[None]] = set()

    def application(self) -> web.Application:
        """Return the web application with all routes of the page."""
        application = web.Application(
            middlewares=[self._access.check_and_respond], client_max_size=_MAX_REQUEST_BYTES
        )
        application.on_response_prepare.append(self._access.add_security_headers)
        application.add_routes(
            [
                web.get("/", self._static_file),
                web.get("/static/{name}", self._static_file),
                web.get(ICON_PATH, self._static_file),
                web.get(LIVE_PATH, self._live_messages),
                web.post("/api/command", self._forward_command),
                *self._library.routes(),
            ]
        )
        return application

    async def run(self) -> None:
        """Receive the daemon's messages and run jobs, until cancelled."""
        await asyncio.gather(
            self._link.run(), self._jobs.run(), self._send_responses(), self._find_specimens()
        )

    def end(self, end_message: str) -> None:
        """Inform the open pages that this server ends, with the reason."""
        self._report_loss(end_message)

    # Requests

    async def _static_file(self, request: web.Request) -> web.StreamResponse:
        """Send a static file of the page."""
        file_name = request.match_info.get(
            "name", "index.html" if request.path == "/" else "favicon.svg"
        )
        file_path = Path(str(files("rigd.web") / "static" / file_name))
        if not _STATIC_FILE_NAME.fullmatch(file_name) or not file_path.is_file():
            return refusal_response(404, "There is no such file.")
        icon_headers = {"Cross-Origin-Resource-Policy": "cross-origin"}
        return web.FileResponse(
            file_path, headers=icon_headers if request.path == ICON_PATH else None
        )

    async def _live_messages(self, request: web.Request) -> web.StreamResponse:
        """Send live messages to a page until it is closed."""
        hello_message = {
            "type": "hello",
            "profile": self._page_job["profile"],
            "description": self._page_job["description"],
            "limits": self._page_job["limits"],
            "daemon": None if self._status is None else self._status["daemon"],
            "excitations": self._excitations,
            "specimens": self._specimens,
            "required_meta": self._page_job["required_meta"],
            "units": dict(UNITS),
        }
        first_messages = (
            *(
                hello_message,
                self._lost_message,
                self._status,
                self._gauges_message,
                self._envelopes.stored_message(),
            ),
            *(self._nominal_response, self._last_response, self._shown),
        )
        return await self.pages.serve(request, filter(None, first_messages), self._stop_for_page)

    async def _forward_command(self, request: web.Request) -> web.Response:
        """Send a command of the page to the daemon, and its reply to the page."""
        request_object = await read_json_object(request)
        command = request_object.get("command")
        if not isinstance(command, str) or command not in _PAGE_COMMANDS:
            return refusal_response(400, f"command: choose {', '.join(sorted(_PAGE_COMMANDS))}.")
        if not self._access.may_command(request, command, request_object.get("parameters")):
            return refusal_response(
                403, "The token is missing or wrong: open the address of rigd status."
            )
        try:
            if command == "stop":
                daemon_reply = await self._stop()
            else:
                daemon_reply = await self._link.send_request(request_object)
        except (DaemonError, DaemonUnreachableError) as error:
            return refusal_response(503, str(error))
        except (BusyError, RefusedByDaemonError) as error:
            return refusal_response(409, str(error))
        finally:
            self._link.request_status()
        http_status = (
            200 if daemon_reply.get("ok") else 400 if daemon_reply.get("wrong_use") else 409
        )
        return web.json_response(daemon_reply, status=http_status)

    async def _stop(self) -> Document:
        """Stop the daemon's session, if necessary by a signal, and return the daemon's reply."""
        self._link.register_stop()
        event_loop = asyncio.get_running_loop()
        return await event_loop.run_in_executor(self._stopping, stop_session, self._socket)

    async def _stop_for_page(self) -> Document:
        """Stop the daemon's session, and return the result as a message to the page."""
        try:
            return await self._stop()
        except (DaemonUnreachableError, RefusedByDaemonError) as error:
            return {"ok": False, "error": str(error)}
        finally:
            self._link.request_status()

    # Messages of the daemon

    def _process_message(self, message: Document) -> None:
        """Process a message of the daemon: update the stored state, and inform the open pages."""
        if self._lost_message is not None:
            self._lost_message = None
            self._link.request_status()
        event_name = message.get("event")
        if event_name is None:
            self._process_status(message)
        elif event_name == "signals":
            self._process_signals(message)
        elif event_name == "fit":
            # The status contains the last fit, also for pages that open later.
            self._link.request_status()
        elif event_name == "message":
            self.pages.log_message(message["level"], message["text"])
        else:
            del message["event"]
            self.pages.send({"type": event_name, **message})
            if event_name != "progress":
                self._link.request_status()
            if event_name == "session":
                self._start_search(self._find_specimens())
            elif event_name == "quick_look":
                self.pages.log_message("info", "\n".join(QuickLook.from_event(message).lines))

    def _process_status(self, status: Document) -> None:
        """Send the daemon's status to the open pages, and prepare for a session that has begun."""
        self._status = {"type": "status", **status}
        self._jobs.paused = status["state"] in _SESSION_STATES
        session_series = status["series"]
        session_path = (
            session_series["path"]
            if session_series is not None and session_series["running"]
            else None
        )
        if session_path is not None and session_path != self._session:
            self._prepare_session(session_path, session_series)
        self._session = session_path
        self.pages.send(self._status)

    def _prepare_session(self, session_path: str, session_series: Document) -> None:
        """Prepare the frequency responses that the pages show during a new session."""
        session_plan = session_series["plan"]
        self._latest_session = session_path
        self._nominal_response = self._nominal_message(session_plan)
        self._shown = self._last_response = None
        self._response = None
        if session_series["excitation"] != "hold":
            self._response = SessionResponse(
                sweep_ticks(session_plan["segments"]),
                self._page_job["rate_hz"],
                angle_delay_s=self._page_job["angle_delay_s"],
                torque_delay_s=self._page_job["torque_delay_s"],
            )
        self.pages.send(self._nominal_response)  # the pages then clear the other responses
        specimen_name = str(session_series["notes"].get("specimen", ""))
        self._start_search(self._send_last_response(specimen_name, session_path))

    def _nominal_message(self, beam_document: Document) -> Document:
        """Return the message with the nominal frequency response of a beam with its damping."""
        beam, damping = Beam(**beam_document["beam"]), Damping(**beam_document["damping"])
        return nominal_document(beam, damping, self._page_job["tool_inertia_kg_m2"])

    def _process_signals(self, event: Document) -> None:
        """Send a block of signals and the gauges to the open pages."""
        if event["count"]:
            signal_block = PageSignalBlock.from_event(event)
            self.pages.send(self._envelopes.feed(signal_block))
            if self._response is not None:
                self._response.feed(signal_block)
        if event["gauges"] is not None:
            frequency_hz = event["frequency_hz"]
            self._gauges_message = {
                "type": "gauges",
                **event["gauges"],
                "frequency_hz": frequency_hz,
            }
            self.pages.send(self._gauges_message)

    def _report_loss(self, reason: str) -> None:
        """Inform the open pages that the daemon cannot be reached, with the reason."""
        if self._lost_message is None or self._lost_message["reason"] != reason:
            self._lost_message = {"type": "lost", "reason": reason}
            self.pages.send(self._lost_message)
        self._status = None

    async def _send_responses(self) -> None:
        """Send the frequency response of the running session periodically, until cancelled."""
        while True:
            await asyncio.sleep(_FREQUENCY_RESPONSE_PERIOD_S)
            if self._response is not None and self.pages:
                shown_response = self._response.response_message()
                self._shown = shown_response or self._shown
                self.pages.send(shown_response)

    def _start_search(self, search_coroutine: Awaitable[None]) -> None:
        """Start a search in the recorded sessions, without waiting for its end."""
        search_task = asyncio.ensure_future(search_coroutine)
        self._searches.add(search_task)
        search_task.add_done_callback(self._searches.discard)

    async def _find_specimens(self) -> None:
        """Update the names of specimens that the page suggests."""
        with suppress(OSError, ValueError):
            recorded_specimens = await self._library.specimens()
            self._specimens = list(dict.fromkeys([*recorded_specimens, *specimen_files()]))

    async def _send_last_response(self, specimen_name: str, session_path: str) -> None:
        """Send the open pages the frequency response of a specimen's last session.

        The running session in `session_path` does not count as the last one. Nothing is sent if
        another session has begun when the response is found.
        """
        with suppress(OSError, ValueError):
            response_message = await self._library.last_response(
                specimen_name, Path(session_path).stem
            )
            if session_path == self._latest_session:
                self._last_response = response_message
                self.pages.send(response_message)


def _excitations() -> Iterator[tuple[str, list[Document]]]:
    """Yield the name and the options of each excitation, for the page's form."""
    for excitation_name in KINDS:
        yield (
            excitation_name,
            [
                {
                    "name": option.name,
                    "unit": option.unit,
                    "default": option.default,
                    "help": option.help,
                }
                | ({"text": True} if option.value_type is str else {})
                for option in excitation_options(excitation_name)
            ],
        )


# Program


def run_page() -> None:
    """Serve the page until the daemon ends; called by ``python -m rigd.web``."""
    ignore_end_signals()
    # No log: a stopped terminal (Ctrl-S) would block all pages, and invalid requests would fill the
    # journal.
    logging.disable()
    daemon_connection = SupervisorConnection()
    asyncio.run(_serve_until_end(daemon_connection, daemon_connection.receive_job()))


async def _serve_until_end(daemon_connection: SupervisorConnection, page_job: Document) -> None:
    """Serve the page of a job until the daemon ends or the server fails."""
    try:
        page_server, _, listening_server = await start_page_server(page_job)
    except OSError as error:
        daemon_connection.send(
            ProcessFailed(f"port {page_job['port']} cannot be opened: {error.strerror}")
        )
        return
    daemon_connection.send(OperatorPageServed(port_of(listening_server)))
    server_task = asyncio.create_task(page_server.run())
    daemon_end = asyncio.get_running_loop().run_in_executor(None, daemon_connection.poll, None)
    await asyncio.wait((server_task, daemon_end), return_when=asyncio.FIRST_COMPLETED)
    has_failed = server_task.done()
    if has_failed:
        daemon_connection.send(ProcessFailed(f"unexpected error ({server_task.exception()!r})"))
    # The successor of this process or of the daemon may need the port.
    listening_server.close()
    page_server.end(
        _FAILED_MESSAGE if has_failed else "The daemon has ended; start it with rigd serve."
    )
    await asyncio.sleep(_LAST_MESSAGES_TIMEOUT_S)
    # A regular exit would wait for reading clients and for the thread that waits for the daemon.
    os._exit(1 if has_failed else 0)


async def start_page_server(
    page_job: Document,
) -> tuple[OperatorPageServer, web.AppRunner, asyncio.Server]:
    """Start the page's server on the port of a job, or on a free port if the job permits it.

    Return the server, whose `run` must be called, the runner of its application, and the listening
    server. `page_job` is that of `OperatorPageServer`, with ``port`` and ``any_port``. Raise
    `OSError` if the port is not available.
    """
    page_server, connections = OperatorPageServer(page_job), Connections()
    web_application = page_server.application()
    web_application.middlewares.append(connections.register_request)
    app_runner = web.AppRunner(
        web_application,
        access_log=None,
        handle_signals=False,
        auto_decompress=False,
        keepalive_timeout=_KEEP_ALIVE_S,
        lingering_time=_LINGERING_TIME_S,
        shutdown_timeout=_LAST_MESSAGES_TIMEOUT_S,
    )
    await app_runner.setup()
    assert app_runner.server is not None
    connections.http_server = app_runner.server
    event_loop = asyncio.get_running_loop()
    try:
        listening_server = await event_loop.create_server(
            connections.accept_connection, _LOOPBACK_ADDRESS, page_job["port"]
        )
    except OSError:
        if not page_job["any_port"]:
            raise
        listening_server = await event_loop.create_server(
            connections.accept_connection, _LOOPBACK_ADDRESS, 0
        )
    connections.close_silent_connections()
    return page_server, app_runner, listening_server


def port_of(listening_server: asyncio.Server) -> int:
    """Return the number of the port on which a server listens."""
    port_number: int = listening_server.sockets[0].getsockname()[1]
    return port_number
