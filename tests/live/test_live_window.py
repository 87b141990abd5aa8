"""The live view of a session in real time, by screenshots of Rerun's own viewer.

With RIGD_PICTURES=FOLDER it is the session of the reference paper after the second resonance, on a
quiet computer, and pictures of all tabs are written to the folder.
"""

import io
import os
import re
import signal
import subprocess
import time
import urllib.parse
from functools import partial
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from graphics import viewer_ended_with_log
from processes import eventually

from rigd.view import plots
from rigd.view.plots import GREEN, GREY, ORANGE, SKY_BLUE

pytestmark = pytest.mark.process

PICTURES = os.environ.get("RIGD_PICTURES")
# A ring-down that is longer than a busy computer needs for all screenshots.
SESSION = (
    ("--ring-down", "1")
    if PICTURES
    else ("--duration", "40", "--start-hz", "0.5", "--ring-down", "200")
)
SCREENSHOTS_FROM_S = 30.0 if PICTURES else 6.0
# A processor draws here, and is faster with a smaller window.
WIDTH, HEIGHT = (1280, 800) if PICTURES else (960, 600)
FOLLOWS_WITHIN_S = 8.0
"""Delay of a machine that is five times slower; a stuck viewer is later than that."""
PICTURES_FROM_S = 41.1
"""When the antenna swings most and no label of time is cut at an edge of a plot."""

VIRIDIS = [(68, 1, 84), (33, 145, 140), (253, 231, 37)]  # its ends and its middle
WHITE = (255, 255, 255)


def colors_of(*wanted: plots.Plot) -> dict[str, list]:
    return {plot.title: [curve.color for curve in plot.curves] for plot in wanted}


COLORS = {
    "Overview": {
        "State": [],
        "Values and limits": [GREEN],
        **colors_of(plots.ANGLE, plots.COUPLING_TORQUE),
        "Frequency response: magnitude of torque over angle": [SKY_BLUE, ORANGE, GREY],
        "Antenna": [SKY_BLUE, ORANGE],
        "Events, newest first": [],
    },
    "Signals": colors_of(
        plots.ANGLE,
        plots.TRACKING_ERROR,
        plots.COUPLING_TORQUE,
        plots.TORQUE_COMMAND,
        plots.FORCES,
        plots.TORQUES,
    ),
    "Frequency response": {
        "Magnitude of torque over angle": [SKY_BLUE, ORANGE, GREY],
        "Phase of torque over angle": [SKY_BLUE, ORANGE, GREY],
        "Coherence of angle and torque": [GREEN, GREY],
    },
    "Spectrogram": {"Spectrogram of the coupling torque": [*VIRIDIS, GREY]},
    "Health": {
        **colors_of(plots.LOOP, plots.DISK),
        # Of counts that are all 0 only the topmost is visible; a simulated rig has no bus.
        **{plot.title: [] for plot in (plots.FAULTY_TICKS, plots.BACKLOG, plots.AGES)},
        "Health": [],
    },
    "Events": {"Events": []},
}
"""Tab → its views → their expected colours."""


@pytest.fixture
def session(write_profile, start_rigd, tmp_path):
    """`rigd run chirp --live` in real time, once it has printed the address of its view."""
    profile = write_profile("sim", patient=not PICTURES)
    process = start_rigd(
        *("run", "chirp", "--profile", profile, "--live", "--output", tmp_path, *SESSION)
    )
    printed = ""
    for line in process.stdout:
        printed += line
        if "Live view: " in line:
            break
    assert "Live view: http://127.0.0.1:" in printed, printed
    yield process, re.search(r"Live view: (\S+)", printed)[1]
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300.0)


