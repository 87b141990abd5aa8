"""``rigd live``: the view it finds, its message without one, and its window."""

import json
import sys
from dataclasses import replace

import pytest
from processes import eventually

from rigd.live.address import LiveAddress, announce

VIEWER = """#!/bin/sh
echo "$@" > "$SEEN.arguments"
env > "$SEEN.environment"
echo "${SAID:-it is dark here}" >&2
exit $CODE
"""


@pytest.fixture(autouse=True)
def no_other_views(runtime_folder, monkeypatch):
    """Hide other live views and the screen."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.fixture
def view(no_other_views):
    """A live view of the rig sim, as it appears from outside."""
    address = LiveAddress.for_this_process("sim", grpc_port=9876, page_port=9090, server=1)
    announce(address)
    return address


@pytest.fixture
def fake_viewer(tmp_path, monkeypatch):
    """Replace Rerun's program by a script; return its arguments or environment."""
    monkeypatch.delitem(sys.modules, "rerun_cli", raising=False)
    package = tmp_path / "packages" / "rerun_cli"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "rerun").write_text(VIEWER)
    (package / "rerun").chmod(0o755)
    monkeypatch.syspath_prepend(package.parent)
    monkeypatch.setenv("DISPLAY", ":no-such-screen")
    monkeypatch.setenv("SEEN", str(tmp_path / "seen"))
    monkeypatch.setenv("CODE", "0")
    return lambda name: (tmp_path / f"seen.{name}").read_text()


def test_error_without_a_view_names_the_commands(rigd_here):
    done = rigd_here("live")
    assert done.returncode == 1
    assert done.stdout == ""
    for remedy in ("rigd run chirp --profile NAME --live", "rigd serve --profile NAME --live"):
        assert remedy in done.stderr
    done = rigd_here("live", "--profile", "antenna_can")
    assert done.returncode == 1
    assert "No live view of the rig antenna_can is running" in done.stderr
    assert "rigd serve --profile antenna_can --live" in done.stderr


def test_unknown_profile_is_wrong_use(rigd_here):
    done = rigd_here("live", "--profile", "antena_can")
    assert done.returncode == 2
    assert "There is no profile 'antena_can'" in done.stderr


def test_standard_output_is_only_the_address_for_a_browser(rigd_here, view):
    done = rigd_here("live", "--web")
    assert (done.returncode, done.stdout) == (0, "http://127.0.0.1:9090\n")
    assert "ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 " in done.stderr


def test_error_without_a_screen_names_alternatives(rigd_here, view):
    done = rigd_here("live")
    assert done.returncode == 1
    for word in ("DISPLAY", "rigd live --web", "ssh -L 9090:127.0.0.1:9090"):
        assert word in done.stderr


def test_one_of_several_views_must_be_named(rigd_here, view, write_profile):
    announce(replace(view, rig="second", page_port=1234))
    done = rigd_here("live", "--web")
    assert done.returncode == 1
    assert "(second, sim); name one with --profile" in done.stderr
    assert rigd_here("live", "--web", "--profile", "second").stdout == "http://127.0.0.1:1234\n"
    file = write_profile("sim", {"name": '"second"'})
    assert rigd_here("live", "--web", "--profile", file).stdout == "http://127.0.0.1:1234\n"


def test_wait_for_a_view(rigd_here, no_other_views, monkeypatch):
    address = LiveAddress.for_this_process("sim", grpc_port=9876, page_port=9090, server=1)
    monkeypatch.setattr("time.sleep", lambda _: announce(address))  # while it waits
    done = rigd_here("live", "--web", "--wait")
    assert (done.returncode, done.stdout) == (0, "http://127.0.0.1:9090\n")
    assert "Waiting for a live view to start; Ctrl-C quits." in done.stderr


@pytest.mark.process
def test_window_is_local_and_does_not_change_user_settings(
    rigd_here, view, fake_viewer, runtime_folder
):
    done = rigd_here("live")
    assert done.returncode == 0, done.stderr
    arguments = fake_viewer("arguments")
    assert "--bind 127.0.0.1" in arguments
    assert f"--connect {view.proxy_url}" in arguments
    environment = dict(
        line.split("=", 1) for line in fake_viewer("environment").splitlines() if "=" in line
    )
    assert environment["CI"] == "1", "no usage data"
    assert environment["HTTPS_PROXY"].startswith("http://127.0.0.1:"), "nothing is looked up"
    assert environment["XDG_DATA_HOME"].startswith(str(runtime_folder))


