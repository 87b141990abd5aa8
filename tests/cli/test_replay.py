"""`rigd replay` shows the content of a file as in the live view."""

import importlib.util
import io
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import warm_start
from graphics import NO_GRAPHICS, viewer_ended
from processes import children, eventually, has_ended, listeners
from rerun_files import batches
from typer.testing import CliRunner

from analysis.models import WelchSettings
from analysis.paper import estimate
from analysis.record import load_record
from rigd.cli.app import app
from rigd.session import SessionError, SessionWriter, read_session, read_timings
from rigd.session.layout import SAMPLE_SIZE, TIMING_SIZE, Status, pack_sample_into, pack_timing_into
from rigd.view import draw_session
from rigd.view._recorded import describe_recorded_session
from rigd.view.frequency_charts import MAGNITUDE_ENTITY, ResponseCharts
from rigd.view.plots import AGES, GREEN, GREY, ORANGE, SKY_BLUE

pytestmark = pytest.mark.process

RIGD = Path(sys.executable).parent / "rigd"
QUICK = ("--duration", "4", "--rest", "0.5", "--ring-down", "0.5", "--stop-hz", "10", "--fast")
LOOPBACK = "0100007F"  # 127.0.0.1 as /proc/net/tcp writes it


def run(*arguments, **options):
    return warm_start.run(
        [RIGD, *map(str, arguments)], capture_output=True, text=True, check=False, **options
    )


def assert_error(done, code, *words):
    """Check that the only output is a message of one or two sentences."""
    assert done.returncode == code, done.stdout + done.stderr
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("Error: ")
    for word in words:
        assert word in line, line


def columns(batches: list, *names: str) -> dict[str, np.ndarray]:
    """Return times in ns and the values of components, (n, k), of one entity's timely batches."""
    timely = [batch for batch in batches if "session_time" in batch.schema.names]
    parts: dict[str, list] = {name: [] for name in ("t_ns", *names)}
    for batch in timely:
        parts["t_ns"].append(batch.column("session_time").cast("int64").to_numpy())
        for name in names:
            values = batch.column(name).flatten().to_numpy(zero_copy_only=False)
            parts[name].append(values.reshape(batch.num_rows, -1))
    return {name: np.concatenate(blocks) for name, blocks in parts.items()}


def rows(batches: list, name: str) -> list[tuple[int, list]]:
    """Return times in ns and values of a component whose rows have different lengths."""
    found = []
    for batch in batches:
        if {"session_time", name} <= set(batch.schema.names):
            times = batch.column("session_time").cast("int64").to_pylist()
            found += zip(times, batch.column(name).to_pylist(), strict=True)
    return sorted(found, key=lambda row: row[0])


@pytest.fixture(scope="module")
def chirp_recording(made_once, short_chirps):
    """A chirp of 20 s to 50 Hz, and its recording by `--save`."""
    path = short_chirps[0]

    def make(folder):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            done = CliRunner().invoke(app, ["replay", str(path), "--save", "chirp.rrd"])
        assert (done.exit_code, done.stdout) == (0, ""), done.stderr
        assert done.stderr == "chirp.rrd: open it with rigd replay chirp.rrd.\n"

    folder = made_once("replayed", make)
    return read_session(path), batches(folder / "chirp.rrd"), folder / "chirp.rrd"


@pytest.fixture(scope="module")
def short_session(tmp_path_factory):
    """A session of 5 s."""
    folder = tmp_path_factory.mktemp("short")
    done = run("run", "chirp", *QUICK, "--json", "--output", ".", cwd=folder)
    assert done.returncode == 0, done.stderr
    (session,) = json.loads(done.stdout)["sessions"]
    return folder / session["path"]


@pytest.fixture(scope="module")
def recording(short_session):
    """The recording by `--save` of the short session."""
    path = short_session.with_suffix(".rrd")
    assert run("replay", short_session, "--save", path).returncode == 0
    return path