@pytest.fixture
def viewer(rerun_program, session, session_s, tmp_path):
    """Rerun's viewer, connected to the session's server when there is data to show."""
    from rerun.experimental import ViewerClient

    _, address = session
    (proxy,) = urllib.parse.parse_qs(urllib.parse.urlsplit(address).query)["url"]
    log = tmp_path / "viewer.log"
    # It draws even without screenshots.
    assert eventually(lambda: session_s() > 0.75 * SCREENSHOTS_FROM_S)
    with log.open("w") as output:
        process = subprocess.Popen(
            [
                rerun_program,
                *("--connect", proxy),
                "--headless",
                *("--window-size", f"{WIDTH}x{HEIGHT}"),
                *("--bind", "127.0.0.1"),
                *("--port", "0"),
            ],
            env={**os.environ, "CI": "1", "NO_COLOR": "1", "RUST_LOG": "info"},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    # There is no graphics card: drawing must not take the processor from the rig.
    os.setpriority(os.PRIO_PROCESS, process.pid, 10)
    try:
        port = re.compile(r"gRPC connections on 127\.0\.0\.1:(\d+)")
        assert eventually(lambda: process.poll() is not None or port.search(log.read_text()))
        assert eventually(lambda: process.poll() is not None or "running at" in log.read_text())
        if process.poll() is not None:
            viewer_ended_with_log(log.read_text())
        url = f"rerun+http://127.0.0.1:{port.search(log.read_text())[1]}/proxy"
        with ViewerClient.connect(url) as client:
            yield client
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def session_s(tmp_path):
    """Age of the session, from the clock and the start time in its file."""
    start = re.compile(rb"start_utc_ns....(\d{19})", re.DOTALL)
    assert eventually(lambda: any(start.search(part.read_bytes()) for part in parts(tmp_path)))
    (part,) = parts(tmp_path)
    start_s = int(start.search(part.read_bytes())[1]) * 1e-9
    return lambda: time.time() - start_s


def parts(folder: Path) -> list[Path]:
    return list(folder.glob("*.part"))


def bring_to_front(viewer, tab: str) -> set[str]:
    """Bring a tab to the front; return the ids of its views."""
    blueprint = viewer.get_blueprint().blueprint
    containers = {
        name.lstrip("/"): parts["ContainerBlueprint"]
        for name, parts in blueprint.items()
        if "ContainerBlueprint" in parts
    }
    (root,) = [parts for parts in containers.values() if parts["container_kind"] == "Tabs"]
    (wanted,) = [name for name in root["contents"] if containers[name]["display_name"] == tab]
    root["active_tab"] = wanted
    viewer.set_blueprint(blueprint, of="recording")

    def views(name: str) -> set[str]:
        if name not in containers:
            return {name.removeprefix("view/")}
        contents = containers[name]["contents"]  # a plain name if it is only one
        parts = [contents] if isinstance(contents, str) else contents
        return {view for part in parts for view in views(part)}

    return views(wanted)


def screenshot(viewer, view_id: str) -> np.ndarray:
    try:
        png = viewer.take_screenshot(view_id)
    except ConnectionError:  # of a tab that has not been drawn since it came to the front
        return np.empty((0, 0, 4))
    return matplotlib.image.imread(io.BytesIO(png), "png")


def count(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Return the number of pixels within a few grey levels of a colour."""
    distance = np.abs(image[..., :3] * 255.0 - np.array(color))
    return int(np.count_nonzero(np.all(distance < 12.0, axis=-1)))


@pytest.mark.further  # layout and samples are checked by view/ and test_live_publisher.py
def test_every_view_shows_its_curves_live(viewer, session_s):
    shown = partial(eventually, every_s=0.2)  # for each answer the viewer draws everything

    def newest_s() -> float:
        recordings = [r for r in viewer.get_state().recordings if r.timelines]
        return (recordings[0].current_time or 0) * 1e-9 if recordings else -np.inf

    # It follows the newest sample while the session lasts.
    assert shown(lambda: session_s() - newest_s() < 1.5)
    then = newest_s()
    assert shown(lambda: newest_s() > then + 0.5)
    # Until there is data for every view.
    assert shown(lambda: newest_s() > SCREENSHOTS_FROM_S, within_s=100.0)

    for tab, colors in COLORS.items():
        ids = bring_to_front(viewer, tab)

        def views(ids: set[str] = ids) -> dict:
            return {v.name: v for v in viewer.get_state().views if v.view_id in ids}

        assert shown(lambda: views().keys() == colors.keys()), views().keys()  # noqa: B023
        waiting = {view.view_id: colors[name] for name, view in views().items() if colors[name]}

        def all_complete(waiting: dict = waiting) -> bool:
            for view_id in list(waiting):
                shown = screenshot(viewer, view_id)
                if all(count(shown, color) >= 40 for color in waiting[view_id]):
                    del waiting[view_id]
            return not waiting

        assert shown(all_complete), (tab, waiting)
        assert [(v.name, v.reports) for v in views().values() if v.reports] == []
        if PICTURES:
            assert shown(lambda: newest_s() > PICTURES_FROM_S, within_s=30.0)
        whole = viewer.take_screenshot()
        assert matplotlib.image.imread(io.BytesIO(whole), "png").shape[:2] == (HEIGHT, WIDTH)
        if PICTURES:
            path = Path(PICTURES, f"live_{tab.lower().replace(' ', '_')}.png")
            path.write_bytes(whole)
    assert shown(lambda: session_s() - newest_s() < FOLLOWS_WITHIN_S)
