"""A fake control loop that fills a real ring, and the publisher as a real child process."""

import contextlib
import http.client
import importlib.util
import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from processes import children, eventually, state_of

from rigd.beam import Beam, Damping
from rigd.engine import Ring, shared_memory_fd
from rigd.engine.channels import TOPICS, Channels, create_channels
from rigd.engine.messages import MessageReader, ProcessFailed, encode
from rigd.engine.shared_state import LogEvent, Phase, SharedState, StateField, write_event
from rigd.live.address import LiveAddress
from rigd.live.messages import LiveJob, LiveSession, LiveSessionEnded, LiveSessionShown
from rigd.session.layout import pack_sample_into, pack_timing_into
from rigd.view import SessionDescription

RATE_HZ = 1000.0
BEAM = Beam(length_m=0.5, density_kg_per_m=0.047, bending_stiffness_n_m2=0.2)


def descriptors() -> list[int]:
    """Return shared memory for every ring, the shared state and the reference."""
    return [shared_memory_fd() for _ in (*TOPICS, "board", "reference")]


@pytest.fixture
def channels():
    """The memory of a rig at 1 kHz, without a writer."""
    made = create_channels(1000.0, descriptors())
    yield made
    made.close()


class Producer(threading.Thread):
    """Writes plausible records at 1 kHz, like the control loop, and never waits.

    `speed` makes more of them in the same time: kernels buffer seconds of samples for a server
    that does not read.
    """

    def __init__(self, capacity: int = 16_000, speed: float = 1.0) -> None:
        super().__init__(daemon=True)
        self.speed = speed
        self.fds = descriptors()
        *for_rings, for_shared_state, _ = self.fds
        rings = [
            Ring.create(topic.record_size, capacity if topic.tick_interval else 256, fd)
            for topic, fd in zip(TOPICS, for_rings, strict=True)
        ]
        self.channels = Channels(*rings, SharedState.create(for_shared_state))
        self.channels.shared_state[StateField.RECORD_MAY_START] = 1
        self.written = [0] * len(rings)
        self.tick = 0
        self.refused = 0
        self._halt = threading.Event()

    @property
    def dropped(self) -> int:
        return self.channels.shared_state[StateField.LIVE_SAMPLES_DROPPED]

    def run(self) -> None:
        write_event(self.channels.events, LogEvent(0, "info", "Record starts"))
        start = time.monotonic()
        while not self._halt.wait(0.005):
            self.channels.shared_state.beat(StateField.SUPERVISOR_BEAT)
            while self.tick < (time.monotonic() - start) * self.speed * RATE_HZ:
                self._write()
                for ring in self.channels.rings:  # what the recorder does
                    ring.discard_records()

    def stop(self) -> None:
        self._halt.set()
        self.join()

    def write_more(self, ticks: int) -> None:
        """Write more records after the end of the thread."""
        for _ in range(ticks):
            self._write()
            self.channels.samples.discard_records()
            self.channels.timings.discard_records()

    def close(self) -> None:
        self.stop()
        self.channels.close()
        for fd in self.fds:
            os.close(fd)

    def _write(self) -> None:
        t_ns, t_s = self.tick * 1_000_000, self.tick / RATE_HZ
        timings, samples = self.channels.timings, self.channels.samples
        pack_timing_into(timings.buffer, timings.next_slot(), t_ns, self.tick, 0.5e-3, 1.5e-3)
        timings.publish()
        offset = samples.next_slot()
        if offset < 0:
            self.refused += 1
        else:
            pack_sample_into(
                samples.buffer, offset, t_ns, self.tick, reference_rad(t_s), measured_rad(t_s),
                0.2 * math.cos(3.0 * t_s), 0.05 * math.sin(2.0 * math.pi * 7.0 * t_s),
                0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 40_000 + 1_000 * (self.tick % 60), 90_000,
            )  # fmt: skip
            samples.publish()
        self.tick += 1
        self.channels.shared_state[StateField.SCHEDULED_TICKS] = self.tick


def reference_rad(t_s):
    return 0.025 * np.sin(2.0 * math.pi * (0.5 * t_s + 0.1 * t_s**2))


def measured_rad(t_s):
    return reference_rad(t_s - 0.02)


