"""Server of the page: its routes, its messages to the open pages, and its program."""

import asyncio
import json
import logging
import os
import re
import sys
from collections.abc import Awaitable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.resources import files
from inspect import Parameter, cleandoc, signature
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from rigd.beam import Beam, Damping
from rigd.daemon.client import DaemonGoneError, RefusedByDaemonError, stop_session
from rigd.excitation import FROM_THE_RIG, KINDS
from rigd.profile import specimen_files
from rigd.runner.quick_looks import QuickLook
from rigd.runtime import ignore
from rigd.units import UNITS, unit_of
from rigd.view import Subject, sweep_of
from rigd.web._access import ICON, LIVE, Connections, WebAccess, object_of, refused
from rigd.web._jobs import Jobs
from rigd.web._library import Library
from rigd.web._link import BusyError, DaemonError, DaemonLink
from rigd.web._live import Pages
from rigd.web._signals import Block, SessionResponse, Strips, nominal_document

Document = dict[str, Any]

_LOOPBACK: Final = "127.0.0.1"
_COMMANDS: Final = frozenset({"start", "stop", "tare", "zero", "reset", "predict", "check"})
_STOPS: Final = 4
"""Limit of simultaneous stops, which have their own threads."""
_LONGEST_REQUEST: Final = 65_536
_KEEP_ALIVE_S: Final = 15.0
_LINGERING_S: Final = 1.0
_RESPONSE_S: Final = 1.0
_GRACE_S: Final = 0.3
_AT_WORK: Final = ("running", "stopping")
_FAILED: Final = "The page's server has failed; the daemon starts it again."
_STATIC_NAME: Final = re.compile(r"[a-z0-9_]+\.(html|css|js|svg|png|ico|webmanifest)")


