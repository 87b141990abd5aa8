"""Sessions of a series, and what a terminal shows of them, without processes."""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import pytest
from shipped_profile import load_shipped

from rigd.engine.shared_state import Phase
from rigd.excitation import hold
from rigd.profile import load_profile
from rigd.runner import ProgressLine, Series, plan_lines, result_line
from rigd.runner.planning import RefusedError
from rigd.runner.request import NoRoomError
from rigd.runner.session import SessionResult
from rigd.runtime import StopRequest
from rigd.testing import write_profile

WELL = SessionResult(None, "complete", "", 1200, 1200, 0, 0, 0, fault=False)
UNSEEN = ("look_follows", False)


class Rig:
    """Runs nothing, and notes what it was to run."""

    def __init__(self, *results):
        self.results = list(results)
        self.orders = []

    def show(self, order, stop):
        return "Live view: there"

    def run(self, order, stop, listener, listens):
        self.orders.append(order)
        return self.results.pop(0)


class Watcher:
    def __init__(self):
        self.told = []

    def __getattr__(self, name):
        return lambda *what, **said: self.told.append((name, *what, *said.items()))


@pytest.fixture
def make_series(tmp_path):
    profile = load_shipped("sim")
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=1.0, rest_s=0.2, ring_down_s=0.0)

    def make(**options):
        return Series(profile, excitation, tmp_path / "out", **options)

    return make


@pytest.mark.process
def test_a_series_ends_with_the_first_session_that_does_not_go_well(make_series):
    series = make_series(repeat=4, notes={"operator": "Ada", "note": ""})
    bad = replace(WELL, outcome="fault")
    rig, listener = Rig(WELL, bad), Watcher()
    series.run(rig, StopRequest(), listener, live=True)
    assert series.results == [WELL, bad]
    assert [dict(order.notes) for order in rig.orders] == [
        {"operator": "Ada", "series": "1 of 4"},
        {"operator": "Ada", "series": "2 of 4"},
    ]
    first, second = (order.path for order in rig.orders)
    assert first.stem.endswith("-hold-01")
    assert listener.told == [
        ("on_start", 1, first), ("on_live_view", "Live view: there"), ("on_result", WELL, UNSEEN),
        ("on_start", 2, second), ("on_live_view", "Live view: there"), ("on_result", bad, UNSEEN),
    ]  # fmt: skip


@pytest.mark.process
def test_a_lone_session_is_not_numbered(make_series):
    rig = Rig(WELL)
    make_series().run(rig, StopRequest(), Watcher(), live=False)
    (order,) = rig.orders
    assert order.notes == ()
    assert dict(order.predicted_metadata)["limit_angle_rad"] == "1.57"
    assert float(dict(order.predicted_metadata)["predicted_peak_velocity_rad_s"]) >= 0.0
    assert float(dict(order.predicted_metadata)["predicted_peak_tip_slope_rad"]) >= 0.0
    assert order.path.stem.endswith("-hold")


@pytest.mark.process
def test_the_sessions_of_a_series_derive_their_seeds_from_the_stated_one(make_series):
    def seeds():
        rig = Rig(*[WELL] * 3)
        make_series(repeat=3).run(rig, StopRequest(), Watcher(), live=False)
        return [order.seed for order in rig.orders]

    assert seeds()[0] == 1
    assert len(set(seeds())) == 3
    assert seeds() == seeds()


def test_no_shipped_profile_states_a_seed():
    for name in ("sim", "antenna_can", "antenna_serial"):
        assert load_profile(name).rig.simulation.seed is None


@pytest.mark.process
def test_after_a_stop_no_session_begins(make_series):
    stop, listener = StopRequest(), Watcher()
    stop.request()
    make_series(repeat=2).run(Rig(), stop, listener, live=False)
    assert listener.told == []


@pytest.mark.process
def test_a_disk_that_fills_up_keeps_what_there_is(make_series, tmp_path):
    series = make_series(repeat=3)

    class Full(Rig):
        def run(self, *order):
            (tmp_path / "out").rmdir()
            (tmp_path / "out").touch()
            return super().run(*order)

    with pytest.raises(NoRoomError, match="cannot be created"):
        series.run(Full(WELL), StopRequest(), Watcher(), live=False)
    assert series.results == [WELL]