def test_every_sample_is_shown_in_units_of_the_plots(chirp_recording):
    session, found, _ = chirp_recording
    samples = session.samples
    shown = columns(
        found["/signals"],
        "angle_mrad", "tracking_error_mrad", "coupling_torque_nm", "torque_command_nm",
        "forces_n", "torques_nm", "loop_us",
    )  # fmt: skip
    assert np.array_equal(shown["t_ns"], samples["t_ns"])
    reference, angle = samples["angle_reference_rad"], samples["angle_rad"]
    assert shown["angle_mrad"] == pytest.approx(1e3 * np.column_stack([reference, angle]))
    assert shown["tracking_error_mrad"][:, 0] == pytest.approx(1e3 * (reference - angle), abs=1e-9)
    for name in ("coupling_torque_nm", "torque_command_nm"):
        assert np.array_equal(shown[name][:, 0], samples[name])
    for name, fields in (
        ("forces_n", ("fx_n", "fy_n", "fz_n")),
        ("torques_nm", ("tx_nm", "ty_nm", "tz_nm")),
    ):
        assert np.array_equal(shown[name], np.column_stack([samples[f] for f in fields]))


def test_frequency_response_grows_with_the_sweep(chirp_recording):
    session, found, _ = chirp_recording
    chart = ResponseCharts(describe_recorded_session(session)).chart(MAGNITUDE_ENTITY)
    left, _, right, _ = chart.frame_edges
    first_hz, last_hz = chart.x.start_value, chart.x.end_value
    drawn = rows(found[f"{MAGNITUDE_ENTITY}/measured"], "LineStrips2D:strips")
    assert len({t_ns for t_ns, _ in drawn}) > 15  # once a second
    for time_s, least_hz, most_hz in ((0.5, 0.0, 0.0), (8.5, 17.0, 19.0), (15.5, 34.5, 36.5)):
        # At that time a viewer shows the last drawing before it.
        strips = [strips for t_ns, strips in drawn if t_ns <= 1e9 * time_s][-1]
        if most_hz == 0.0:
            assert not strips
            continue
        reached = max(x for strip in strips for x, _ in strip)
        reached_hz = first_hz * (last_hz / first_hz) ** ((reached - left) / (right - left))
        # The chirp's frequency at that time is 0.05 Hz + 2.4975 Hz a second of sweep.
        assert least_hz < reached_hz < most_hz


def test_last_frequency_response_is_that_of_analyze(chirp_recording):
    session, found, _ = chirp_recording
    chart = ResponseCharts(describe_recorded_session(session)).chart(MAGNITUDE_ENTITY)
    left, top, right, bottom = chart.frame_edges
    # All of it, coherent or not.
    *_, (_, strips) = rows(found[f"{MAGNITUDE_ENTITY}/uncertain"], "LineStrips2D:strips")
    points = np.concatenate([np.asarray(strip, dtype=np.float64) for strip in strips])
    fraction = (points[:, 0] - left) / (right - left)
    frequency_hz = chart.x.start_value * (chart.x.end_value / chart.x.start_value) ** fraction
    level = (bottom - points[:, 1]) / (bottom - top)
    measured_db = chart.y.start_value + level * (chart.y.end_value - chart.y.start_value)
    reference, _ = estimate(load_record(session.path), WelchSettings())
    inside = (frequency_hz > 0.6) & (frequency_hz < 49.9) & (level > 1e-3) & (level < 1 - 1e-3)
    assert inside.sum() > 250
    nearest = np.abs(reference.frequency_hz[:, None] - frequency_hz[inside]).argmin(axis=0)
    expected_db = 20 * np.log10(np.abs(reference.response[nearest]))
    # Drawn in single precision: a hundredth of a point on the canvas is 0.005 dB.
    assert np.abs(measured_db[inside] - expected_db).max() < 0.0864  # 1 %


def test_the_antenna_moves_and_the_spectrogram_grows(chirp_recording):
    _, found, _ = chirp_recording
    beam = columns(found["/antenna/beam"], "LineStrips3D:strips")["t_ns"] * 1e-9
    assert beam[-1] == pytest.approx(21.5, abs=0.06)
    assert np.diff(beam) == pytest.approx(0.05, abs=1e-6)
    sizes = [len(row[0]) for _, row in rows(found["/spectrogram/levels"], "DepthImage:buffer")]
    assert len(sizes) >= 20
    assert sizes == sorted(sizes)
    assert sizes[-1] > 40 * sizes[0]


