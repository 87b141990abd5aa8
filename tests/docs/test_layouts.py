"""The layouts for session files that are opened directly, and the page that describes this."""

import importlib.util
import io
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from graphics import viewer_ended
from session_schemas import message_class

from rigd.view.plots import GREEN, GREY, ORANGE, PURPLE, SKY_BLUE

pytestmark = pytest.mark.process

DOCS = Path(__file__).parents[2] / "docs"
LAYOUTS = DOCS / "layouts"
PAGE = (DOCS / "opening_sessions.md").read_text("utf-8")
SAMPLE_TOPIC, EVENT_TOPIC = "/rig/sample", "/rig/event"
EXAMPLE = "sessions/20261120-101500-chirp.mcap"
BIN = Path(sys.executable).parent


@pytest.fixture(scope="module")
def make():
    spec = importlib.util.spec_from_file_location("make_layouts", LAYOUTS / "make.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses search there
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def session(short_chirps, tmp_path_factory):
    """A session under the name that the page uses, with the layouts where it finds them."""
    folder = tmp_path_factory.mktemp("opening")
    (folder / EXAMPLE).parent.mkdir()
    shutil.copy(short_chirps[0], folder / EXAMPLE)
    (folder / "docs").symlink_to(DOCS)
    return folder


@pytest.fixture(scope="module")
def fields(session):
    """Fields of each topic, by the schemas in a file."""
    from mcap.reader import make_reader

    with (session / EXAMPLE).open("rb") as file:
        summary = make_reader(file).get_summary()
        found = {}
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            found[channel.topic] = {
                field.name for field in message_class(schema.name, schema.data).DESCRIPTOR.fields
            }
    return found


def contents(path: Path) -> dict:
    """Content of a layout of Rerun's, without its times."""
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    found: dict = {"application": layout.application_id}
    for chunk in reader.stream(store=layout):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if ":" in name:
                found[chunk.entity_path, name] = batch.column(name).to_pylist()
    return found


def test_files_match_the_script(make, tmp_path):
    make.write(tmp_path)
    for name in (make.RERUN, make.FOXGLOVE):
        assert (LAYOUTS / name).exists()
    assert (tmp_path / make.FOXGLOVE).read_bytes() == (LAYOUTS / make.FOXGLOVE).read_bytes()
    assert contents(tmp_path / make.RERUN) == contents(LAYOUTS / make.RERUN)


def test_layout_of_rerun_uses_existing_fields(make, fields):
    found = contents(LAYOUTS / make.RERUN)
    text = repr(list(found.values()))
    selectors = set(re.findall(r"'selector': '\.(\w+)'", text))
    assert len(selectors) == 12
    assert selectors <= fields[SAMPLE_TOPIC]
    assert set(re.findall(r"'source_component': '([^']+)'", text)) == {"rigd.Sample:message"}
    origins = {
        row[0]
        for key, rows in found.items()
        if key[1] == "ViewBlueprint:space_origin"
        for row in rows
    }
    assert origins == {SAMPLE_TOPIC, EVENT_TOPIC}


def panels(layout) -> list[str]:
    """Names in a tree of splits, as Foxglove has it."""
    if isinstance(layout, str):
        return [layout]
    assert layout["direction"] in ("row", "column")
    assert 0 < layout["splitPercentage"] < 100
    return panels(layout["first"]) + panels(layout["second"])


def test_layout_of_foxglove_uses_existing_paths(make, fields):
    layout = json.loads((LAYOUTS / make.FOXGLOVE).read_text("utf-8"))
    shown = panels(layout["layout"])
    assert sorted(shown) == sorted(layout["configById"])
    assert {name.partition("!")[0] for name in shown} == {"Plot", "RosOut"}
    (script,) = layout["userNodes"].values()
    source = script["sourceCode"]
    (inputs,) = re.findall(r"^export const inputs = (.*);$", source, re.MULTILINE)
    (output,) = re.findall(r'^export const output = "(.*)";$', source, re.MULTILINE)
    (computed,) = re.findall(r"^type Output = \{ (\w+): number \};$", source, re.MULTILINE)
    assert json.loads(inputs) == [SAMPLE_TOPIC]
    assert set(re.findall(r"event\.message\.(\w+)", source)) <= fields[SAMPLE_TOPIC]
    assert (
        f"return {{ {computed}: event.message.angle_reference_rad - event.message.angle_rad }}"
        in source
    )
    assert output not in fields
    known = fields | {output: {computed}}
    paths = [
        path["value"]
        for config in layout["configById"].values()
        for path in config.get("paths", [])
    ]
    for path in paths:
        topic, _, field = path.partition(".")
        assert field in known[topic], path
    wanted = (
        "angle_reference_rad", "angle_rad", "coupling_torque_nm", "torque_command_nm",
        "lateness_ns", "work_ns",
    )  # fmt: skip
    assert {f"{SAMPLE_TOPIC}.{field}" for field in wanted} < set(paths)
    assert f"{output}.{computed}" in paths
    (log,) = (c for name, c in layout["configById"].items() if name.startswith("RosOut!"))
    assert log["topicToRender"] == EVENT_TOPIC
    # The log panel needs the fields of a foxglove.Log.
    assert {"timestamp", "level", "message", "name"} <= fields[EVENT_TOPIC]


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def views_in_viewer(session):
    """Open files in Rerun's viewer, without a screen; return its views once they are right.

    `is_right` gets pictures of its views, by name; if they never become right, the last
    ones are returned. The second value is the views' reports of errors.
    """
    from rerun.experimental import ViewerClient

    from rigd.live._program import RerunProgram

    def shown(*files: str, is_right) -> tuple[dict[str, np.ndarray], list]:
        program = RerunProgram(
            (
                *(str(session / file) for file in files),
                *("--headless", "--window-size", "1280x800", "--port", "0"),
            ),
            {"XDG_DATA_HOME": str(session / "viewer"), "TMPDIR": str(session)},
        )
        try:
            views, reports = {}, []
            deadline = time.monotonic() + 300.0
            while not is_right(views) and time.monotonic() < deadline:
                time.sleep(0.2)  # for each answer it draws everything
                if not program.running:
                    viewer_ended(program)
                try:
                    client = ViewerClient.connect(
                        f"rerun+http://127.0.0.1:{program.grpc_port}/proxy"
                    )
                    state = client.get_state()
                    if not state.loading:
                        pictures = {
                            view.name: matplotlib.image.imread(
                                io.BytesIO(client.take_screenshot(view.view_id)), "png"
                            )
                            for view in state.views
                        }
                        reports = [report for view in state.views for report in view.reports]
                        views = pictures
                except (OSError, RuntimeError, ValueError):
                    continue  # it does not listen yet, or has not drawn a view yet
            return views, reports
        finally:
            program.kill()

    return shown


def count(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Return the number of pixels within a few grey levels of a colour."""
    distance = np.abs(image[..., :3] * 255.0 - np.array(color))
    return int(np.count_nonzero(np.all(distance < 12.0, axis=-1)))


COLORS = {
    "Motor angle (rad)": [ORANGE, SKY_BLUE],
    "Coupling torque (N·m)": [GREEN],
    "Torque command (N·m)": [PURPLE],
    "Forces at the sensor (N)": [ORANGE, SKY_BLUE, PURPLE],
    "Torques at the sensor (N·m)": [SKY_BLUE, PURPLE],
    # Of a session that was not in real time both are 0, and the topmost is seen.
    "Lateness and work time of the loop (ns)": [GREY, ORANGE],
    "Events": [],
}


def unseen(views) -> list:
    """Return which colours are not seen, and in which view."""
    return [
        (name, color)
        for name, colors in COLORS.items()
        for color in colors
        if name not in views or count(views[name], color) <= 30
    ]


def environment() -> dict[str, str]:
    return os.environ | {"PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}", "CI": "1"}


@pytest.mark.further  # the existence of the fields is tested above
def test_commands_of_the_page_show_plots_in_rerun(session, views_in_viewer):
    (block,) = (block for block in blocks("sh") if "mcap convert" in block)
    *prepare, show = block.splitlines()
    done = subprocess.run(
        ["bash", "-ec", "\n".join(prepare)],
        cwd=session, env=environment(), capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    words = show.split()
    assert words[:3] == ["rerun", "--bind", "127.0.0.1"]
    views, reports = views_in_viewer(
        *words[3:], is_right=lambda views: views.keys() == COLORS.keys() and not unseen(views)
    )
    assert views.keys() == COLORS.keys()
    assert unseen(views) == []
    assert reports == []


def test_python_of_the_page_writes_session_and_layout(session):
    from rerun.chunk import RrdReader

    (block,) = blocks("python")
    block = block.replace("session.rrd", "by_python.rrd")
    subprocess.run([sys.executable, "-c", block], cwd=session, env=environment(), check=True)
    reader = RrdReader(session / "by_python.rrd")
    (recording,), (layout,) = reader.recordings(), reader.blueprints()
    assert recording.application_id == layout.application_id == "rigd"
    count = sum(
        chunk.to_record_batch().num_rows
        for chunk in reader.stream()
        if chunk.entity_path == SAMPLE_TOPIC and "message_log_time" in chunk.timeline_names
    )
    assert count == 21_500


@pytest.mark.further  # the behaviour of another program
def test_session_file_opened_directly_shows_only_events(views_in_viewer):
    """As on the page: if a later Rerun does better, the page has to change.

    Now and then it shows nothing at all: the application of the layout, which has no recording.
    """
    counts = []

    def has_had_time(views: dict) -> bool:
        counts.append(len(views))
        return sum(counts) > 4 or len(counts) > 100

    views, _ = views_in_viewer(EXAMPLE, "docs/layouts/rigd.rbl", is_right=has_had_time)
    assert len(views) <= 1
    assert "Motor angle (rad)" not in views


@pytest.mark.further  # parsed in test_documents.py
def test_other_commands_of_the_page_run(session):
    (replay,) = (b.strip() for b in blocks("sh") if b.startswith("rigd replay"))
    command = ["bash", "-ec", f"{replay} --save seen.rrd"]
    subprocess.run(command, cwd=session, env=environment(), capture_output=True, check=True)
    assert (session / "seen.rrd").exists()
    # Their effect is tested with the analyser.
    (fits,) = (b for b in blocks("sh") if b.startswith("analyze"))
    assert fits.splitlines() == [f"analyze {EXAMPLE} --rerun fits.rrd", "rigd replay fits.rrd"]


def test_links_of_the_page_are_valid():
    headings = {
        re.sub(r"[^\w -]", "", line.lstrip("# ").lower()).replace(" ", "-")
        for line in PAGE.splitlines()
        if line.startswith("#")
    }
    for target in re.findall(r"\]\(([^)]+)\)", PAGE):
        if target.startswith("#"):
            assert target[1:] in headings, target
        else:
            assert (DOCS / target).exists(), target