class Publisher:
    """``python -m rigd.live.publisher``, as the supervisor starts it, showing one session.

    `first` is code to execute before anything else.
    """

    def __init__(
        self, producer: Producer, linger_s: float = 0.0, first: str = "", **environment: str
    ) -> None:
        self.producer = producer
        run = ["-m", "rigd.live.publisher"]
        if first:
            run = ["-c", f"{first}; from rigd.live.publisher import main; main()"]
        self.process = subprocess.Popen(
            [sys.executable, *run, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            stderr=subprocess.PIPE,
            pass_fds=producer.fds,
            env={**os.environ, **environment},
        )
        self._messages = MessageReader(self.process.stdout.fileno())
        self._job = LiveJob("rig under test", producer.channels.specs, linger_s)

    def begin(self) -> None:
        """Send the job, and have it show a session with all records written so far."""
        self.send(self._job)
        self.answer = self._receive(LiveAddress)
        if isinstance(self.answer, LiveAddress):
            self.show()

    def show(
        self,
        name: str = "chirp under test",
        begins: tuple[int, ...] | None = None,
        folder: Path | None = None,
        **members: object,
    ) -> None:
        """Have it show a session; `begins` has the number of records of each ring before it."""
        begins = begins or (0,) * len(TOPICS)
        ticks = 120_000
        description = SessionDescription(
            name, RATE_HZ, ticks, (0, ticks), BEAM, Damping(zeta=1e-3), **members
        )
        self.send(LiveSession(description, f"recording of {name}", begins, folder))
        self._receive(LiveSessionShown)

    def finish(self, outcome: str = "stopped", reason: str = "The test is over.") -> None:
        """Send the end of the session."""
        ends = tuple(ring.written_count for ring in self.producer.channels.rings)
        self.send(LiveSessionEnded(ends, outcome, reason))

    def send(self, message: object) -> None:
        send_message(self.process.stdin, message)

    @property
    def address(self) -> LiveAddress:
        assert isinstance(self.answer, LiveAddress)
        return self.answer

    def next_address(self) -> LiveAddress:
        """Wait for the address of another server, which is :attr:`address` from now on."""
        self.answer = self._receive(LiveAddress)
        return self.address

    @property
    def ports(self) -> set[int]:
        return {self.address.grpc_port, self.address.page_port}

    @property
    def proxy_url(self) -> str:
        return self.address.proxy_url

    @property
    def dropped(self) -> int:
        return self.producer.dropped

    @property
    def server_pid(self) -> int:
        """Process id of the server; there must be one."""
        (pid,) = children(self.process.pid)
        return pid

    def end(self) -> tuple[int, str, str]:
        """Close its input; return exit code, standard output and standard error."""
        self.process.stdin.close()
        self.process.wait(300.0)
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

    def _receive(self, kind: type) -> object:
        """Return its next message of a kind, or of its failure."""
        while True:
            message = self._messages.next_message(300.0)
            assert message is not None, "the publisher does not answer"
            if isinstance(message, kind | ProcessFailed):
                return message


def send_message(pipe, message: object) -> None:
    pipe.write(encode(message))
    pipe.flush()


@pytest.fixture(scope="session", autouse=True)
def rerun_installed():
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
def rerun_program(rerun_installed):
    return program()


def get_page(port: int, path: str, host: str | None = None):
    """Request a page of the publisher's server, as a browser does."""
    link = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        link.request("GET", path, headers={} if host is None else {"Host": host})
        answer = link.getresponse()
        return answer, answer.read()
    finally:
        link.close()


@pytest.fixture
def get():
    return get_page


def channels_running(channels) -> None:
    """Set the phase to running, and wait until the publisher has shown it."""
    shared_state = channels.shared_state
    shared_state[StateField.PHASE] = Phase.RUNNING
    beat = shared_state[StateField.LIVE_BEAT]
    assert eventually(lambda: shared_state[StateField.LIVE_BEAT] > beat + 2)


class Columns:
    """The received part of a recording: times in ns and values by entity and component."""

    def __init__(self, application_id: str, chunks) -> None:
        self.application_id = application_id
        self._batches: dict[str, list] = {}
        for chunk in chunks:
            if "session_time" in chunk.timeline_names:
                self._batches.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())

    def __call__(self, entity: str, component: str) -> tuple[np.ndarray, np.ndarray]:
        batches = [b for b in self._batches[entity] if component in b.schema.names]
        time_ns = [batch.column("session_time").cast("int64").to_numpy() for batch in batches]
        values = [np.array(batch.column(component).to_pylist()) for batch in batches]
        return np.concatenate(time_ns), np.concatenate(values)

    def sent(self, entity: str, component: str) -> tuple[list[float], list]:
        """Return when each value was sent, in s since 1970, and the values, in that order."""
        rows = [
            row
            for batch in self._batches[entity]
            if component in batch.schema.names
            for row in zip(
                batch.column("log_time").cast("int64").to_pylist(),
                batch.column(component).to_pylist(),
                strict=True,
            )
        ]
        rows.sort(key=lambda row: row[0])
        return [1e-9 * time_ns for time_ns, _ in rows], [values for _, values in rows]


