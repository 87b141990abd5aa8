"""Sessions of a series and their output on a terminal, without processes."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import pytest
from shipped_profile import load_shipped

from rigd.engine.shared_state import Phase
from rigd.excitation import hold, touch
from rigd.profile import load_profile
from rigd.runner import ProgressLine, RigStoppedError, Series, plan_lines, result_line
from rigd.runner.planning import RefusedError, RigPreview
from rigd.runner.request import NoRoomError
from rigd.runner.session import SessionResult
from rigd.runtime import StopRequest
from rigd.testing import write_profile

COMPLETE = SessionResult(None, "complete", "", 1200, 1200, 0, 0, 0, fault=False)
NO_QUICK_LOOK = ("look_follows", False)


class Rig:
    """Runs nothing, and records its orders."""

    def __init__(self, *results):
        self.results = list(results)
        self.orders = []

    def show_session(self, order, stop):
        return "Live view: there"

    def run(self, order, stop, listener, listens):
        self.orders.append(order)
        return self.results.pop(0)


class RecordingListener:
    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *arguments, **options: self.calls.append((name, *arguments, *options.items()))


@pytest.fixture
def make_series(tmp_path):
    profile = load_shipped("sim")
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=1.0, rest_s=0.2, ring_down_s=0.0)

    def make(**options):
        return Series(profile, excitation, tmp_path / "out", **options)

    return make


@pytest.mark.process
def test_series_ends_with_the_first_failed_session(make_series):
    series = make_series(session_count=4, notes={"operator": "Ada", "note": ""})
    bad = replace(COMPLETE, outcome="fault")
    rig, listener = Rig(COMPLETE, bad), RecordingListener()
    series.run(rig, StopRequest(), listener, with_live_view=True)
    assert series.results == [COMPLETE, bad]
    assert [dict(order.notes) for order in rig.orders] == [
        {"operator": "Ada", "series": "1 of 4"},
        {"operator": "Ada", "series": "2 of 4"},
    ]
    first, second = (order.path for order in rig.orders)
    assert first.stem.endswith("-hold-01")
    assert listener.calls == [
        ("on_start", 1, first), ("on_live_view", "Live view: there"),
        ("on_result", COMPLETE, NO_QUICK_LOOK),
        ("on_start", 2, second), ("on_live_view", "Live view: there"),
        ("on_result", bad, NO_QUICK_LOOK),
    ]  # fmt: skip


@pytest.mark.process
def test_single_session_is_not_numbered(make_series):
    rig = Rig(COMPLETE)
    make_series().run(rig, StopRequest(), RecordingListener(), with_live_view=False)
    (order,) = rig.orders
    assert order.notes == ()
    assert dict(order.predicted_metadata)["limit_angle_rad"] == "1.57"
    assert float(dict(order.predicted_metadata)["predicted_peak_velocity_rad_s"]) >= 0.0
    assert float(dict(order.predicted_metadata)["predicted_peak_tip_slope_rad"]) >= 0.0
    assert order.path.stem.endswith("-hold")


@pytest.mark.process
def test_seeds_of_a_series_follow_from_the_stated_seed(make_series):
    def seeds():
        rig = Rig(*[COMPLETE] * 3)
        make_series(session_count=3).run(
            rig, StopRequest(), RecordingListener(), with_live_view=False
        )
        return [order.seed for order in rig.orders]

    assert seeds()[0] == 1
    assert len(set(seeds())) == 3
    assert seeds() == seeds()


def test_no_shipped_profile_states_a_seed():
    for name in ("sim", "antenna_can", "antenna_serial"):
        assert load_profile(name).rig.simulation.seed is None


@pytest.mark.process
def test_no_session_begins_after_a_stop(make_series):
    stop, listener = StopRequest(), RecordingListener()
    stop.request()
    make_series(session_count=2).run(Rig(), stop, listener, with_live_view=False)
    assert listener.calls == []


@pytest.mark.process
def test_full_disk_retains_the_results_so_far(make_series, tmp_path):
    series = make_series(session_count=3)

    class RigWithFullDisk(Rig):
        def run(self, *order):
            (tmp_path / "out").rmdir()
            (tmp_path / "out").touch()
            return super().run(*order)

    with pytest.raises(NoRoomError, match="cannot be created"):
        series.run(
            RigWithFullDisk(COMPLETE), StopRequest(), RecordingListener(), with_live_view=False
        )
    assert series.results == [COMPLETE]


class FakeQuickLookQueue:
    """Quick looks that take three attempts each."""

    def __init__(self, calls):
        self.calls, self.left = calls, 0

    @property
    def is_busy(self):
        return self.left > 0

    def add_session(self, path):
        self.calls.append(("look", path.stem[-2:]))
        self.left = 3

    def poll(self):
        self.left -= 1

    @contextlib.contextmanager
    def suspended(self):
        self.calls.append("held")
        yield
        self.calls.append("let go")


@pytest.mark.process
def test_quick_look_is_suspended_during_a_session(make_series):
    listener = RecordingListener()

    class WatchedRig(Rig):
        def check_control_process(self):
            listener.calls.append("watch")

        def run(self, *order):
            listener.calls.append("run")
            return super().run(*order)

    stopped = replace(COMPLETE, path=None)
    results = (replace(COMPLETE, path=Path(f"a-0{number}.mcap")) for number in (1, 2))
    queue = FakeQuickLookQueue(listener.calls)
    series = make_series(session_count=3)
    series.run(
        WatchedRig(*results, stopped),
        StopRequest(),
        listener,
        with_live_view=False,
        quick_looks=queue,
    )
    session = ["held", "run", "let go", "on_result"]
    pause = ["look", "watch", "watch", "watch"]
    names = [each if isinstance(each, str) else each[0] for each in listener.calls]
    assert names == ["on_start", *session, *pause] * 2 + ["on_start", *session]
    ends = [each[-1] for each in listener.calls if each[0] == "on_result"]
    assert ends == [("look_follows", True), ("look_follows", True), NO_QUICK_LOOK]


@pytest.mark.process
@pytest.mark.parametrize("signalled", ["supervisor", "both", "control"])
def test_stop_ends_the_wait_for_a_quick_look(make_series, signalled):
    listener, stop = RecordingListener(), StopRequest()

    class StoppingRig(Rig):
        def check_control_process(self):
            listener.calls.append("watch")
            if signalled != "control":
                stop.request()
            if signalled != "supervisor":
                raise RigStoppedError

    queue = FakeQuickLookQueue(listener.calls)
    result = replace(COMPLETE, path=Path("a-01.mcap"))
    unrequested = pytest.raises(RigStoppedError, match=r"was asked to end\.$")
    with unrequested if signalled == "control" else contextlib.nullcontext():
        make_series(session_count=3).run(
            StoppingRig(result), stop, listener, with_live_view=False, quick_looks=queue
        )
    names = [each if isinstance(each, str) else each[0] for each in listener.calls]
    assert names == ["on_start", "held", "let go", "on_result", "look", "watch"]


def test_stop_signal_in_a_probing_move_is_no_failure(tmp_path, monkeypatch):
    profile, stop, rig = load_shipped("antenna_can"), StopRequest(), Rig()
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=1.0, rest_s=0.2, ring_down_s=0.0)
    rig.connected = False

    def end_by_signal(*_, **__):
        raise RigStoppedError

    monkeypatch.setattr("rigd.runner._probing.verify_by_probing", end_by_signal)
    series = Series(profile, excitation, tmp_path / "out")
    with pytest.raises(RigStoppedError):
        series.run(rig, stop, RecordingListener(), with_live_view=False)
    monkeypatch.setattr(
        "rigd.runner._probing.verify_by_probing", lambda *_, **__: stop.request() or end_by_signal()
    )
    series.run(rig, stop, RecordingListener(), with_live_view=False)
    assert not rig.orders


@pytest.mark.process
def test_no_quick_look_after_a_move(tmp_path):
    profile, listener = load_shipped("sim"), RecordingListener()
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=1.0, rest_s=0.2, ring_down_s=0.0)
    recorded, queue = replace(COMPLETE, path=Path("a.mcap")), FakeQuickLookQueue(listener.calls)
    series = Series(profile, replace(excitation, stays=True), tmp_path / "out")
    series.run(Rig(recorded), StopRequest(), listener, with_live_view=False, quick_looks=queue)
    assert listener.calls[-2:] == ["let go", ("on_result", recorded, NO_QUICK_LOOK)]


def test_plan_lines_of_new_and_older_documents(make_series):
    document = json.loads(json.dumps(make_series().plan_document()))
    first, peaks, *_ = plan_lines(document)
    assert first == "hold on sim, record of 1.2 s."
    assert " N·m (limit 0.9)." in peaks
    for name in ("excitation", "profile", "limits", "tip_in_words"):  # as before an update
        del document[name]
    first, peaks = plan_lines(document)
    assert first == "record of 1.2 s."
    assert "limit" not in peaks


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "Complete: no record."),
        ({"outcome": "fault", "reason": "Gone."}, "Fault: no record. Gone."),
        ({"part": "a.mcap.part"}, "Complete: file incomplete, a.mcap.part."),
        (
            {"path": "a.mcap", "scheduled": 136_000, "recorded": 135_997, "missed": 1, "lost": 2},
            "Complete: 135 997 of 136 000 samples, 1 missed, 0 late, 2 lost.",
        ),
    ],
)
def test_result_line(changes, expected):
    assert result_line(COMPLETE.as_dict() | changes) == expected


def test_last_message_is_written(capsys):
    for number in range(20):
        line = ProgressLine()
        line.write_message("[first]")
        line.write_message(f"last {number}")
        line.close()
        assert capsys.readouterr().err == f"[first]\nlast {number}\n"


def test_progress_redraws_the_line_a_few_times_a_second(monkeypatch):
    """However frequent the updates: drawing costs more than a supervisor's other work."""
    line, drawn, now_s = ProgressLine(), [], 0.0
    with monkeypatch.context() as patched:
        patched.setattr("rigd.runner._console.time.monotonic", lambda: now_s)
        patched.setattr(line._has_changed, "set", lambda: drawn.append(now_s))
        for tick in range(1000):
            now_s = tick / 1000
            line.update(Phase.RUNNING, tick, 1000, missed_ticks=0, late_ticks=0)
        assert 15 <= len(drawn) <= 21
        line.write_message("at once")
        assert drawn[-1] == now_s
    line.close()


