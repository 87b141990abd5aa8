"""Sessions on the page: the library's rows, quick looks, reports and downloads.

The name of a session is the stem of its file. No address of the page contains a path.
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
from rigd.web._access import REPORT_POLICY, WebAccess, object_of, refused
from rigd.web._jobs import JobError, Jobs

Document = dict[str, Any]

_MOST_ROWS: Final = 1000
_ROWS: Final = 50
_MOST_IDS: Final = 100
_MOST_CURVES: Final = 12
_FILTERS: Final = ("specimen", "operator", "excitation", "outcome", "since", "until", "text")
_EXPORTS: Final = {"mat": ".mat", "uff": ".uff"}
_REPORT_FILES: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_SESSION_RUNS: Final = "A session runs; files are converted when it has ended."


class Library:
    """Server of the files in the sessions' folder only.

    Parameters
    ----------
    folder
        Folder of the session files.
    access
        Permission to create reports.
    jobs
        Queue for reports and exports.
    """

    def __init__(self, folder: Path, access: WebAccess, jobs: Jobs) -> None:
        self._folder = folder
        self._access = access
        self._jobs = jobs
        self._exporting = asyncio.Lock()
        self._listing = asyncio.Lock()
        """Lock for one list at a time, because lists may be slow and requests many."""

    def routes(self) -> list[web.RouteDef]:
        """Return the routes of the library."""
        return [
            web.get("/api/sessions", self._list),
            web.get("/api/sessions/{id}/file.{ending}", self._file),
            web.get("/api/sessions/{id}/look", self._quick_look),
            web.get("/api/sessions/{id}/report/", self._report),
            web.get("/api/sessions/{id}/report/{name}", self._report),
            web.post("/api/sessions/{id}/report", self._make_report),
            web.get("/api/campaign/{name}/", self._campaign),
            web.get("/api/campaign/{name}/{file}", self._campaign),
            web.post("/api/campaign", self._make_campaign),
            web.get("/api/frf", self._responses),
        ]

    async def rows(self, **filters: Any) -> list[SessionRow]:  # noqa: ANN401 - the library's
        """Return the sessions of the folder, newest first.

        Parameters
        ----------
        **filters
            As for `rigd.library.list_sessions`.
        """
        async with self._listing:
            return await asyncio.to_thread(list_sessions, self._folder, **filters)

    async def specimens(self) -> list[str]:
        """Return the specimens of all sessions, the latest first."""
        return list(dict.fromkeys(row.specimen for row in await self.rows() if row.specimen))

    async def last_response(self, specimen: str, but: str) -> Document | None:
        """Return the response of the last session of a specimen, as a message for the page.

        Parameters
        ----------
        specimen
            Name of the specimen; empty: of the last session without a name.
        but
            Session to exclude, because it is running.
        """
        found = await asyncio.to_thread(
            partial(last_quick_look, self._folder, specimen, but=but, usable=itemgetter("response"))
        )
        if found is None:
            return None
        path, quick_look = found
        where = {"type": "last", "path": str(path), "specimen": specimen}
        return {**quick_look["response"], **where, "id": path.stem}

    # Rows

    async def _list(self, request: web.Request) -> web.Response:
        filters = {name: value for name in _FILTERS if (value := request.query.get(name))}
        limit, offset = (
            _whole(request.query.get(name, str(usual)), name)
            for name, usual in (("limit", _ROWS), ("offset", 0))
        )
        rows = await self.rows(**filters)
        shown = rows[offset : offset + min(limit, _MOST_ROWS)]
        return web.json_response({"total": len(rows), "sessions": [row.as_dict() for row in shown]})

    async def _quick_look(self, request: web.Request) -> web.Response:
        quick_look = self._read_quick_look(self._session(request).stem)
        return (
            refused(404, "There is no quick look of it.")
            if quick_look is None
            else web.json_response(quick_look)
        )

    async def _responses(self, request: web.Request) -> web.Response:
        """Return fitted models and measured responses of several sessions for comparison."""
        ids = [name for name in request.query.get("ids", "").split(",") if name]
        if not 1 <= len(ids) <= _MOST_CURVES:
            return refused(400, f"ids: name 1 to {_MOST_CURVES} sessions.")
        responses, errors = [], []
        for name in ids:
            quick_look = self._read_quick_look(self._path(name).stem)
            if quick_look is None or quick_look["response"] is None:
                errors.append(f"{name}: there is no quick look of it, and so no response.")
            else:
                about = {
                    "id": name,
                    "specimen": quick_look["specimen"],
                    "model": quick_look["model"],
                }
                responses.append({**about, **quick_look["response"]})
        return web.json_response({"responses": responses, "errors": errors})

    # Downloads

    async def _file(self, request: web.Request) -> web.StreamResponse:
        path = self._session(request)
        ending = request.match_info["ending"]
        if ending == "mcap":
            return web.FileResponse(path, headers=_download_headers(path.name))
        if ending not in _EXPORTS:
            return refused(404, "There are .mcap, .mat and .uff.")
        if self._jobs.paused:
            return refused(409, _SESSION_RUNS)
        # A browser has few connections to a server, so none may wait here for another.
        if self._exporting.locked():
            return refused(409, "Another file is being converted; try again when it is done.")
        async with self._exporting:
            with tempfile.TemporaryDirectory(prefix="rigd-page-") as folder:
                out = Path(folder) / f"{path.stem}{_EXPORTS[ending]}"
                arguments = ("export", "record", str(path), str(out))
                try:
                    job = self._jobs.put("export", arguments, path.stem)
                except JobError as error:
                    return refused(409, str(error))
                await self._jobs.await_or_drop(job)
                if job.dropped:
                    return refused(409, _SESSION_RUNS)
                if job.error:
                    return refused(409, job.error)
                # The open file can be sent after its folder is deleted.
                return web.Response(body=out.open("rb"), headers=_download_headers(out.name))

    # Reports

    async def _report(self, request: web.Request) -> web.StreamResponse:
        path = self._session(request)
        found = next((row for row in await self.rows() if row.path.name == path.name), None)
        if found is None or found.report is None:
            return refused(404, "There is no report of it.")
        return self._page_of(found.report.parent, request.match_info.get("name", REPORT_PAGE))

    async def _campaign(self, request: web.Request) -> web.StreamResponse:
        folder = self._inside(request.match_info["name"])
        if not folder.name.startswith("campaign.report"):
            return refused(404, "There is no such campaign.")
        return self._page_of(folder, request.match_info.get("file", REPORT_PAGE))

    def _page_of(self, folder: Path, name: str) -> web.StreamResponse:
        """Return one file of a report, which must be a regular file in its folder."""
        if not _REPORT_FILES.fullmatch(name):
            return refused(404, "There is no such file.")
        path = (folder / name).resolve()
        if path.parent.parent != self._folder.resolve() or not path.is_file():
            return refused(404, "There is no such file.")
        return web.FileResponse(path, headers={"Content-Security-Policy": REPORT_POLICY})

    async def _make_report(self, request: web.Request) -> web.Response:
        if not self._access.may_act(request):
            return refused(403, "Making a report needs the token of the printed address.")
        path = self._session(request)
        address = f"/api/sessions/{path.stem}/report/"
        return self._queue("report", [str(path)], path.stem, address)

    async def _make_campaign(self, request: web.Request) -> web.Response:
        if not self._access.may_act(request):
            return refused(403, "A campaign needs the token of the printed address.")
        given = await object_of(request)
        ids = given.get("ids")
        if (
            not isinstance(ids, list)
            or not 2 <= len(ids) <= _MOST_IDS
            or not all(isinstance(name, str) for name in ids)
        ):
            return refused(400, f"ids: name 2 to {_MOST_IDS} sessions.")
        paths = sorted({str(self._path(name)) for name in ids})  # in the order of recording
        folder = self._free("campaign.report")
        arguments = [*paths, "--jobs", "1", "--report", str(folder)]
        return self._queue("campaign", arguments, "", _served_at(folder))

    def _queue(self, kind: str, arguments: list[str], name: str, address: str) -> web.Response:
        try:
            job = self._jobs.put(kind, arguments, name, address)
        except JobError as error:
            return refused(409, str(error))
        return web.json_response({"ok": True, "job": job.number}, status=202)

    def _free(self, name: str) -> Path:
        """Return an unused folder name, which no waiting campaign will create either."""
        number, path = 1, self._folder / name
        while path.exists() or _served_at(path) in self._jobs.addresses:
            number += 1
            path = self._folder / f"{name}-{number}"
        return path

    # Names

    def _session(self, request: web.Request) -> Path:
        return self._path(request.match_info["id"])

    def _path(self, name: str) -> Path:
        """Return the file of a session.

        Raises
        ------
        HTTPNotFound
            If the folder has no regular file of that name.
        """
        path = self._inside(f"{name}.mcap")
        if not path.is_file():
            raise web.HTTPNotFound(reason="There is no such session.")
        return path

    def _inside(self, name: str) -> Path:
        """Return the path of a name in the folder.

        Raises
        ------
        HTTPNotFound
            If the name is a path, or a link out of the folder.
        """
        with suppress(OSError, ValueError):
            path = self._folder / name
            plain = Path(name).name == name and not name.startswith(".") and name.isprintable()
            path.lstat()  # raises if it does not exist or the name is too long
            if plain and path.resolve().parent == self._folder.resolve():
                return path
        raise web.HTTPNotFound(reason="There is no such session.")

    def _read_quick_look(self, name: str) -> Document | None:
        """Return the quick look of a session; None if there is none or it is unreadable."""
        with suppress(web.HTTPNotFound):
            return read_quick_look(self._inside(f"{name}{QUICK_LOOK_SUFFIX}"))
        return None


def _served_at(folder: Path) -> str:
    """Return the path at which a campaign's report is served."""
    return f"/api/campaign/{folder.name}/"


def _download_headers(name: str) -> dict[str, str]:
    # The name of a session may contain any character of file names.
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", name)
    return {
        "Content-Disposition": f'attachment; filename="{plain}"',
        "Content-Type": "application/octet-stream",
    }


def _whole(text: str, name: str) -> int:
    if not text.isdecimal() or len(text) > len(str(_MOST_ROWS)) + 3:
        raise web.HTTPBadRequest(reason=f"{name} is not a whole number.")
    return int(text)
