"""Sessions on the page: rows, quick looks, downloads, reports, and the jobs that make them."""

import asyncio
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from cases import further
from processes import eventually
from web_daemon import MAX_JOBS, TOKEN, JobError, Jobs

from rigd.engine.workers import REPORT

ACTING = {
    "Authorization": f"Bearer {TOKEN}",
    "X-Rigd": "1",
    "Content-Type": "application/json",
}


@pytest.fixture
def two_sessions(served, record_briefly, write_quick_look, replace_in_page):
    """Two sessions, of which one has a quick look and a report."""
    # A job of the idle class may wait for minutes while other tests run.
    replace_in_page(worker=replace(REPORT, niceness=0))
    for name, specimen in (("first", "antenna"), ("second", "")):
        record_briefly(name, day=float(name == "second"), specimen=specimen).replace(
            served.folder / f"{name}.mcap"
        )
    response = {"frequency_hz": [1.0], "magnitude": [2.0], "phase_rad": [0.0], "coherence": [1.0]}
    quick_look = {"version": 1, "specimen": "antenna", "modes": [], "response": response}
    (served.folder / "first.look.json").write_text(json.dumps(quick_look))
    report = served.folder / "first.report"
    report.mkdir(exist_ok=True)
    (report / "report.html").write_text("<style>p {}</style><p>A report")
    (report / "fits.csv").write_text("a,b")
    return response | {"resolution_hz": None}


def get(served, target):
    status, head, body = served.request("GET", target)
    return status, head, json.loads(body) if "application/json" in head else body


def test_rows_are_those_of_the_library(served, two_sessions):
    _, _, found = get(served, "/api/sessions?excitation=chirp")
    assert found["total"] == 2
    assert [row["id"] for row in found["sessions"]] == ["second", "first"]
    _, _, found = get(served, "/api/sessions?specimen=antenna")
    assert [row["id"] for row in found["sessions"]] == ["first"]
    assert found["sessions"][0]["missed"] == 7
    _, _, found = get(served, "/api/sessions?limit=1&offset=1")
    assert (found["total"], [row["id"] for row in found["sessions"]]) == (2, ["first"])


def test_error_message_if_no_list_can_be_made(served, replace_in_page):
    status, _, reply = get(served, "/api/sessions?since=abc")
    assert status == 400
    assert "abc" in reply["error"]
    replace_in_page(list_sessions={}.popitem)
    status, _, reply = get(served, "/api/sessions")
    assert status == 500
    assert "The page's server failed: " in reply["error"]


def test_files_quick_looks_reports_and_responses_are_served(served, two_sessions):
    status, head, body = get(served, "/api/sessions/first/file.mcap")
    assert (status, body) == (200, (served.folder / "first.mcap").read_bytes())
    assert 'attachment; filename="first.mcap"' in head
    assert get(served, "/api/sessions/first/look")[2]["response"] == two_sessions
    assert get(served, "/api/sessions/second/look")[0] == 404
    (served.folder / "folder.mcap").mkdir()
    assert get(served, "/api/sessions/folder/file.mcap")[0] == 404
    (served.folder / "folder.mcap").rmdir()
    status, head, body = get(served, "/api/sessions/first/report/")
    assert (status, body[-8:]) == (200, b"A report")
    assert "sandbox" in head
    assert "script-src" not in head.replace("default-src 'none'", "")
    assert get(served, "/api/sessions/first/report/fits.csv")[2] == b"a,b"
    assert get(served, "/api/sessions/second/report/")[0] == 404
    _, _, overlay = get(served, "/api/frf?ids=first,second")
    assert overlay["responses"] == [
        {"id": "first", "specimen": "antenna", "model": None, **two_sessions}
    ]
    assert "second" in overlay["errors"][0]


@pytest.mark.parametrize(
    ("quick_look", "status"),
    [
        pytest.param(b"[" * 100_000, 404, id="nested lists"),
        further(b'{"version": 1, "response": ' * 50_000, 404, id="nested objects"),
        pytest.param(
            b'{"version": 1, "peak": 1e999, "response": {"magnitude": [1e999, NaN]}}',
            200,
            id="no numbers",
        ),
        further(b'{"version": 1, "response": [1]}', 200, id="no response"),
        further(b"7", 404, id="no look"),
    ],
)
def test_list_and_overlay_with_a_damaged_quick_look(served, two_sessions, quick_look, status):
    (served.folder / "first.look.json").write_bytes(quick_look)
    assert [row["id"] for row in get(served, "/api/sessions")[2]["sessions"]] == ["second", "first"]
    found, _, body = served.request("GET", "/api/sessions/first/look")
    assert found == status
    json.loads(body, parse_constant=pytest.fail)
    _, _, overlay = get(served, "/api/frf?ids=first")
    assert (overlay["responses"], len(overlay["errors"])) == ([], 1)
    finding = served.server._library.last_response("antenna", "second")
    assert asyncio.run_coroutine_threadsafe(finding, served.loop).result(30.0) is None


