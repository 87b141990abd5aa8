"""Routes for recorded sessions: their list, quick looks, reports and downloads.

The name of a session is the stem of its file. No URL of this server contains the path of a file.
"""

import asyncio
import re
import tempfile
from contextlib import suppress
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

from aiohttp import web

from rigd.library import REPORT_PAGE, SessionRow, list_sessions
from rigd.session.quick_look import QUICK_LOOK_SUFFIX, last_quick_look, read_quick_look
from rigd.web._access import REPORT_POLICY, WebAccess, read_json_object, refusal_response
from rigd.web._jobs import JobError, JobQueue

Document = dict[str, Any]

_MAX_ROW_LIMIT: Final = 1000
"""Largest number of sessions in one reply."""
_DEFAULT_ROW_LIMIT: Final = 50
"""Default number of sessions in one reply."""
_MAX_CAMPAIGN_SESSIONS: Final = 100
"""Largest number of sessions in a campaign."""
_MAX_COMPARED_RESPONSES: Final = 12
"""Largest number of frequency responses in one reply."""
_FILTER_NAMES: Final = ("specimen", "operator", "excitation", "outcome", "since", "until", "text")
"""Query parameters that filter the list of sessions."""
_EXPORT_SUFFIXES: Final = {"mat": ".mat", "uff": ".uff"}
"""Suffixes of files that sessions can be converted into, by the end of the URL."""
_REPORT_FILE_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
"""Pattern of the names of a report's files."""
_SESSION_RUNS_MESSAGE: Final = "A session runs; files are converted when it has ended."
"""Message that refuses to convert a file."""


