"""The window of ``rigd live``: Rerun's own viewer, here without a screen."""

import os
import signal

import numpy as np
import pytest
from graphics import viewer_ended
from processes import eventually, sockets

from rigd.live import Viewer
from rigd.live.address import LiveAddress

pytestmark = pytest.mark.process


@pytest.fixture
def viewer(publisher, tmp_path):
    window = Viewer(publisher.address, tmp_path, ("--headless", "--window-size", "320x200"))
    if not eventually(lambda: window.control_url or window.exit_code is not None):
        pytest.fail(window.last_log_lines)
    yield window
    window.close()


@pytest.fixture
def shown_s(viewer):
    """Time up to which the viewer shows the recording in front."""
    from rerun.experimental import ViewerClient

    def read_time_s() -> float:
        if viewer.exit_code is not None:
            viewer_ended(viewer)
        try:
            state = ViewerClient.connect(viewer.control_url).get_state()
        except (OSError, RuntimeError):  # it does not answer yet
            return -np.inf
        front = [r for r in state.recordings if r.store_id == state.active_recording]
        return (front[0].current_time or 0) * 1e-9 if front else 0.0

    return read_time_s


@pytest.fixture
def current(publisher, shown_s):
    """Whether the viewer shows the newest samples."""
    return lambda: shown_s() > publisher.producer.tick * 1e-3 - 1.5


def test_viewer_follows_the_newest_samples_and_another_server(publisher, viewer, shown_s, current):
    assert eventually(lambda: shown_s() > 0.5)
    assert eventually(current)
    addresses = {address for end in sockets(viewer.pid) for address in end.addresses}
    assert addresses == {"0100007F", "00000000"}, "127.0.0.1, and the far end of a listening socket"

    # After a change of the server, it reconnects to the same session.
    os.kill(publisher.server_pid, signal.SIGKILL)
    address = publisher.next_address()
    assert eventually(lambda: viewer.connect(address)), "while it is busy, it is asked again"
    before_s = publisher.producer.tick * 1e-3
    assert eventually(lambda: shown_s() > before_s)
    assert eventually(current)
    assert publisher.producer.refused == 0


@pytest.mark.further  # as viewers that are no window, in test_live_publisher.py
def test_viewer_catches_up_after_a_stall_and_across_sessions(publisher, viewer, shown_s, current):
    assert eventually(lambda: shown_s() > 1.0)

    # A suspended window delays nothing, and catches up.
    os.kill(viewer.pid, signal.SIGSTOP)
    until = publisher.producer.tick + 1000
    assert eventually(lambda: publisher.producer.tick > until)
    os.kill(viewer.pid, signal.SIGCONT)
    assert eventually(current)

    # It shows sessions one after the other.
    publisher.finish()
    begins = tuple(ring.written_count for ring in publisher.producer.channels.rings)
    publisher.show("second", begins)
    assert eventually(lambda: shown_s() > begins[-1] * 1e-3 + 0.2)
    assert publisher.producer.refused == 0


@pytest.mark.parametrize(
    "absent",
    [("VK_DRIVER_FILES",), ("VK_DRIVER_FILES", "__EGL_VENDOR_LIBRARY_FILENAMES")],
    ids=["OpenGL alone", "neither Vulkan nor OpenGL"],
)
def test_error_without_vulkan_names_the_missing_package(tmp_path, monkeypatch, absent):
    for variable in absent:
        monkeypatch.setenv(variable, "/nonexistent")
    unused_address = LiveAddress.for_this_process("sim", grpc_port=9, page_port=9, server=1)
    window = Viewer(unused_address, tmp_path, ("--headless", "--window-size", "320x200"))
    try:
        assert eventually(lambda: window.exit_code is not None)
    finally:
        window.close()
    assert window.lacks_graphics
    assert window.exit_code not in (0, None)
    assert "no Vulkan driver" in window.closing_reason
    assert "mesa-vulkan-drivers" in window.closing_reason


@pytest.mark.further  # as a server that is killed
def test_wait_for_an_unresponsive_window_is_limited(publisher, viewer, shown_s, monkeypatch):
    assert eventually(lambda: shown_s() > 0.5)
    monkeypatch.setattr("rigd.live._viewer._SWITCH_TIMEOUT_S", 0.5)
    os.kill(viewer.pid, signal.SIGSTOP)
    assert not viewer.connect(publisher.address)
    assert not viewer.connect(publisher.address), "one at a time"
    os.kill(viewer.pid, signal.SIGCONT)
    monkeypatch.setattr("rigd.live._viewer._SWITCH_TIMEOUT_S", 60.0)
    assert eventually(lambda: viewer.connect(publisher.address))