@pytest.mark.usefixtures("two_sessions")
def test_last_response_of_an_earlier_session_is_dropped(served):
    """The search of a session may end after the next one has begun."""
    server = served.server

    def search(session_path):
        sent = server._send_last_response("antenna", session_path)
        asyncio.run_coroutine_threadsafe(sent, served.loop).result(30.0)
        return server._last_response

    server._latest_session = "second.mcap"
    assert search("older.mcap") is None
    assert search("second.mcap") is not None


def test_download_in_another_format(served, two_sessions):
    assert eventually(lambda: not served.server._jobs.paused)
    status, head, body = get(served, "/api/sessions/first/file.mat")
    assert (status, body[:6]) == (200, b"MATLAB"), body
    assert 'filename="first.mat"' in head


@pytest.mark.usefixtures("two_sessions")
@pytest.mark.parametrize("begun", [True, False], ids=["running", "behind another job"])
def test_new_session_ends_the_wait_for_another_format(served, run_instead, tmp_path, begun):
    assert eventually(lambda: not served.server._jobs.paused)
    run_instead(WAITING_PROGRAM.format(tmp_path))
    if not begun:
        assert served.request("POST", "/api/sessions/second/report", ACTING, b"{}")[0] == 202
    try:
        with ThreadPoolExecutor(1) as other:
            waiting = other.submit(get, served, "/api/sessions/first/file.mat")
            assert eventually((tmp_path / "begun").exists)
            assert eventually(served.server._library._exporting.locked)
            status, _, reply = get(served, "/api/sessions/second/file.uff")
            assert (status, "being converted" in reply["error"]) == (409, True)
            served.daemon.status["state"] = "running"
            status, _, reply = waiting.result(30.0)
            assert (status, "A session runs" in reply["error"]) == (409, True)
            # A report continues after the session, and may end here.
            (tmp_path / "end").touch()
    finally:
        served.daemon.status["state"] = "ready"
    assert eventually(lambda: not served.server._jobs.paused)


WAITING_PROGRAM = """
import pathlib, time
folder = pathlib.Path("{}")
(folder / "begun").touch()
while not (folder / "end").exists():
    time.sleep(0.01)
"""


@pytest.fixture
def jobs(tmp_path, run_instead):
    """Jobs whose program runs the given Python code."""
    run_instead(poll_s=0.02)
    documents = []
    jobs = Jobs(tmp_path, documents.append)
    jobs.documents = documents
    return jobs


def run(jobs, scenario):
    async def whole():
        running = asyncio.create_task(jobs.run())
        try:
            return await asyncio.wait_for(scenario(), 60.0)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    return asyncio.run(whole())