def test_the_log_has_the_events_and_the_outcome(chirp_recording):
    session, found, _ = chirp_recording
    texts = [text for _, (text,) in rows(found["/events"], "TextLog:text")]
    assert [event.message for event in session.events] == texts[: len(session.events)]
    assert texts[-1] == "Outcome: complete."


SIMULATION_TITLES = {
    "Antenna",
    "Coherence of angle and torque",
    "Coupling torque, tared (N·m)",
    "Events",
    "Events, newest first",
    "Forces at the sensor (N)",
    "Frequency response: magnitude of torque over angle",
    "Health",
    "Magnitude of torque over angle",
    "Missed, late and lost (ticks since the start)",
    "Motor angle (mrad)",
    "Phase of torque over angle",
    "Spectrogram of the coupling torque",
    "State",
    "Torque command, after limits (N·m)",
    "Torques at the sensor (N·m)",
    "Tracking error, reference − measured (mrad)",
    "Values and limits",
}
"""Titles of a session under the virtual clock."""


def test_recording_plays_from_its_start_in_the_live_layout(chirp_recording):
    from rerun.blueprint.components import PlayState
    from rerun.chunk import RrdReader

    session, found, path = chirp_recording
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    parts: dict[str, list] = {}
    for chunk in reader.stream(store=layout):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if "Blueprint:" in name:
                parts.setdefault(name, []).extend(batch.column(name).to_pylist())
    assert parts["TimePanelBlueprint:play_state"] == [[PlayState.Playing.value]]
    assert parts["TimePanelBlueprint:timeline"] == [["session_time"]]
    titles = {title for row in parts["ViewBlueprint:display_name"] for title in row or ()}
    # A file has neither processes nor, if there was none, real time.
    assert titles == SIMULATION_TITLES
    texts = [text for _, (text,) in rows(found["/state"], "TextDocument:text")]
    assert all(text.startswith("# Recorded: COMPLETE") for text in texts)
    assert "now **" in texts[len(texts) // 2]
    (recording,) = reader.recordings()
    assert recording.application_id == "rigd"
    starts_ns = [
        batch.column("RecordingInfo:start_time").flatten().cast("int64").to_pylist()
        for batch in found["/__properties"]
        if "RecordingInfo:start_time" in batch.schema.names
    ]
    assert starts_ns[-1][-1] == session.start_utc_ns


def test_plot_of_ages_for_a_real_rig(write_session_file):
    path = write_session_file("ages.mcap", np.arange(10))
    session, timings = read_session(path), read_timings(path)
    samples = session.samples.copy()
    samples["work_ns"] = 1000  # in simulated time there is none
    of_a_rig = replace(session, samples=samples)
    assert AGES.component not in describe_recorded_session(of_a_rig, timings).absent_components
    for without in (None, timings[:0]):
        assert AGES.component in describe_recorded_session(of_a_rig, without).absent_components


MINIMAL_METADATA = {
    "rate_hz": "1000.0",
    "beam_length_m": "0.98",
    "beam_density_kg_per_m": "4.7e-3",
    "beam_bending_stiffness_n_m2": "0.0903",
}


@pytest.fixture
def write_session_file(tmp_path):
    """Write a session of a swaying motor, not made by the rig."""

    def session(
        name, ticks, status=(), metadata=None, segments=None, outcome=None, profile=None
    ) -> Path:
        block = bytearray(len(ticks) * SAMPLE_SIZE)
        status = [0] * len(ticks) if len(status) == 0 else status
        for index, (tick, bits) in enumerate(zip(ticks, status, strict=True)):
            angle_rad = 0.02 * np.sin(6.0 * tick / 1000)
            pack_sample_into(
                block, index * SAMPLE_SIZE, int(tick) * 1_000_000, int(tick), angle_rad, angle_rad,
                0.0, -0.01 * angle_rad, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, int(bits), 0, 0,
            )  # fmt: skip
        writer = SessionWriter(tmp_path / name)
        attachments = {} if profile is None else {"profile.toml": profile}
        writer.begin(10**18, MINIMAL_METADATA | (metadata or {}), segments or {}, attachments)
        writer.write_samples(block)
        ages = bytearray(len(ticks) * TIMING_SIZE)
        for index, tick in enumerate(ticks):
            age_s = 1e-6 * (index % 100)
            pack_timing_into(ages, index * TIMING_SIZE, int(tick) * 1_000_000, tick, age_s, -age_s)
        writer.write_timings(ages)
        return writer.close(outcome or {})

    return session


@pytest.fixture
def save_recording(rigd_here):
    """Return the batches of the recording by `--save`."""

    def save(path: Path) -> dict[str, list]:
        out = path.with_suffix(".rrd")
        done = rigd_here("replay", path, "--save", out)
        assert done.returncode == 0, done.stderr
        return batches(out)

    return save


def test_counts_of_missing_and_late_ticks(write_session_file, save_recording):
    ticks = np.concatenate([np.arange(100, 1500), np.arange(1510, 2500), np.arange(2504, 4000)])
    status = np.zeros(ticks.size, int)
    status[[0, 1400]] = Status.AFTER_MISSED
    status[1400 + 990] = Status.AFTER_LOST
    status[500:520] = Status.LATE
    found = save_recording(write_session_file("gaps.mcap", ticks, status))
    shown = columns(found["/health"], "faulty_ticks")
    by_second = dict(zip(shown["t_ns"] // 10**9, shown["faulty_ticks"].tolist(), strict=True))
    assert by_second == {
        0: [100.0, 20.0, 0.0],
        1: [110.0, 20.0, 0.0],
        2: [110.0, 20.0, 4.0],
        3: [110.0, 20.0, 4.0],
    }
    assert len(columns(found["/signals"], "angle_mrad")["t_ns"]) == ticks.size


def test_minimal_file_is_shown_without_a_model(write_session_file, save_recording):
    ticks = np.arange(2000)
    found = save_recording(write_session_file("least.mcap", ticks))
    assert f"{MAGNITUDE_ENTITY}/model" not in found
    assert f"{MAGNITUDE_ENTITY}/measured" in found
    assert len(columns(found["/antenna/beam"], "LineStrips3D:strips")["t_ns"]) == 40
    ages = columns(found["/readings"], "ages_ms")
    assert np.array_equal(ages["t_ns"], ticks * 1_000_000)
    age_ms = 1e-3 * (ticks % 100)
    assert ages["ages_ms"] == pytest.approx(np.column_stack([age_ms, -age_ms]))


def test_stopped_session_ends_with_the_reason(write_session_file, save_recording):
    path = write_session_file(
        "stopped.mcap",
        np.arange(700),
        segments={"rest": (0, 500), "sweep": (500, 20_500)},
        outcome={"outcome": "fault", "reason": "The drive does not answer."},
    )
    found = save_recording(path)
    (event,) = rows(found["/events"], "TextLog:text")
    assert event == (699_000_000, ["Outcome: fault. The drive does not answer."])
    (level,) = rows(found["/events"], "TextLog:level")
    assert level[1] == ["ERROR"]
    # As in the live view: the recorded part of the planned time.
    *_, (_, (state,)) = rows(found["/summary"], "TextDocument:text")
    assert "1 of 20 s" in state


def test_errors_of_wrong_use(rigd_here, short_chirps, tmp_path):
    session_path = short_chirps[0]
    taken = tmp_path / "taken.rrd"
    taken.write_bytes(b"mine")
    assert_error(
        rigd_here("replay", session_path, "--save", taken),
        2,
        "taken.rrd exists",
        "nothing is overwritten",
    )
    assert taken.read_bytes() == b"mine"
    assert_error(
        rigd_here("replay", session_path, "--save", tmp_path / "a.txt"), 2, "--save", ".rrd"
    )
    assert_error(
        rigd_here("replay", session_path, "--save", tmp_path / "a.rrd", "--web"), 2, "--web"
    )
    assert_error(rigd_here("replay", taken, "--save", tmp_path / "a.rrd"), 2, "already")
    assert not (tmp_path / "a.rrd").exists()


def test_errors_of_unusable_files(rigd_here, short_chirps, write_session_file, tmp_path):
    session_path = short_chirps[0]
    out = ("--save", tmp_path / "out.rrd")
    assert_error(rigd_here("replay", tmp_path / "none.mcap", *out), 1, "none.mcap cannot be read")
    torn = tmp_path / "torn.mcap.part"
    torn.write_bytes(session_path.read_bytes()[:-3000])
    assert_error(
        rigd_here("replay", torn, *out), 1, "torn.mcap.part is incomplete", "`rigd recover "
    )
    assert_error(
        rigd_here("replay", write_session_file("empty.mcap", []), *out),
        1,
        "no samples were recorded",
    )
    sparse = write_session_file("sparse.mcap", np.arange(100) * 1000)
    assert_error(rigd_here("replay", sparse, *out), 1, "only 100 of the 99001 ticks")
    still = write_session_file("still.mcap", np.arange(100), metadata={"beam_length_m": "0"})
    assert_error(rigd_here("replay", still, *out), 1, "beam_length_m is 0 m")
    quick = write_session_file("quick.mcap", np.arange(100), metadata={"rate_hz": "1e9"})
    assert_error(rigd_here("replay", quick, *out), 1, "rate_hz is 1e+09 Hz, but must be from 1 to")
    false = tmp_path / "false.rrd"
    false.write_text("no recording")
    assert_error(rigd_here("replay", false, "--web"), 1, "is not a Rerun recording")
    assert_error(rigd_here("replay", tmp_path / "none.rrd", "--web"), 1, "none.rrd cannot be read")
    os.mkfifo(tmp_path / "pipe.rrd")
    assert_error(rigd_here("replay", tmp_path / "pipe.rrd", "--web"), 1, "pipe.rrd is not a file")
    long = tmp_path / f"{'x' * 300}.rrd"
    assert_error(
        rigd_here("replay", session_path, "--save", long),
        2,
        "cannot be written: File name too long",
    )
    assert not (tmp_path / "out.rrd").exists()


def test_rerun_variables_of_the_environment_are_ignored(
    rigd_here, write_session_file, tmp_path, monkeypatch
):
    monkeypatch.setenv("RERUN", "off")
    monkeypatch.setenv("_RERUN_TEST_FORCE_SAVE", str(tmp_path / "elsewhere.rrd"))
    monkeypatch.setenv("RERUN_FLUSH_NUM_BYTES", "one")
    out = tmp_path / f"{'x' * 250}.rrd"  # as long as a name can be
    done = rigd_here("replay", write_session_file("brief.mcap", np.arange(700)), "--save", out)
    assert done.returncode == 0, done.stderr
    assert batches(out)["/signals"]
    assert not (tmp_path / "elsewhere.rrd").exists()


def test_error_if_the_start_time_is_too_late(write_session_file):
    path = write_session_file("late.mcap", np.arange(700))
    late = replace(read_session(path), start_utc_ns=2**63)
    with pytest.raises(SessionError, match="start_utc_ns is 9223372036854775808 ns, after"):
        draw_session(None, late, read_timings(path))


@pytest.mark.further  # as the full disk of a session is
def test_full_disk_is_reported_and_leaves_no_file(short_session, tmp_path):
    def limit_file_size():
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    done = run(
        "replay", short_session, "--save", "out.rrd", cwd=tmp_path, preexec_fn=limit_file_size
    )
    assert_error(done, 1, "out.rrd cannot be written: File too large")
    temporary = os.environ | {"TMPDIR": str(tmp_path)}
    done = run(
        "replay", short_session, "--web", cwd=tmp_path, preexec_fn=limit_file_size, env=temporary
    )
    assert_error(done, 1, ".rrd cannot be written: File too large")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("delay_s", "appears"), [(-1.0, True), (600.0, False)])
def test_progress_appears_after_a_delay(
    rigd_here, write_session_file, monkeypatch, tmp_path, delay_s, appears
):
    monkeypatch.setattr("rigd.cli.options._PROGRESS_DELAY_S", delay_s)
    monkeypatch.setenv("FORCE_COLOR", "1")
    path = write_session_file("brief.mcap", np.arange(700))
    done = rigd_here("replay", path, "--save", tmp_path / "out.rrd")
    assert done.returncode == 0, done.stderr
    assert (path.name in done.stderr.partition("open it with")[0]) == appears


def test_error_without_a_screen_names_alternatives(rigd_here, write_session_file, monkeypatch):
    session = write_session_file("brief.mcap", np.arange(700))
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert_error(rigd_here("replay", session), 1, "no screen", "--web", "--save")
    for name in ("nonsense.txt", "nonsense.rrd"):
        nonsense = session.with_name(name)
        nonsense.write_text("hello")
        assert_error(rigd_here("replay", nonsense), 1, str(nonsense), "Give a")
        assert_error(rigd_here("replay", f"{nonsense}.gone.mcap"), 1, "No such file")
    seen = session.with_name("seen.rrd")
    seen.write_bytes(b"RRF2")
    recording = rigd_here("replay", seen)
    assert_error(recording, 1, "no screen", "--web")
    assert "--save" not in recording.stderr


@pytest.mark.further  # as that of a live view
def test_error_if_no_window_can_be_opened(rerun_program, short_session, tmp_path):
    environment = {k: v for k, v in os.environ.items() if k != "WAYLAND_DISPLAY"}
    environment |= {"DISPLAY": ":48123", "TMPDIR": str(tmp_path)}
    done = run("replay", short_session, env=environment, timeout=300)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "--web shows the same in a browser" in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def rerun_program():
    package = importlib.util.find_spec("rerun_cli")
    assert package is not None
    path = Path(package.origin).with_name("rerun")
    try:
        subprocess.run([path, "--version"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"LIVE VIEW NOT TESTED: the rerun program does not run here: {error}")
    return path


@pytest.fixture
def served(rerun_program, short_session, tmp_path):
    """`rigd replay --web` of the short session, once it has printed its address."""
    process = subprocess.Popen(
        [RIGD, "replay", short_session, "--web"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    address = process.stdout.readline().strip()
    yield process, address
    process.kill()
    process.communicate()


@pytest.mark.further  # as tests/live/test_live_page.py
def test_page_is_served_on_loopback_until_ended(served, tmp_path):
    process, address = served
    assert address.startswith("http://127.0.0.1:"), process.stderr.read()
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(address, timeout=30.0) as answer:
        page = answer.read().decode()
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert "rerun" in page.lower()
    (server,) = children(process.pid)
    ends = listeners(process.pid) | listeners(server)
    assert {end.addresses[0] for end in ends} == {LOOPBACK}
    (folder,) = tmp_path.iterdir()
    assert [path.suffix for path in folder.iterdir()] == [".rrd"]
    printed = process.stderr.readline()
    assert "is shown there until Ctrl-C. From another computer: ssh -L " in printed
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=300.0)
    assert process.returncode == 130
    assert list(tmp_path.iterdir()) == []
    assert eventually(lambda: has_ended(server))


@pytest.mark.further  # as that of a live view
def test_death_of_the_server_is_reported(served, tmp_path):
    process, _ = served
    (server,) = children(process.pid)
    os.kill(server, signal.SIGKILL)
    _, printed = process.communicate(timeout=300.0)
    assert process.returncode == 1
    assert printed.splitlines()[-1].startswith("Error: The Rerun server ended: ")
    assert list(tmp_path.iterdir()) == []


COLORS = {
    "Motor angle (mrad)": [ORANGE, SKY_BLUE],
    "Coupling torque, tared (N·m)": [GREEN],
    "Values and limits": [GREEN],  # the session was complete, and near no limit
    "Frequency response: magnitude of torque over angle": [SKY_BLUE, ORANGE, GREY],
}
"""Views of the first tab → expected colours."""


def count(image: np.ndarray, color: tuple[int, int, int]) -> int:
    """Return the number of pixels within a few grey levels of a colour."""
    distance = np.abs(image[..., :3] * 255.0 - np.array(color))
    return int(np.count_nonzero(np.all(distance < 12.0, axis=-1)))


def missing_colors(viewer, colors: dict) -> list:
    """Return the colours that are missing in the views of the front tab."""
    missing = {(name, color) for name in colors for color in colors[name]}
    for view in viewer.get_state().views:
        assert view.reports == []
        if view.name in colors:
            try:
                shot = viewer.take_screenshot(view.view_id)
            except ConnectionError:
                continue  # it is one of the same name on another tab
            image = matplotlib.image.imread(io.BytesIO(shot), "png")
            missing -= {(view.name, c) for c in colors[view.name] if count(image, c) >= 40}
    return sorted(missing)


@pytest.mark.further  # as the live view's
def test_another_port_if_the_first_is_taken(rerun_program, recording, tmp_path, monkeypatch):
    from rigd.live import PageOfFile

    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        monkeypatch.setattr("rigd.live._viewer.free_port", lambda wanted: taken)
        with PageOfFile(recording, tmp_path) as page:
            assert page.program.grpc_port not in (0, taken)
            assert page.address.grpc_port == page.program.grpc_port


@pytest.mark.further  # as tests/live/test_live_window.py
@pytest.mark.parametrize("client_kind", ["window", "browser"])
def test_viewer_shows_the_recording(rerun_program, recording, tmp_path, client_kind):
    """In Rerun's own viewer, without a screen: opened as the window is, and as browsers do."""
    from rerun.experimental import ViewerClient

    from rigd.live import FileWindow, PageOfFile, Viewer

    headless = ("--headless", "--window-size", "960x600")
    if client_kind == "window":
        program, page = FileWindow(recording, tmp_path, headless).program, None
    else:
        page = PageOfFile(recording, tmp_path)
        program = Viewer(page.address, tmp_path, headless).program
    try:
        assert eventually(lambda: not program.running or program.grpc_port)
        url = f"rerun+http://127.0.0.1:{program.grpc_port}/proxy"

        def client():
            try:
                return ViewerClient.connect(url)
            except (OSError, RuntimeError):
                return None

        found = eventually(lambda: not program.running or client())
        if not program.running:
            viewer_ended(program)
        with found as viewer:

            def loaded() -> bool:
                try:
                    state = viewer.get_state()
                except ConnectionError:
                    # It listens before it draws, and drawing may fail on this computer.
                    eventually(lambda: not program.running)
                    viewer_ended(program)
                ends = [line.end for r in state.recordings for line in r.timelines if line.end]
                return bool(ends) and not state.loading and max(ends) >= 4_999_000_000

            assert eventually(loaded, every_s=0.1)  # for each answer it draws everything
            viewer.set_time("session_time", duration=4.4, play_state="paused")
            complete = eventually(lambda: not missing_colors(viewer, COLORS), every_s=0.1)
            assert complete, missing_colors(viewer, COLORS)
            if page is None:
                ends = {end.addresses[0] for end in listeners(program.pid)}
                assert ends == {LOOPBACK}
    finally:
        program.kill()
        if page is not None:
            page.close()


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="there is no Xvfb to open a window in")
def test_window_is_closed_with_the_command(rerun_program, short_session, tmp_path):
    screen = subprocess.Popen(
        ["Xvfb", "-displayfd", "1", "-screen", "0", "800x600x24", "-nolisten", "tcp"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        display = screen.stdout.readline().strip()
        environment = {k: v for k, v in os.environ.items() if k != "WAYLAND_DISPLAY"}
        process = subprocess.Popen(
            [RIGD, "replay", short_session],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment | {"DISPLAY": f":{display}", "TMPDIR": str(tmp_path)},
        )
        printed = process.stderr.readline()
        assert (
            printed
            == f"{short_session.name} is shown; close the window, or press Ctrl-C, to end.\n"
        )
        (viewer,) = children(process.pid)
        assert eventually(lambda: process.poll() is not None or listeners(viewer))
        if process.poll() is not None:
            pytest.skip(f"{NO_GRAPHICS}: {process.stderr.read()}")
        assert {end.addresses[0] for end in listeners(viewer)} == {LOOPBACK}
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=300.0)
        assert process.returncode == 130
        assert list(tmp_path.iterdir()) == []
        assert eventually(lambda: has_ended(viewer))
    finally:
        screen.kill()
        screen.communicate()