class OperatorPageServer:
    """Server of one rig's page.

    Parameters
    ----------
    job
        Data of the rig from the daemon: see `rigd.daemon._page`.

    Attributes
    ----------
    pages
        Open pages.
    """

    def __init__(self, job: Document) -> None:
        self._job = job
        self._socket = Path(job["socket"])
        self._access = WebAccess(job["token"])
        self.pages = Pages()
        self._jobs = Jobs(Path(job["folder"]), self.pages.send)
        self._library = Library(Path(job["folder"]), self._access, self._jobs)
        self._stopping = ThreadPoolExecutor(_STOPS, "stop")
        self._link = DaemonLink(self._socket, self._take, self._report_loss)
        self._excitations = dict(_excitations())
        self._nominal = self._nominal_of(job)
        self._specimens: list[str] = []
        self._status: Document | None = None
        self._lost: Document | None = None
        self._gauges: Document | None = None
        self._strips = Strips()
        self._session: str | None = None
        self._response: SessionResponse | None = None
        self._shown: Document | None = None
        self._last: Document | None = None
        self._searches: set[asyncio.Task[None]] = set()

    def application(self) -> web.Application:
        """Return the application with its routes."""
        application = web.Application(
            middlewares=[self._access.guard], client_max_size=_LONGEST_REQUEST
        )
        application.on_response_prepare.append(self._access.protect)
        application.add_routes(
            [
                web.get("/", self._static),
                web.get("/static/{name}", self._static),
                web.get(ICON, self._static),
                web.get(LIVE, self._live),
                web.post("/api/command", self._command),
                *self._library.routes(),
            ]
        )
        return application

    async def run(self) -> None:
        """Follow the daemon and run jobs until cancelled."""
        await asyncio.gather(
            self._link.run(), self._jobs.run(), self._estimate(), self._find_specimens()
        )

    def end(self, reason: str) -> None:
        """Report the end of this server to the pages."""
        self._report_loss(reason)

    # Requests

    async def _static(self, request: web.Request) -> web.StreamResponse:
        """Return a static file of the page."""
        name = request.match_info.get(
            "name", "index.html" if request.path == "/" else "favicon.svg"
        )
        path = Path(str(files("rigd.web") / "static" / name))
        if not _STATIC_NAME.fullmatch(name) or not path.is_file():
            return refused(404, "There is no such file.")
        shared = {"Cross-Origin-Resource-Policy": "cross-origin"}
        return web.FileResponse(path, headers=shared if request.path == ICON else None)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        """Send live messages to an open page."""
        hello = {
            "type": "hello",
            "profile": self._job["profile"],
            "description": self._job["description"],
            "limits": self._job["limits"],
            "daemon": None if self._status is None else self._status["daemon"],
            "excitations": self._excitations,
            "specimens": self._specimens,
            "required_meta": self._job["required_meta"],
            "units": dict(UNITS),
        }
        known = (
            *(hello, self._lost, self._status, self._gauges, self._strips.last()),
            *(self._nominal, self._last, self._shown),
        )
        return await self.pages.follow(request, filter(None, known), self._stop_for_page)

    async def _command(self, request: web.Request) -> web.Response:
        """Send a command to the daemon and return its reply."""
        given = await object_of(request)
        command = given.get("command")
        if not isinstance(command, str) or command not in _COMMANDS:
            return refused(400, f"command: there are {', '.join(sorted(_COMMANDS))}.")
        if not self._access.may_command(request, command, given.get("parameters")):
            return refused(403, "The token is missing or wrong: open the address of rigd status.")
        try:
            if command == "stop":
                reply = await self._stop()
            else:
                reply = await self._link.ask(given)
        except (DaemonError, DaemonGoneError) as error:
            return refused(503, str(error))
        except (BusyError, RefusedByDaemonError) as error:
            return refused(409, str(error))
        finally:
            self._link.ask_for_status()
        status = 200 if reply.get("ok") else 400 if reply.get("wrong_use") else 409
        return web.json_response(reply, status=status)

    async def _stop(self) -> Document:
        """Stop the daemon's session, if need be by a signal, and return the reply."""
        self._link.note_stop()
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._stopping, stop_session, self._socket)

    async def _stop_for_page(self) -> Document:
        """Stop the daemon's session; return a failure as a refusal."""
        try:
            return await self._stop()
        except (DaemonGoneError, RefusedByDaemonError) as error:
            return {"ok": False, "error": str(error)}
        finally:
            self._link.ask_for_status()

    # Messages of the daemon

    def _take(self, message: Document) -> None:
        """Handle a message of the daemon, and send its content to the pages."""
        if self._lost is not None:
            self._lost = None
            self._link.ask_for_status()
        event = message.get("event")
        if event is None:
            self._take_status(message)
        elif event == "signals":
            self._take_signals(message)
        elif event == "fit":
            # The status contains the last fit, also for pages that open later.
            self._link.ask_for_status()
        elif event == "message":
            self.pages.note(message["level"], message["text"])
        else:
            del message["event"]
            self.pages.send({"type": event, **message})
            if event != "progress":
                self._link.ask_for_status()
            if event == "session":
                self._start_search(self._find_specimens())
            elif event == "quick_look":
                self.pages.note("info", "\n".join(QuickLook.of_event(message).lines))

    def _take_status(self, status: Document) -> None:
        self._status = {"type": "status", **status}
        self._jobs.paused = status["state"] in _AT_WORK
        series = status["series"]
        session = series["path"] if series is not None and series["running"] else None
        if session is not None and session != self._session:
            self._begin(session, series)
        self._session = session
        self.pages.send(self._status)

    def _begin(self, path: str, series: Document) -> None:
        """Prepare the frequency response of a new session."""
        plan, rate_hz = series["plan"], self._job["rate_hz"]
        self._nominal = self._nominal_of(plan)
        first, end = sweep_of(plan["segments"])
        self._shown = self._last = None
        self._response = None
        if series["excitation"] != "hold":
            self._response = SessionResponse(
                Subject(
                    Path(path).stem,
                    rate_hz,
                    round(plan["record_s"] * rate_hz),
                    (first, end),
                    Beam(**plan["beam"]),
                    Damping(**plan["damping"]),
                    self._job["tool_inertia_kg_m2"],
                    self._job["angle_delay_s"],
                    self._job["torque_delay_s"],
                )
            )
        self.pages.send(self._nominal)  # the pages then clear the other responses
        specimen = str(series["notes"].get("specimen", ""))
        self._start_search(self._find_last(specimen, Path(path).stem))

    def _nominal_of(self, specimen: Document) -> Document:
        """Return the message with the nominal model of the beam of a job or plan."""
        beam, damping = Beam(**specimen["beam"]), Damping(**specimen["damping"])
        return nominal_document(beam, damping, self._job["tool_inertia_kg_m2"])

    def _take_signals(self, event: Document) -> None:
        if event["count"]:
            block = Block.of_event(event)
            self.pages.send(self._strips.feed(block))
            if self._response is not None:
                self._response.feed(block)
        if event["gauges"] is not None:
            frequency_hz = event["frequency_hz"]
            self._gauges = {"type": "gauges", **event["gauges"], "frequency_hz": frequency_hz}
            self.pages.send(self._gauges)

    def _report_loss(self, reason: str) -> None:
        """Report to the pages that the daemon is lost."""
        if self._lost is None or self._lost["reason"] != reason:
            self._lost = {"type": "lost", "reason": reason}
            self.pages.send(self._lost)
        self._status = None

    async def _estimate(self) -> None:
        """Send the response of the running session periodically."""
        while True:
            await asyncio.sleep(_RESPONSE_S)
            if self._response is not None and self.pages:
                shown = self._response.document()
                self._shown = shown or self._shown
                self.pages.send(shown)

    def _start_search(self, finding: Awaitable[None]) -> None:
        """Start a search in the library without waiting for it."""
        task = asyncio.ensure_future(finding)
        self._searches.add(task)
        task.add_done_callback(self._searches.discard)

    async def _find_specimens(self) -> None:
        with suppress(OSError, ValueError):
            used = await self._library.specimens()
            self._specimens = list(dict.fromkeys([*used, *specimen_files()]))

    async def _find_last(self, specimen: str, but: str) -> None:
        with suppress(OSError, ValueError):
            self._last = await self._library.last_response(specimen, but)
            self.pages.send(self._last)