def state_of(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "gone"


def test_job_is_suspended_during_a_session(jobs, tmp_path):
    program = (
        "import os, pathlib, time\n"
        "while os.sched_getscheduler(0) != os.SCHED_IDLE: time.sleep(0.01)\n"
        "pathlib.Path('pid').write_text(f'{os.getpid()} {os.getpriority(os.PRIO_PROCESS, 0)}')\n"
        "time.sleep(600)"
    )

    async def wait_for(condition):
        while not condition():
            await asyncio.sleep(0.01)

    async def scenario():
        job = jobs.add_job("report", [program], "a")
        await asyncio.sleep(0.1)
        assert not (tmp_path / "pid").exists()  # it has not begun
        jobs.paused = False
        await wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
        pid, niceness = map(int, (tmp_path / "pid").read_text().split())
        jobs.paused = True
        await wait_for(lambda: state_of(pid) == "T")
        jobs.paused = False
        await wait_for(lambda: state_of(pid) == "S")
        assert job.state == "running"
        assert Path(f"/proc/{pid}/oom_score_adj").read_text() == "1000\n"
        return pid, niceness

    pid, niceness = run(jobs, scenario)
    assert niceness == 19
    assert eventually(lambda: state_of(pid) in ("Z", "gone"))  # it ended with the server


PAGE_PROGRAM = """
import asyncio, os, pathlib, sys
from dataclasses import replace
from rigd.runtime import ignore_end_signals
from rigd.web import _jobs

ignore_end_signals()
_jobs.REPORT = replace(_jobs.REPORT, module="stand_in")
_jobs._POLL_PERIOD_S = 0.02

async def work():
    jobs = _jobs.JobQueue(pathlib.Path(), lambda _: None)
    jobs.add_job("report", [sys.argv[1]])
    jobs.paused = False
    asyncio.create_task(jobs.run())
    while not pathlib.Path("pids").exists():
        await asyncio.sleep(0.01)
    jobs.paused = sys.argv[2] == "suspended"
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    os._exit(0)

asyncio.run(work())
"""
WORKER_PROGRAM = """
import os, pathlib, subprocess, time

pids = [os.getpid(), subprocess.Popen(["sleep", "600"]).pid]
pathlib.Path("new").write_text(" ".join(map(str, pids)))
os.rename("new", "pids")
time.sleep(600)
"""


@pytest.mark.process
@pytest.mark.parametrize(
    ("state", "end"),
    [
        ("suspended", "killed"),
        ("running", "ended"),
        further("suspended", "ended"),
        further("running", "killed"),
    ],
)
@pytest.mark.usefixtures("jobs")
def test_job_ends_with_the_page(tmp_path, state, end):
    page = subprocess.Popen(
        [sys.executable, "-c", PAGE_PROGRAM, WORKER_PROGRAM, state],
        cwd=tmp_path,
        stdin=subprocess.PIPE,
    )
    pids = []
    try:
        assert eventually((tmp_path / "pids").exists)
        pids = list(map(int, (tmp_path / "pids").read_text().split()))
        expected = "T" if state == "suspended" else "S"
        assert eventually(lambda: {state_of(pid) for pid in pids} == {expected})
        if end == "killed":
            page.kill()
        page.communicate(timeout=60.0)
        # Workers that run detect the end of their parent themselves.
        ended = pids if state == "suspended" else pids[:1]
        assert eventually(lambda: {state_of(pid) for pid in ended} <= {"Z", "gone"}, within_s=10.0)
    finally:
        page.kill()
        page.wait()
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def test_results_of_jobs_are_published(jobs):
    async def scenario():
        jobs.paused = False
        done = jobs.add_job("campaign", ["pass"], result_url="/api/campaign/x/")
        failed = jobs.add_job("report", ["import sys; sys.exit('too short')"], "b", "/there")
        await failed.end_event.wait()
        assert done.end_event.is_set()

    run(jobs, scenario)
    last = {document["number"]: document for document in jobs.documents}
    assert (last[1]["state"], last[1]["address"]) == ("done", "/api/campaign/x/")
    assert (last[2]["state"], last[2]["address"]) == ("failed", "")
    assert last[2]["error"] == "The report was not made: too short"


def test_number_of_waiting_jobs_is_limited(jobs):
    async def scenario():
        for _ in range(MAX_JOBS + 1):
            await asyncio.sleep(0)
            jobs.add_job("report", ["pass"])
        with pytest.raises(JobError):
            jobs.add_job("report", ["pass"])

    run(jobs, scenario)


def test_report_and_campaign_are_queued_with_the_token(
    served, two_sessions, monkeypatch, run_instead
):
    run_instead("pass")
    documents = []
    monkeypatch.setattr(served.server._jobs, "_publish", documents.append)
    status, _, body = served.request("POST", "/api/sessions/first/report", ACTING, b"{}")
    assert (status, json.loads(body)["ok"]) == (202, True)
    ids = json.dumps({"ids": ["first", "second"]}).encode()
    assert served.request("POST", "/api/campaign", ACTING, ids)[0] == 202
    assert eventually(lambda: [job["kind"] for job in documents if job["state"] == "done"] == KINDS)


KINDS = ["report", "campaign"]


@pytest.mark.usefixtures("two_sessions")
def test_waiting_campaigns_have_a_folder_each(served, monkeypatch, run_instead):
    making = "import os; os.mkdir(sys.argv[-1])"  # at its end, and never over another
    run_instead(making)
    documents = []
    monkeypatch.setattr(served.server._jobs, "_publish", documents.append)
    ids = json.dumps({"ids": ["first", "second"]}).encode()
    served.daemon.status["state"] = "running"
    try:
        assert eventually(lambda: served.server._jobs.paused)
        for _ in range(2):
            assert served.request("POST", "/api/campaign", ACTING, ids)[0] == 202
    finally:
        served.daemon.status["state"] = "ready"
    over = ("done", "failed")
    assert eventually(lambda: sum(job["state"] in over for job in documents) == 2)
    made = [(job["error"], job["address"]) for job in documents if job["state"] in over]
    folders = ("campaign.report", "campaign.report-2")
    assert made == [("", f"/api/campaign/{folder}/") for folder in folders]
