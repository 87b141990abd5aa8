"""Profiles that contradict the rig on the wire: refused by what the drive states, or by a move."""

import json

import pytest
from cases import further

from rigd.excitation import hold
from rigd.runner import ProbeFailedError, Rig, RigError, Series
from rigd.runtime import StopRequest
from rigd.session import read_session

pytestmark = pytest.mark.process

SILENT = ("0x608F", "0x6091")
"""Objects that state the scales of the encoder."""


class OperatorMessages:
    """Messages to the operator of a series, which may stop it at the first one."""

    def __init__(self, stop=None):
        self.texts = []
        self.stop = stop

    def on_start(self, number, path):
        pass

    def on_message(self, level, text):
        self.texts.append(f"{level}: {text}")
        if self.stop is not None:
            self.stop.request()

    def on_progress(self, progress, events):
        pass

    def on_result(self, result, *, look_follows):
        pass


@pytest.fixture
def rig_on_wire(write_profile, start_simulator, load, tmp_path):
    """Simulate one profile, and run a short session with another."""
    rigs = []

    def run(stated, *, states_scales=False, measured=(), stopped=False, **options):
        log = tmp_path / "drive.jsonl"
        path = write_profile("antenna_can", {"cia402.rated_torque_unit_nm": "0.0"})
        silent = () if states_scales else [
            option
            for index in SILENT
            for sub in (1, 2)
            for option in ("--fault", f"object,index={index},sub={sub}")
        ]  # fmt: skip
        start_simulator(path, "--lock-step", "--log", log, *silent)
        path = write_profile("antenna_can", {"cia402.rated_torque_unit_nm": "0.0"} | stated)
        for key in measured:
            name, text = key.rpartition(".")[2], path.read_text("utf-8")
            line = next(each for each in text.splitlines() if each.startswith(f"{name} = "))
            other = line.partition(", source")[0] + ', source = "measured" }'
            path.write_text(text.replace(line, other), encoding="utf-8")
        profile, stop = load(path), StopRequest()
        messages = OperatorMessages(stop if stopped else None)
        excitation = hold(rate_hz=1000.0, duration_s=0.1, rest_s=0.0, ring_down_s=0.0)
        series = Series(profile, excitation, tmp_path / "sessions", **options)
        rig = Rig(profile, uses_virtual_clock=True)
        rigs.append(rig)
        rig.connect()
        try:
            series.run(rig, stop, messages, with_live_view=False)
        finally:
            torques = [json.loads(line) for line in log.read_text("utf-8").splitlines()[:-1]]
            torques = [entry for entry in torques if entry["what"] == "torque"]
            assert not torques or not torques[-1]["enabled"]
        return series.results, messages.texts, rig, profile

    yield run
    for rig in rigs:
        rig.disconnect()


@pytest.mark.further
def test_a_wrong_scale_stated_by_the_drive_is_refused(rig_on_wire):
    with pytest.raises(RigError, match=r"608F and 6091.*resolution_rad is 2.8e-05"):
        rig_on_wire({"encoder.resolution_rad": "2.8e-5"}, states_scales=True)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        pytest.param({"encoder.resolution_rad": "1.75e-5"}, "encoder.resolution_rad", id="step"),
        further({"motor.inertia_kg_m2": "6.0e-3"}, "motor.inertia_kg_m2", id="inertia"),
        further({"sensor.projection": "[0, 0, 0, 0, 0, -1]"}, "sensor.projection", id="sensor"),
        further({"cia402.direction": "-1"}, "encoder|sensor.projection", id="direction"),
    ],
)
def test_an_unstated_wrong_scale_is_found_by_the_probing_move(rig_on_wire, stated, message):
    with pytest.raises(ProbeFailedError, match=message):
        rig_on_wire(stated)


@pytest.mark.further  # as tests/safety/test_probing_move.py on the plant
def test_a_rig_within_a_quarter_is_probed_once(rig_on_wire, tmp_path):
    results, texts, rig, profile = rig_on_wire({"motor.inertia_kg_m2": "2.3e-3"})
    assert [result.outcome for result in results] == ["complete"]
    assert [text.partition(",")[0] for text in texts[:1]] == ["info: Probing move"]
    assert "passed" in texts[1]
    metadata = read_session(results[0].path).metadata
    assert 0.8 < float(metadata["probe_inertia_ratio"]) < 0.95
    again = Series(
        profile,
        hold(rate_hz=1000.0, duration_s=0.1, rest_s=0.0, ring_down_s=0.0),
        tmp_path / "sessions",
    )
    messages = OperatorMessages()
    again.run(rig, StopRequest(), messages, with_live_view=False)
    assert messages.texts == []
    assert again.results[0].is_successful


@pytest.mark.further
def test_measured_values_are_not_probed(rig_on_wire):
    measured = ("motor.inertia_kg_m2", "motor.rated_torque_nm", "encoder.resolution_rad")
    results, texts, *_ = rig_on_wire({"motor.inertia_kg_m2": "2.3e-3"}, measured=measured)
    assert texts == []
    assert "probe_inertia_ratio" not in results[0].path.read_bytes().decode("latin-1")


@pytest.mark.further
def test_a_stop_ends_the_move(rig_on_wire):
    results, texts, rig, _ = rig_on_wire({"motor.inertia_kg_m2": "2.3e-3"}, stopped=True)
    assert results == []
    assert len(texts) == 1  # that it begins
    assert rig.connected


@pytest.mark.further
def test_the_motor_to_be_identified_may_differ(rig_on_wire):
    results, _, *_ = rig_on_wire({"motor.inertia_kg_m2": "6.0e-3"}, identifies_motor=True)
    assert results[0].is_successful