def _excitations() -> Iterator[tuple[str, list[Document]]]:
    """Yield name and options of each excitation, from its signature and docstring."""
    for name, function in KINDS.items():
        described = _descriptions(cleandoc(function.__doc__ or ""))
        yield (
            name,
            [
                {
                    "name": option.name,
                    "unit": unit_of(option.name),
                    "default": None if option.default is Parameter.empty else option.default,
                    "help": described.get(option.name, ""),
                }
                | ({"text": True} if option.annotation is str else {})
                for option in signature(function).parameters.values()
                if option.name not in FROM_THE_RIG
            ],
        )


def _descriptions(text: str) -> dict[str, str]:
    """Return the descriptions of the parameters in a docstring, by name."""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", text, re.DOTALL | re.MULTILINE)
    entries = re.findall(r"^(\S.*)\n((?: +.*\n?)+)", section[1], re.MULTILINE) if section else []
    return {
        name.strip(): " ".join(words.split())
        for names, words in entries
        for name in names.split(",")
    }


# Program


def run_page() -> None:
    """Serve the page until standard input ends; its first line is the job.

    Standard output gets one line with the port, and one with the reason if the page fails.
    """
    ignore()
    # No log: a stopped terminal (Ctrl-S) would block all pages, and invalid requests would fill the
    # journal.
    logging.disable()
    job = json.loads(sys.stdin.readline() or "null")
    if job is not None:
        asyncio.run(_run(job))


async def _run(job: Document) -> None:
    try:
        server, _, listening = await open_page(job)
    except OSError as error:
        _report(error=f"port {job['port']} cannot be had: {error.strerror}")
        return
    _report(port=port_of(listening))
    running = asyncio.create_task(server.run())
    gone = asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    await asyncio.wait((running, gone), return_when=asyncio.FIRST_COMPLETED)
    failed = running.done()
    if failed:
        _report(error=f"unexpected error ({running.exception()!r})")
    # The successor of this process or of the daemon may need the port.
    listening.close()
    server.end(_FAILED if failed else "The daemon has ended; start it with rigd serve.")
    await asyncio.sleep(_GRACE_S)
    # A regular exit would wait for reading clients and for the thread that reads stdin.
    os._exit(1 if failed else 0)


def _report(**message: Any) -> None:  # noqa: ANN401 - what JSON has
    """Send a message to the daemon, which reads standard output."""
    print(json.dumps(message), flush=True)  # noqa: T201


async def open_page(job: Document) -> tuple[OperatorPageServer, web.AppRunner, asyncio.Server]:
    """Listen on the port of a job, or on a free one if the job permits it.

    Parameters
    ----------
    job
        As for :class:`OperatorPageServer`, with ``port`` and ``any_port``.

    Returns
    -------
    tuple
        Server, to be run; application runner; listening socket.

    Raises
    ------
    OSError
        If the port is not available.
    """
    server, connections = OperatorPageServer(job), Connections()
    application = server.application()
    application.middlewares.append(connections.note_request)
    runner = web.AppRunner(
        application,
        access_log=None,
        handle_signals=False,
        auto_decompress=False,
        keepalive_timeout=_KEEP_ALIVE_S,
        lingering_time=_LINGERING_S,
        shutdown_timeout=_GRACE_S,
    )
    await runner.setup()
    assert runner.server is not None
    connections.serving = runner.server
    loop = asyncio.get_running_loop()
    try:
        listening = await loop.create_server(connections.welcome, _LOOPBACK, job["port"])
    except OSError:
        if not job["any_port"]:
            raise
        listening = await loop.create_server(connections.welcome, _LOOPBACK, 0)
    connections.close_silent()
    return server, runner, listening


def port_of(listening: asyncio.Server) -> int:
    """Return the port on which a server listens."""
    port: int = listening.sockets[0].getsockname()[1]
    return port
