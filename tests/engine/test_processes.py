"""Processes and their messages: no message is long, and no failure is fatal."""

import contextlib
import errno
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from rigd.engine import shared_memory_fd
from rigd.engine.messages import ControlEnded, MessageReader, ReadyToRecord, SessionJob, encode
from rigd.engine.processes import ChildError, ChildProcess
from rigd.engine.reference import map_reference, write_reference
from rigd.engine.workers import RECORDER
from rigd.profile import load_profile
from rigd.session.limits import MAX_SAMPLES

PIPE_BYTES = 65_536


@pytest.fixture
def memory():
    fd = shared_memory_fd()
    yield fd
    os.close(fd)


def test_a_reference_is_found_in_its_memory(memory):
    for ticks in (1000, 10, 3000):  # each session has its own
        reference_rad = np.random.default_rng(ticks).standard_normal(ticks)
        found = map_reference(write_reference(memory, reference_rad))
        assert len(found) == ticks
        assert type(found[0]) is float
        assert np.array_equal(np.array(found), reference_rad)


def test_the_longest_session_is_received_without_waiting(memory):
    job = SessionJob(load_profile("sim"), write_reference(memory, np.zeros(MAX_SAMPLES)))
    assert len(encode(job)) < PIPE_BYTES


@pytest.fixture
def pipe():
    ends = os.pipe()
    yield ends
    for end in ends:
        with contextlib.suppress(OSError):
            os.close(end)


def test_no_wait_for_the_rest_of_a_message(pipe):
    read, write = pipe
    reader, message = MessageReader(read), ReadyToRecord({"start_angle_rad": "0.1"})
    for byte in (data := encode(message))[:-1]:
        os.write(write, bytes([byte]))
        assert reader.next_message(0.0) is None
    os.write(write, data[-1:] + encode(ControlEnded("")) + data[:7])
    assert reader.next_message(0.0) == message
    assert reader.next_message(None) == ControlEnded("")
    assert reader.next_message(0.01) is None
    os.close(write)
    with pytest.raises(EOFError):
        reader.next_message(None)


def test_no_wait_for_an_invalid_message(pipe):
    read, write = pipe
    os.write(write, b"Warning: something has been printed\n")
    with pytest.raises(ValueError, match="no message, but b'Warning: "):
        MessageReader(read).next_message(0.0)


@pytest.mark.process
def test_an_invalid_message_is_reported_with_the_process():
    child = ChildProcess(replace(RECORDER, module="this"))  # prints the Zen of Python
    try:
        with pytest.raises(ChildError, match="recorder process sent no message, but b'The Zen of"):
            child.poll(60.0)
    finally:
        child.stop()


@pytest.mark.process
def test_output_of_a_library_is_not_among_the_messages():
    code = (
        "import os; from rigd.engine.messages import ControlEnded; "
        "from rigd.engine.processes import SupervisorConnection; "
        "parent = SupervisorConnection(); print('of a library', flush=True); "
        "os.write(1, b'and so on'); parent.send(ControlEnded(''))"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(os.getpid())],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    output, errors = child.communicate(timeout=60)
    assert output == encode(ControlEnded(""))
    assert errors == b"of a library\nand so on"


@pytest.mark.process
def test_a_process_may_be_stopped_twice():
    child = ChildProcess(RECORDER)
    child.stop()
    child.stop()
    assert not child.running


@pytest.mark.process
def test_failure_to_start_a_process_is_reported(monkeypatch):
    def refuse(*_, **__):
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(subprocess, "Popen", refuse)
    with pytest.raises(ChildError, match=r"recorder process cannot be started .*ulimit"):
        ChildProcess(RECORDER)