class Library:
    """Serves the sessions of one folder to the page, but no other files of the computer.

    `access` permits reports, `jobs` is the queue for reports and exports.
    """

    def __init__(self, folder: Path, access: WebAccess, jobs: JobQueue) -> None:
        self._folder = folder
        self._access = access
        self._jobs = jobs
        self._exporting = asyncio.Lock()
        self._list_lock = asyncio.Lock()
        """Lock so that one list is made at a time, because lists may be slow and requests many."""

    def routes(self) -> list[web.RouteDef]:
        """Return the HTTP routes of the recorded sessions."""
        return [
            web.get("/api/sessions", self._list_sessions),
            web.get("/api/sessions/{id}/file.{ending}", self._send_file),
            web.get("/api/sessions/{id}/look", self._send_quick_look),
            web.get("/api/sessions/{id}/report/", self._send_report),
            web.get("/api/sessions/{id}/report/{name}", self._send_report),
            web.post("/api/sessions/{id}/report", self._make_report),
            web.get("/api/campaign/{name}/", self._send_campaign_report),
            web.get("/api/campaign/{name}/{file}", self._send_campaign_report),
            web.post("/api/campaign", self._make_campaign),
            web.get("/api/frf", self._send_responses),
        ]

    async def matching_rows(self, **filters: Any) -> list[SessionRow]:  # noqa: ANN401 - the library's
        """Return the sessions that pass filters as of `list_sessions`, the newest first."""
        async with self._list_lock:
            return await asyncio.to_thread(list_sessions, self._folder, **filters)

    async def specimens(self) -> list[str]:
        """Return the names of the specimens of all sessions, the most recent first."""
        return list(
            dict.fromkeys(row.specimen for row in await self.matching_rows() if row.specimen)
        )

    async def last_response(self, specimen: str, excluded_session: str) -> Document | None:
        """Return the message with the frequency response of a specimen's last session, or None.

        An empty name selects sessions without a specimen. A running session can be excluded by
        its name.
        """
        newest_pair = await asyncio.to_thread(
            partial(
                last_quick_look,
                self._folder,
                specimen,
                excluded_session=excluded_session,
                is_usable=itemgetter("response"),
            )
        )
        if newest_pair is None:
            return None
        document_path, quick_look = newest_pair
        message_fields = {"type": "last", "path": str(document_path), "specimen": specimen}
        return {**quick_look["response"], **message_fields, "id": document_path.stem}

    # Rows

    async def _list_sessions(self, request: web.Request) -> web.Response:
        """Reply with a part of the filtered list of recorded sessions."""
        filters = {
            filter_name: filter_value
            for filter_name in _FILTER_NAMES
            if (filter_value := request.query.get(filter_name))
        }
        row_limit, first_row = (
            _whole_number(request.query.get(filter_name, str(default_number)), filter_name)
            for filter_name, default_number in (("limit", _DEFAULT_ROW_LIMIT), ("offset", 0))
        )
        session_rows = await self.matching_rows(**filters)
        shown_rows = session_rows[first_row : first_row + min(row_limit, _MAX_ROW_LIMIT)]
        return web.json_response(
            {"total": len(session_rows), "sessions": [row.as_dict() for row in shown_rows]}
        )

    async def _send_quick_look(self, request: web.Request) -> web.Response:
        """Send the quick look of a session."""
        quick_look = self._read_quick_look(self._requested_session(request).stem)
        return (
            refusal_response(404, "There is no quick look of it.")
            if quick_look is None
            else web.json_response(quick_look)
        )

    async def _send_responses(self, request: web.Request) -> web.Response:
        """Send fitted models and measured responses of several sessions for comparison."""
        session_names = [
            session_name for session_name in request.query.get("ids", "").split(",") if session_name
        ]
        if not 1 <= len(session_names) <= _MAX_COMPARED_RESPONSES:
            return refusal_response(400, f"ids: name 1 to {_MAX_COMPARED_RESPONSES} sessions.")
        responses, error_texts = [], []
        for session_name in session_names:
            quick_look = self._read_quick_look(self._session_path(session_name).stem)
            if quick_look is None or quick_look["response"] is None:
                error_texts.append(
                    f"{session_name}: there is no quick look of it, and so no response."
                )
            else:
                session_identity = {
                    "id": session_name,
                    "specimen": quick_look["specimen"],
                    "model": quick_look["model"],
                }
                responses.append({**session_identity, **quick_look["response"]})
        return web.json_response({"responses": responses, "errors": error_texts})

    # Downloads

    async def _send_file(self, request: web.Request) -> web.StreamResponse:
        """Send a session file, or the session converted into another format."""
        session_path = self._requested_session(request)
        file_ending = request.match_info["ending"]
        if file_ending == "mcap":
            return web.FileResponse(session_path, headers=_download_headers(session_path.name))
        if file_ending not in _EXPORT_SUFFIXES:
            return refusal_response(404, "Choose .mcap, .mat or .uff.")
        if self._jobs.paused:
            return refusal_response(409, _SESSION_RUNS_MESSAGE)
        # A browser has few connections to a server, so none may wait here for another.
        if self._exporting.locked():
            return refusal_response(
                409, "Another file is being converted; try again when it is done."
            )
        async with self._exporting:
            with tempfile.TemporaryDirectory(prefix="rigd-page-") as temporary_folder:
                export_path = (
                    Path(temporary_folder) / f"{session_path.stem}{_EXPORT_SUFFIXES[file_ending]}"
                )
                analyze_arguments = ("export", "record", str(session_path), str(export_path))
                try:
                    export_job = self._jobs.add_job("export", analyze_arguments, session_path.stem)
                except JobError as error:
                    return refusal_response(409, str(error))
                await self._jobs.await_or_drop(export_job)
                if export_job.is_dropped:
                    return refusal_response(409, _SESSION_RUNS_MESSAGE)
                if export_job.error:
                    return refusal_response(409, export_job.error)
                # The open file can be sent after its folder is deleted.
                return web.Response(
                    body=export_path.open("rb"), headers=_download_headers(export_path.name)
                )

    # Reports

    async def _send_report(self, request: web.Request) -> web.StreamResponse:
        """Send one file of the analysis report of a session."""
        session_path = self._requested_session(request)
        session_row = next(
            (row for row in await self.matching_rows() if row.path.name == session_path.name), None
        )
        if session_row is None or session_row.report is None:
            return refusal_response(404, "There is no report of it.")
        return self._report_file(
            session_row.report.parent, request.match_info.get("name", REPORT_PAGE)
        )

    async def _send_campaign_report(self, request: web.Request) -> web.StreamResponse:
        """Send one file of the analysis report of a campaign."""
        report_folder = self._path_in_folder(request.match_info["name"])
        if not report_folder.name.startswith("campaign.report"):
            return refusal_response(404, "There is no such campaign.")
        return self._report_file(report_folder, request.match_info.get("file", REPORT_PAGE))

    def _report_file(self, report_folder: Path, file_name: str) -> web.StreamResponse:
        """Return the HTTP response with a file of a report, or a refusal.

        Only regular files in the report's folder are served.
        """
        if not _REPORT_FILE_NAME.fullmatch(file_name):
            return refusal_response(404, "There is no such file.")
        file_path = (report_folder / file_name).resolve()
        if file_path.parent.parent != self._folder.resolve() or not file_path.is_file():
            return refusal_response(404, "There is no such file.")
        return web.FileResponse(file_path, headers={"Content-Security-Policy": REPORT_POLICY})

    async def _make_report(self, request: web.Request) -> web.Response:
        """Queue the job that writes the analysis report of a recorded session."""
        if not self._access.may_act(request):
            return refusal_response(403, "Making a report needs the token of the printed address.")
        session_path = self._requested_session(request)
        report_url = f"/api/sessions/{session_path.stem}/report/"
        return self._queue_job("report", [str(session_path)], session_path.stem, report_url)

    async def _make_campaign(self, request: web.Request) -> web.Response:
        """Queue the job that writes one analysis report on several sessions."""
        if not self._access.may_act(request):
            return refusal_response(403, "A campaign needs the token of the printed address.")
        request_object = await read_json_object(request)
        session_names = request_object.get("ids")
        if (
            not isinstance(session_names, list)
            or not 2 <= len(session_names) <= _MAX_CAMPAIGN_SESSIONS
            or not all(isinstance(session_name, str) for session_name in session_names)
        ):
            return refusal_response(400, f"ids: name 2 to {_MAX_CAMPAIGN_SESSIONS} sessions.")
        session_paths = sorted(
            {str(self._session_path(session_name)) for session_name in session_names}
        )  # in the order of recording
        report_folder = self._unused_folder("campaign.report")
        analyze_arguments = [*session_paths, "--jobs", "1", "--report", str(report_folder)]
        return self._queue_job("campaign", analyze_arguments, "", _campaign_url_path(report_folder))

    def _queue_job(
        self, job_kind: str, analyze_arguments: list[str], session_name: str, report_url: str
    ) -> web.Response:
        """Queue a job, and return the HTTP response: its number, or a refusal."""
        try:
            job = self._jobs.add_job(job_kind, analyze_arguments, session_name, report_url)
        except JobError as error:
            return refusal_response(409, str(error))
        return web.json_response({"ok": True, "job": job.number}, status=202)

    def _unused_folder(self, folder_name: str) -> Path:
        """Return the path of a new folder that no queued campaign will create either."""
        folder_number, folder_path = 1, self._folder / folder_name
        while folder_path.exists() or _campaign_url_path(folder_path) in self._jobs.result_urls:
            folder_number += 1
            folder_path = self._folder / f"{folder_name}-{folder_number}"
        return folder_path

    # Names

    def _requested_session(self, request: web.Request) -> Path:
        """Return the file of the session that a request names."""
        return self._session_path(request.match_info["id"])

    def _session_path(self, session_name: str) -> Path:
        """Return the file of the session with the given name.

        Raise `HTTPNotFound` if the folder has no regular file of that name.
        """
        session_file = self._path_in_folder(f"{session_name}.mcap")
        if not session_file.is_file():
            raise web.HTTPNotFound(reason="There is no such session.")
        return session_file

    def _path_in_folder(self, file_name: str) -> Path:
        """Return the path of a file or folder in the sessions' folder by its name.

        Raise `HTTPNotFound` if the name is a path, a link out of the folder, or does not exist.
        """
        with suppress(OSError, ValueError):
            path = self._folder / file_name
            is_plain_name = (
                Path(file_name).name == file_name
                and not file_name.startswith(".")
                and file_name.isprintable()
            )
            path.lstat()  # raises if it does not exist or the name is too long
            if is_plain_name and path.resolve().parent == self._folder.resolve():
                return path
        raise web.HTTPNotFound(reason="There is no such session.")

    def _read_quick_look(self, session_name: str) -> Document | None:
        """Return the quick look of a session, or None if there is none or it is unreadable."""
        with suppress(web.HTTPNotFound):
            return read_quick_look(self._path_in_folder(f"{session_name}{QUICK_LOOK_SUFFIX}"))
        return None


def _campaign_url_path(folder: Path) -> str:
    """Return the URL path at which a campaign's report is served."""
    return f"/api/campaign/{folder.name}/"


def _download_headers(file_name: str) -> dict[str, str]:
    """Return the HTTP headers that make a browser save a file under a name."""
    # The name of a session may contain any character of file names.
    plain_name = re.sub(r"[^A-Za-z0-9_.-]", "_", file_name)
    return {
        "Content-Disposition": f'attachment; filename="{plain_name}"',
        "Content-Type": "application/octet-stream",
    }


def _whole_number(parameter_text: str, parameter_name: str) -> int:
    """Return a URL's query parameter as a whole number, or raise HTTPBadRequest."""
    if not parameter_text.isdecimal() or len(parameter_text) > len(str(_MAX_ROW_LIMIT)) + 3:
        raise web.HTTPBadRequest(reason=f"{parameter_name} is not a whole number.")
    return int(parameter_text)
