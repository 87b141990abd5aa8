"""A fake control loop that fills a real ring, and the publisher as a real child process."""

import importlib.util
import json
import math
import os
import select
import subprocess
import sys
import threading
import time
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from rigd.engine.board import Board, Word
from rigd.engine.process import packed_object
from rigd.engine.ring import Ring, shared_memory_fd
from rigd.live.job import LiveJob
from rigd.session.format import SAMPLE_SIZE, pack_sample_into

RATE_HZ = 1000.0


class Producer(threading.Thread):
    """Writes plausible samples at 1 kHz, like the control loop, and never waits for anybody.

    `speed` makes more of them in the same time: kernels buffer seconds of samples for a server
    that does not read.
    """

    def __init__(self, capacity: int = 16_000, speed: float = 1.0) -> None:
        super().__init__(daemon=True)
        self.speed = speed
        self.ring = Ring.create(SAMPLE_SIZE, capacity, shared_memory_fd())
        self.tick = 0
        self.refused = 0
        self._halt = threading.Event()

    def run(self) -> None:
        start = time.monotonic()
        while not self._halt.wait(0.005):
            while self.tick < (time.monotonic() - start) * self.speed * RATE_HZ:
                self._write()
                self.ring.take(1000)  # what the recorder does

    def stop(self) -> None:
        self._halt.set()
        self.join()

    def _write(self) -> None:
        t_s = self.tick / RATE_HZ
        reference_rad = 0.025 * math.sin(2.0 * math.pi * (0.5 * t_s + 0.1 * t_s**2))
        angle_rad = 0.025 * math.sin(2.0 * math.pi * (0.5 * (t_s - 0.02) + 0.1 * (t_s - 0.02) ** 2))
        offset = self.ring.slot()
        if offset < 0:
            self.refused += 1
        else:
            pack_sample_into(
                self.ring.buffer, offset,
                self.tick * 1_000_000, self.tick, reference_rad, angle_rad,
                0.2 * math.cos(3.0 * t_s), 0.05 * math.sin(2.0 * math.pi * 7.0 * t_s),
                0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 40_000 + 1_000 * (self.tick % 60), 90_000,
            )  # fmt: skip
            self.ring.publish()
        self.tick += 1


class Publisher:
    """``python -m rigd.live.publisher``, as the supervisor starts it."""

    def __init__(self, ring: Ring, linger_s: float = 0.0, **environment: str) -> None:
        self.board = Board.create(shared_memory_fd())
        self.process = subprocess.Popen(
            [sys.executable, "-m", "rigd.live.publisher", str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=(ring.spec.fd, self.board.fd),
            env={**os.environ, **environment},
        )
        job = LiveJob(ring.spec, self.board.fd, "chirp under test", RATE_HZ, linger_s)
        write_job(self.process.stdin, job)
        try:
            self.answer = json.loads(self._first_line())
        except BaseException:
            self.close()
            raise

    @property
    def proxy_url(self) -> str:
        return parse_qs(urlsplit(self.answer["url"]).query)["url"][0]

    @property
    def ports(self) -> set[int]:
        return {urlsplit(self.answer["url"]).port, urlsplit(self.proxy_url).port}

    @property
    def dropped(self) -> int:
        return self.board[Word.LIVE_DROPPED]

    @property
    def server_pid(self) -> int:
        """Of the server, or 0 while there is none."""
        pids = children(self.process.pid)
        return pids[0] if pids else 0

    def end(self) -> tuple[int, str, str]:
        """Close its input; return its exit code and what else it wrote."""
        self.process.stdin.close()
        self.process.wait(60.0)
        return (
            self.process.returncode,
            self.process.stdout.read().decode(),
            self.process.stderr.read().decode(),
        )

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            pipe.close()
        self.board.close()
        os.close(self.board.fd)

    def _first_line(self) -> bytes:
        ready, _, _ = select.select([self.process.stdout], [], [], 60.0)
        assert ready, "the publisher does not answer"
        return self.process.stdout.readline()


def write_job(pipe, job: LiveJob) -> None:
    pipe.write(packed_object("job", job))
    pipe.flush()


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.fixture(scope="session", autouse=True)
def rerun_runs():
    try:
        subprocess.run([program(), "--version"], check=True, capture_output=True)
    except (ImportError, OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"LIVE VIEW NOT TESTED: the rerun program does not run here: {error}")


def program() -> Path:
    package = importlib.util.find_spec("rerun_cli")
    if package is None:
        raise ImportError("rerun-sdk is not installed")
    return Path(package.origin).with_name("rerun")


@pytest.fixture(scope="session")
def rerun_program(rerun_runs):
    return program()


@pytest.fixture
def send_job():
    return write_job


@pytest.fixture
def eventually():
    """Whether a condition comes true; the limit only ends a test that fails."""

    def wait(condition, within_s: float = 60.0) -> bool:
        deadline = time.monotonic() + within_s
        while not (met := condition()) and time.monotonic() < deadline:
            time.sleep(0.02)
        return met

    return wait


@pytest.fixture
def gone():
    """Whether a process has ended, reaped or not."""

    def ask(pid: int) -> bool:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except FileNotFoundError:
            return True
        return state in "ZX"

    return ask


@pytest.fixture
def start_producer():
    producers = []

    def start(**options) -> Producer:
        producers.append(Producer(**options))
        producers[-1].start()
        return producers[-1]

    yield start
    for producer in producers:
        producer.stop()
        producer.ring.close()
        os.close(producer.ring.spec.fd)


@pytest.fixture
def producer(start_producer):
    return start_producer()


@pytest.fixture
def start_publisher(producer):
    publishers = []

    def start(ring: Ring = producer.ring, **options) -> Publisher:
        publishers.append(Publisher(ring, **options))
        return publishers[-1]

    yield start
    for publisher in publishers:
        publisher.close()


@pytest.fixture
def publisher(start_publisher):
    return start_publisher()
