"""Line load and errors in the shared state."""

import os
from types import SimpleNamespace

import pytest

from rigd.devices.contracts import LineHealth
from rigd.engine import shared_memory_fd
from rigd.engine._publish import ReadingPublisher
from rigd.engine.shared_state import SharedState, StateField

CYCLE = SimpleNamespace(angle_rad=0.1, coupling_torque_nm=float("nan"), torque_command_nm=-0.2)


class Line:
    def __init__(self, *healths):
        self.healths = list(healths)

    def health(self):
        return self.healths.pop(0) if len(self.healths) > 1 else self.healths[0]


@pytest.fixture
def shared_state():
    fd = shared_memory_fd()
    yield SharedState.create(fd)
    os.close(fd)


def shown(shared_state, drive, sensor, *times_ns):
    display = ReadingPublisher(shared_state, SimpleNamespace(drive=drive, sensor=sensor))
    for now_ns in times_ns:
        display.publish(CYCLE, now_ns)
    words = (StateField.BUS_LOAD_PPM, StateField.BUS_ERRORS, StateField.SENSOR_STATUS)
    return tuple(shared_state[word] for word in words)


def test_no_line_health_without_a_line(shared_state):
    assert shown(shared_state, Line(LineHealth()), Line(LineHealth()), 0, 10**9) == (-1, -1, -1)
    assert shared_state[StateField.ANGLE_NRAD] == 10**8
    assert shared_state[StateField.COUPLING_TORQUE_NNM] == 0  # NaN is not shown
    assert shared_state[StateField.CONTROL_BEAT] == 2


def test_load_of_the_busiest_line_and_errors_of_all(shared_state):
    can = Line(LineHealth(0, 1e6, 1), LineHealth(300_000, 1e6, 1))
    serial = Line(LineHealth(0, 2e6, 2, 8), LineHealth(400_000, 2e6, 2, 8))
    assert shown(shared_state, can, serial, 0, 10**9) == (300_000, 3, 8)


def test_the_load_is_unchanged_while_time_is_paused(shared_state):
    can = Line(*(LineHealth(bits, 1e6) for bits in (0, 1000, 5000, 9000)))
    assert shown(shared_state, can, Line(LineHealth()), 0, 10**6 * 2, 10**6 * 2)[0] == 500_000