def test_error_if_required_metadata_is_missing(tmp_path):
    required = ["operator", "temperature_c", "batch"]
    path = write_profile(tmp_path, {"session.tare_s": 0.5})
    path.write_text(f"{path.read_text()}\n[metadata]\nrequired = {json.dumps(required)}\n")
    profile = load_profile(path)
    excitation = hold(rate_hz=1000.0, duration_s=1.0, rest_s=0.2, ring_down_s=0.0)
    given = {"operator": "Ada", "meta_batch": "7"}
    with pytest.raises(RefusedError) as refusal:
        Series(profile, excitation, tmp_path, notes=given)
    assert str(refusal.value) == (
        f"{path}: metadata.required asks each session for temperature_c; add "
        "--meta temperature_c=… (°C)."
    )
    with pytest.raises(
        RefusedError, match=r"--operator … --meta temperature_c=… \(°C\) --meta batch=…\."
    ):
        Series(profile, excitation, tmp_path)
    Series(profile, excitation, tmp_path, notes=given | {"meta_temperature_c": "21.4"})


def test_search_for_touches_with_a_mass_at_the_tip_is_refused(tmp_path):
    path = write_profile(tmp_path, {"beam.tip_mass_kg": 1e-4})
    profile = load_profile(path)
    excitation = touch(rate_hz=1000.0, angle_rad=0.4, rig=RigPreview(profile))
    with pytest.raises(RefusedError) as refusal:
        Series(profile, excitation, tmp_path / "out")
    assert str(refusal.value) == (
        f"{path}: beam.tip_mass_kg = 0.0001 kg: a search for touches does not take a mass at the "
        "tip into account; take it off, and remove the key."
    )