@pytest.mark.process
def test_error_if_no_window_can_be_opened(rigd_here, view, fake_viewer, monkeypatch):
    monkeypatch.setenv("CODE", "3")
    done = rigd_here("live")
    assert done.returncode == 1
    assert "(it is dark here). rigd live --web shows the same in a browser." in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.process
def test_error_names_the_package_missing_for_drawing(rigd_here, view, fake_viewer, monkeypatch):
    # As Rerun prints it, with its backtrace: longer than the stored part of its log.
    frames = "".join(f"{frame:4}: rerun::main\n" for frame in range(6, 25))
    monkeypatch.setenv(
        "SAID", f"thread 'main' panicked at 'Failed to get render context'\n{frames}"
    )
    monkeypatch.setenv("CODE", "101")
    done = rigd_here("live")
    assert done.returncode == 1
    assert "no Vulkan driver" in done.stderr
    assert "the package mesa-vulkan-drivers" in done.stderr
    assert done.stderr.endswith("rigd live --web shows the same in a browser.\n")
    assert "rerun::main" not in done.stderr


class Window:
    """A fake viewer: open for some polls, then closed by the user."""

    def __init__(self, polls: int) -> None:
        self._polls = polls
        self.connected = []
        self.closed = False

    def close(self) -> None:
        self.closed = True

    @property
    def exit_code(self):
        self._polls -= 1
        return None if self._polls >= 0 else 0

    def connect(self, view) -> bool:
        self.connected.append(view.server)
        return len(self.connected) != 2  # once it is too busy


def test_window_reconnects_to_later_views(rigd_here, view, monkeypatch):
    second, third = replace(view, server=2), replace(view, server=3, grpc_port=1234)
    there = iter([[view], [view], [view], [second], [], [], [third], [third], [third]])
    monkeypatch.setattr("rigd.daemon.client.find_live_views", lambda rig: next(there))
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setattr("rigd.cli.live.has_screen", lambda: True)
    window = Window(polls=8)
    monkeypatch.setattr("rigd.live.Viewer", lambda *_: window)
    done = rigd_here("live")
    assert (done.returncode, window.closed) == (0, True)
    assert window.connected == [2, 3, 3]
    printed = done.stderr
    assert printed.count("has ended; the window stays open and shows the next one") == 1
    assert printed.count("The live view of sim has restarted.") == 2


@pytest.mark.process
@pytest.mark.further  # as through its files
def test_view_is_found_through_the_daemon_without_its_file(
    rigd, rigd_here, start_rigd, runtime_folder
):
    serve = start_rigd("serve", "--profile", "sim", "--live", "--fast")
    file = runtime_folder / "rigd" / "live-sim.json"
    assert eventually(file.exists)
    ports = json.loads(file.read_text())
    file.unlink()

    def live_view():
        status = rigd_here("status", "--json")
        return status.returncode == 0 and (json.loads(status.stdout)["rig"] or {}).get("live_view")

    assert eventually(live_view)
    assert live_view()["url"] == f"http://127.0.0.1:{ports['page_port']}"
    done = rigd_here("live", "--web")
    assert done.stdout == f"http://127.0.0.1:{ports['page_port']}\n"
    serve.terminate()
    assert serve.wait(300.0) == 0
    assert rigd_here("live", "--web").returncode == 1


def test_error_names_a_daemon_with_a_pending_view(rigd_here, monkeypatch):
    monkeypatch.setattr("rigd.daemon.client.daemons_with_view", lambda: {"sim": True})
    done = rigd_here("live")
    assert done.returncode == 1
    assert "The daemon of the rig sim has no live view at the moment" in done.stderr
    assert "rigd live --wait" in done.stderr


@pytest.mark.process
@pytest.mark.further  # as one whose view is about to begin
def test_error_names_a_daemon_without_a_view(rigd_here, start_rigd):
    serve = start_rigd("serve", "--profile", "sim", "--fast")
    assert eventually(lambda: rigd_here("status").returncode == 0)
    done = rigd_here("live")
    assert "started without a live view" in done.stderr
    assert "rigd serve --profile sim --live" in done.stderr
    serve.terminate()
    serve.wait(300.0)