class Looks:
    """Quick looks that take three attempts each."""

    def __init__(self, told):
        self.told, self.left = told, 0

    @property
    def busy(self):
        return self.left > 0

    def begin(self, path):
        self.told.append(("look", path.stem[-2:]))
        self.left = 3

    def poll(self):
        self.left -= 1

    @contextlib.contextmanager
    def suspended(self):
        self.told.append("held")
        yield
        self.told.append("let go")


@pytest.mark.process
def test_a_quick_look_is_held_in_a_session_and_waited_for_between_two(make_series):
    listener = Watcher()

    class Watched(Rig):
        def watch(self):
            listener.told.append("watch")

        def run(self, *order):
            listener.told.append("run")
            return super().run(*order)

    stopped = replace(WELL, path=None)
    results = (replace(WELL, path=Path(f"a-0{number}.mcap")) for number in (1, 2))
    looks = Looks(listener.told)
    series = make_series(repeat=3)
    series.run(Watched(*results, stopped), StopRequest(), listener, live=False, quick_looks=looks)
    session = ["held", "run", "let go", "on_result"]
    pause = ["look", "watch", "watch", "watch"]
    told = [each if isinstance(each, str) else each[0] for each in listener.told]
    assert told == ["on_start", *session, *pause] * 2 + ["on_start", *session]
    ends = [each[-1] for each in listener.told if each[0] == "on_result"]
    assert ends == [("look_follows", True), ("look_follows", True), UNSEEN]


@pytest.mark.process
def test_a_stop_ends_the_wait_for_a_quick_look(make_series):
    listener, stop = Watcher(), StopRequest()

    class Stopped(Rig):
        def watch(self):
            listener.told.append("watch")
            stop.request()

    looks = Looks(listener.told)
    result = replace(WELL, path=Path("a-01.mcap"))
    make_series(repeat=3).run(Stopped(result), stop, listener, live=False, quick_looks=looks)
    told = [each if isinstance(each, str) else each[0] for each in listener.told]
    assert told == ["on_start", "held", "let go", "on_result", "look", "watch"]


@pytest.mark.process
def test_no_quick_look_at_a_move_is_begun_and_none_announced(tmp_path):
    profile, listener = load_shipped("sim"), Watcher()
    excitation = hold(rate_hz=profile.rig.rate_hz, duration_s=1.0, rest_s=0.2, ring_down_s=0.0)
    recorded, looks = replace(WELL, path=Path("a.mcap")), Looks(listener.told)
    series = Series(profile, replace(excitation, stays=True), tmp_path / "out")
    series.run(Rig(recorded), StopRequest(), listener, live=False, quick_looks=looks)
    assert listener.told[-2:] == ["let go", ("on_result", recorded, UNSEEN)]


def test_a_plan_is_told_with_its_limits_from_a_document_as_well(make_series):
    document = json.loads(json.dumps(make_series().plan_document()))
    first, peaks, *_ = plan_lines(document)
    assert first == "hold on sim, record of 1.2 s."
    assert " N·m (limit 0.9)." in peaks
    for name in ("excitation", "profile", "limits", "tip_in_words"):  # of before an update
        del document[name]
    first, peaks = plan_lines(document)
    assert first == "record of 1.2 s."
    assert "limit" not in peaks


@pytest.mark.parametrize(
    ("changes", "said"),
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
def test_a_result_is_told_in_a_line(changes, said):
    assert result_line(WELL.as_dict() | changes) == said


def test_what_was_said_last_is_written(capsys):
    for number in range(20):
        line = ProgressLine()
        line.write_message("[first]")
        line.write_message(f"last {number}")
        line.close()
        assert capsys.readouterr().err == f"[first]\nlast {number}\n"


def test_progress_alone_has_the_line_drawn_anew_some_times_a_second(monkeypatch):
    """However often it is told: drawing costs more than a supervisor's other work."""
    line, drawn, now_s = ProgressLine(), [], 0.0
    with monkeypatch.context() as patched:
        patched.setattr("rigd.runner._console.time.monotonic", lambda: now_s)
        patched.setattr(line._has_changed, "set", lambda: drawn.append(now_s))
        for tick in range(1000):
            now_s = tick / 1000
            line.update(Phase.RUNNING, tick, 1000, missed=0, late=0)
        assert 15 <= len(drawn) <= 21
        line.write_message("at once")
        assert drawn[-1] == now_s
    line.close()


def test_metadata_that_the_profile_requires_is_asked_for(tmp_path):
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
