"""A client that is newer than the daemon, which was not restarted after an update."""

import json
import socketserver
import threading

import pytest

from rigd.daemon.address import socket_path
from rigd.profile import load_profile

pytestmark = pytest.mark.process

PLAN = {
    "record_s": 136.0,
    "peak_angle_rad": 0.025,
    "peak_velocity_rad_s": 1.3,
    "peak_torque_nm": 0.41,
    "warnings": ["it will be clipped"],
}
"""Fields of a plan before those of the beam's tip were added."""
ANSWERS = {
    "status": {"daemon": {"what_moves": "The simulated rig will move."}},
    "start": {"series": 1, "plan": PLAN},
}


class Daemon(socketserver.StreamRequestHandler):
    def handle(self):
        for line in self.rfile:
            request = json.loads(line)
            name = request["command"]
            reply = {"reply": name, "ok": True, "id": request.get("id"), **ANSWERS[name]}
            self.wfile.write(json.dumps(reply).encode() + b"\n")


@pytest.fixture
def older_daemon(runtime_folder):
    path = socket_path(load_profile("sim").name)
    path.parent.mkdir(mode=0o700, exist_ok=True)
    with socketserver.ThreadingUnixStreamServer(str(path), Daemon) as server:
        server.daemon_threads = True
        path.chmod(0o600)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield
        server.shutdown()


@pytest.mark.usefixtures("older_daemon")
def test_client_accepts_a_plan_without_the_tip(rigd):
    """The session runs by then, and only its client receives Ctrl-C."""
    done = rigd("start", "chirp", "--profile", "sim", "--detach", timeout=20)
    assert done.returncode == 0, done.stderr
    assert "torque 0.41 N·m" in done.stdout
    assert "Warning: it will be clipped" in done.stdout
