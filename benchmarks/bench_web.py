"""Cost of the operator's page: processor time, memory, and wake-up latency of the loop.

    python benchmarks/bench_web.py [SECONDS] [ROUNDS]

In each round a daemon with its page runs a chirp at 1 kHz with no page open, with one, and with ten
of which one is suspended. Processor time and memory (PSS) are those of the process of the daemon
and of the page server; the delay of a strip is the time from its last tick to its arrival. The
ratio is the median over the rounds. With 10 s and 3 rounds it takes two and a half minutes.
"""

import argparse
import asyncio
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import aiohttp
import numpy as np
from bench_live import cpu_s
from gate import Gate, Row

from rigd.daemon import page_address
from rigd.daemon.address import find_daemon_socket
from rigd.daemon.client import Client
from rigd.session import read_session

RIGD = Path(sys.executable).parent / "rigd"
ROWS = (
    # docs/decisions/0011-the-page-is-a-client.md has the limits.
    Row("page loaded", most=1, unit="s"),
    Row("daemon and page, one page open", most=6, unit="% of a core"),
    Row("memory of daemon and page", most=150, unit="MB"),
    Row("delay of a strip, 99 %", most=0.3, unit="s"),
    Row("samples lost", most=0),
    Row("lateness p99, ten pages", most=1.2, unit="times none"),
)
_PATIENCE_S = 60.0
_SETTLED_S = 3.0


@dataclass
class Found:
    """Measurements of one session."""

    late_p99_us: float
    missed: int
    lost: int
    cpu_percent: tuple[float, float]
    """Of the daemon and of the page server, %."""
    pss_mb: tuple[float, float]
    """Of the daemon and of the page server."""
    delays_s: list[float]
    """Delays of the strips that the first page received."""


def pss_mb(pid: int) -> float:
    """Return the proportional set size of a process."""
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        if line.startswith("Pss:"):
            return int(line.split()[1]) * 1024e-6
    raise ValueError("no PSS")


def page_process(daemon: int) -> int:
    """Return the process of the page server of a daemon."""
    for task in Path(f"/proc/{daemon}/task").iterdir():
        for child in (task / "children").read_text().split():
            if b"rigd.web" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
    raise ValueError("no page")


async def open_pages(address: str, pages: int) -> None:
    """Open pages; print the time of arrival and the end of each strip of the first one."""
    async with aiohttp.ClientSession() as session:

        async def follow(*, report: bool) -> None:
            async with session.ws_connect(f"{address}api/live") as socket:
                async for message in socket:
                    for line in message.data.split("\n"):
                        if report and line.startswith('{"type":"strip"'):
                            strip = json.loads(line)
                            end_s = strip["t0_s"] + strip["dt_s"] * len(strip["angle_min"])
                            print(time.time(), end_s, flush=True)

        await asyncio.gather(*(follow(report=number == 0) for number in range(pages)))