class Saver:
    """Rerun itself, saving what the server of a live view sends."""

    def __init__(self, program: Path, view: LiveAddress, path: Path) -> None:
        self._path = path
        self._publisher = view.pid
        self._process = subprocess.Popen(
            [program, view.proxy_url, "--save", path, "--bind", "127.0.0.1", "--port", "0"],
            env={**os.environ, "CI": "1"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def has_begun(self) -> bool:
        """Whether data has come: more than the frame of a picture, some 100 kB."""
        return self._path.exists() and self._path.stat().st_size > 300_000

    def has_all(self) -> bool:
        """Whether no more data comes: data on its way is lost when the server ends."""
        if not self.has_begun():
            return False
        size = self._path.stat().st_size
        for _ in range(15):  # polled often, as the machine may sleep during one pause
            time.sleep(0.1)
            if self._path.stat().st_size != size or self._is_active():
                return False
        return True

    def _is_active(self) -> bool:
        """Whether a process of the view runs, or would if a processor were free."""
        pids = (self._publisher, *children(self._publisher), self._process.pid)
        tasks = [task for pid in pids for task in Path(f"/proc/{pid}/task").iterdir()]
        return any(state_of(task) == "R" for task in tasks)

    def recordings(self) -> dict[str, Columns]:
        """Return each recording by its id, after the end of the server.

        Their order depends on Rerun.
        """
        from rerun.chunk import RrdReader

        assert self._process.wait(300.0) == 0
        reader = RrdReader(self._path)
        return {
            recording.recording_id: Columns(
                recording.application_id, reader.stream(store=recording)
            )
            for recording in reader.recordings()
        }

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture
def save(rerun_program, tmp_path):
    savers = []

    def start(view: LiveAddress) -> Saver:
        savers.append(Saver(rerun_program, view, tmp_path / f"{len(savers)}.rrd"))
        return savers[-1]

    yield start
    for saver in savers:
        saver.close()


@pytest.fixture
def receive(save):
    """Save what a publisher shows from now on.

    The returned function ends session and publisher, and returns each recording by its id.
    """

    def begin(publisher):
        saver = save(publisher.address)

        def end():
            assert eventually(saver.has_begun)
            publisher.producer.stop()
            publisher.finish()
            assert eventually(saver.has_all)
            publisher.end()
            return saver.recordings()

        return end

    return begin


@pytest.fixture(scope="session")
def received(rerun_program, tmp_path_factory):
    """Received recordings of two sessions of one publisher, by the end of each.

    One ended in a fault, the other with the loss of the supervisor. Also the number of ticks,
    the address of the view, and the responses of its page.
    """
    long_timeout = "from rigd.live import publisher as p; p._MAX_QUEUED_SAMPLES_S = 60.0"
    with contextlib.ExitStack() as stack:
        producer = Producer(capacity=64_000)
        stack.callback(producer.close)
        producer.start()
        publisher = Publisher(producer, first=f"{long_timeout}; p._MAX_ORPHANED_SESSION_S = 0.5")
        stack.callback(publisher.close)
        publisher.begin()
        path = tmp_path_factory.mktemp("received") / "sessions.rrd"
        saver = Saver(rerun_program, publisher.address, path)
        stack.callback(saver.close)
        address = publisher.address
        viewer_path = f"/?{address.viewer_url.split('?')[1]}"
        paths = ("/", viewer_path, "/re_viewer_bg.wasm", "/re_viewer.js", "/live.json")
        absent = ("/etc/passwd", "/../x", "/version")
        page = {path: get_page(address.page_port, path) for path in (*paths, *absent)}
        channels_running(producer.channels)
        assert eventually(lambda: producer.tick > 1000 and saver.has_begun())
        producer.stop()
        publisher.finish("fault", "The drive was lost.")
        assert eventually(saver.has_all)
        publisher.show("lost", tuple(ring.written_count for ring in producer.channels.rings))
        publisher.end()
        assert (producer.dropped, producer.refused) == (0, 0)
        recordings = saver.recordings()
        return {
            "address": address,
            "page": page,
            "ticks": producer.tick,
            "fault": recordings["recording of chirp under test"],
            "lost": recordings["recording of lost"],
        }


@pytest.fixture
def send():
    return send_message


def read_message(pipe, timeout_s: float = 60.0) -> object:
    return MessageReader(pipe.fileno()).next_message(timeout_s)


@pytest.fixture
def receive_message():
    """Return the next message from a publisher's pipe."""
    return read_message


@pytest.fixture
def start_producer():
    producers = []

    def start(**options) -> Producer:
        producers.append(Producer(**options))
        producers[-1].start()
        return producers[-1]

    yield start
    for producer in producers:
        producer.close()


@pytest.fixture
def producer(start_producer):
    return start_producer()


@pytest.fixture
def start_publisher(producer):
    publishers = []

    def start(producer: Producer = producer, **options) -> Publisher:
        publishers.append(Publisher(producer, **options))
        publishers[-1].begin()
        return publishers[-1]

    yield start
    for publisher in publishers:
        publisher.close()


@pytest.fixture
def own_port():
    """Code by which a publisher prefers a port that no other test uses.

    When its server is replaced, Rerun's default port may belong to a publisher of another test.
    """
    port = 20_000 + os.getpid() % 10_000
    return f"from rigd.live import _server as outlet; outlet.GRPC_PORT = {port}"


@pytest.fixture
def publisher(start_publisher):
    return start_publisher()


@pytest.fixture
def publisher_without_drops(start_producer, start_publisher):
    """A publisher that drops nothing, even if the machine stalls for a minute."""
    return start_publisher(
        start_producer(capacity=64_000),
        first="from rigd.live import publisher; publisher._MAX_QUEUED_SAMPLES_S = 60.0",
    )