@contextmanager
def opened_pages(address: str, pages: int, out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Open pages in a separate process while this context lasts."""
    with out.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, __file__, "--open-pages", address, str(pages)], stdout=stream
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def run(seconds: float, folder: Path, pages: int) -> Found:
    """Run one chirp with a number of open pages; of several, one is suspended."""
    daemon = find_daemon_socket("sim")
    address = str(page_address("sim")).partition("#")[0]
    came = folder / "strips.txt"
    came.touch()
    with Client(daemon) as client:
        pid = client.ask("status")["daemon"]["pid"]
        watched = (pid, page_process(pid))
        suspended = None
        openings = [opened_pages(address, max(1, pages - 1), came)] if pages else []
        if pages > 1:
            openings.append(opened_pages(address, 1, folder / "suspended.txt"))
        entered = [opening.__enter__() for opening in openings]
        try:
            time.sleep(_SETTLED_S)
            if pages > 1:
                suspended = entered[-1]
                suspended.send_signal(signal.SIGSTOP)
            parameters = {"amplitude_rad": 0.005, "start_hz": 0.5, "duration_s": seconds}
            parameters |= {"rest_s": 0.0, "ring_down_s": 0.0}
            client.ask("watch")
            client.ask("start", excitation="chirp", parameters=parameters)
            while client.ask("status")["rig"]["phase"] != "running":
                time.sleep(0.1)
            began_s, before = time.monotonic(), [cpu_s(each) for each in watched]
            time.sleep(seconds - 2.0)
            took_s = time.monotonic() - began_s
            percent = [
                100.0 * (cpu_s(each) - at) / took_s
                for each, at in zip(watched, before, strict=True)
            ]
            memory = [pss_mb(each) for each in watched]
            while (event := client.next_event(_PATIENCE_S)) is None or event.get(
                "event"
            ) != "series":
                pass
        finally:
            for opening in reversed(openings):
                opening.__exit__(None, None, None)
    ended = event["sessions"][-1]
    session = read_session(Path(ended["path"]))
    began_s = int(session.metadata["start_utc_ns"]) * 1e-9
    delays = [
        float(at) - began_s - float(end)
        for at, end in (line.split() for line in came.read_text().splitlines())
        if float(at) > began_s
    ]
    return Found(
        late_p99_us=float(np.percentile(session.samples["lateness_ns"], 99)) * 1e-3,
        missed=ended["missed"],
        lost=ended["lost"],
        cpu_percent=(percent[0], percent[1]),
        pss_mb=(memory[0], memory[1]),
        delays_s=delays,
    )


async def load_s(address: str) -> float:
    """Return the time in which the page and all its files are loaded."""
    began_s = time.monotonic()
    async with aiohttp.ClientSession() as session:
        async with session.get(address) as answer:
            text = await answer.text()
        names = [part.partition('"')[0] for part in text.split("/static/")[1:]]
        for name in names:
            async with session.get(f"{address}static/{name}") as answer:
                await answer.read()
        async with session.ws_connect(f"{address}api/live") as socket:
            await socket.receive()
    return time.monotonic() - began_s


@contextmanager
def served(folder: Path) -> Iterator[None]:
    """Run a daemon with its page on the simulated rig while this context lasts."""
    with (folder / "serve.txt").open("wb") as log:
        command = [RIGD, "serve", "--profile", "sim", "--web", "--output", folder / "out"]
        daemon = subprocess.Popen([str(each) for each in command], stdout=log, stderr=log)
        try:
            deadline_s = time.monotonic() + _PATIENCE_S
            while page_address("sim") is None and time.monotonic() < deadline_s:
                time.sleep(0.2)
            with Client(find_daemon_socket("sim")) as client:
                while client.ask("status")["state"] != "ready":
                    time.sleep(0.2)
            yield
        finally:
            daemon.terminate()
            daemon.wait()


def main() -> None:
    """Print every round, then the medians, and check the limits."""
    if sys.argv[1:2] == ["--open-pages"]:
        asyncio.run(open_pages(sys.argv[2], int(sys.argv[3])))
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=10.0)
    parser.add_argument("rounds", type=int, nargs="?", default=3)
    gate = Gate(ROWS, parser)
    folder = Path(tempfile.mkdtemp(prefix="rigd-web-"))
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    ratios, costs, memories, delays = [], [], [], []
    lost = 0
    try:
        with served(folder):
            loaded_s = asyncio.run(load_s(str(page_address("sim")).partition("#")[0]))
            for _ in range(gate.given.rounds):
                p99 = {}
                for pages in (0, 1, 10):
                    found = run(gate.given.seconds, folder, pages)
                    p99[pages] = found.late_p99_us
                    lost += found.lost
                    worst = max(found.delays_s, default=float("nan"))
                    print(
                        f"{pages:2d} pages: late p99 {found.late_p99_us:6.0f} µs, missed "
                        f"{found.missed}, lost {found.lost}; daemon {found.cpu_percent[0]:.1f} % "
                        f"{found.pss_mb[0]:.0f} MB, page {found.cpu_percent[1]:.1f} % "
                        f"{found.pss_mb[1]:.0f} MB; strip delay at most {worst:.3f} s",
                        flush=True,
                    )
                    if pages == 1:
                        costs.append(sum(found.cpu_percent))
                        memories.append(sum(found.pss_mb))
                        delays += found.delays_s
                ratios.append(p99[10] / p99[0])
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(f"delay of a strip at most {max(delays):.3f} s; ratios of the rounds {ratios}")
    gate.measured("page loaded", loaded_s)
    gate.measured("daemon and page, one page open", statistics.median(costs))
    gate.measured("memory of daemon and page", max(memories))
    gate.measured("delay of a strip, 99 %", np.percentile(delays, 99))
    gate.measured("samples lost", lost)
    gate.measured("lateness p99, ten pages", statistics.median(ratios))
    gate.finish()


if __name__ == "__main__":
    main()
