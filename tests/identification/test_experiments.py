"""The references: their demands on the rig, and their passes as in the layout."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from rigd.control import close_loop
from rigd.excitation import ExcitationError
from rigd.identification import _records, read_recording
from rigd.identification.estimate import MotorEstimateError, estimate_motor
from rigd.identification.experiments import (
    SpeedPass,
    constant_speeds_excitation,
    multisine_excitation,
    passes_of_schedule,
    read_schedule,
    trial_excitation,
)
from rigd.runner.planning import plan_session
from rigd.testing import Signals, write_session

SESSIONS = (trial_excitation, multisine_excitation, constant_speeds_excitation)


def as_text(excitation):
    return {"excitation": excitation.kind} | {
        name: value if isinstance(value, str) else repr(value)
        for name, value in excitation.parameters.items()
    }


def passes_of(excitation):
    return passes_of_schedule(read_schedule(as_text(excitation)), excitation.rate_hz)


@pytest.mark.parametrize("make", SESSIONS)
@pytest.mark.parametrize(("percent", "stroke"), [(40.0, 0.8), (32.0, 0.8), (60.0, 0.3)])
def test_predicted_peaks_stay_within_the_options(profile, make, percent, stroke):
    excitation = make(profile, torque_percent=percent, stroke_rad=stroke)
    predicted = plan_session(profile, excitation).prediction
    assert predicted.peak_torque_nm <= percent / 100 * profile.rig.motor.rated_torque_nm
    assert 0.7 * stroke < predicted.peak_angle_rad <= stroke or predicted.peak_velocity_rad_s > 0.9


@pytest.mark.parametrize("make", SESSIONS)
def test_speed_has_one_sign_in_every_pass(profile, make):
    excitation = make(profile, torque_percent=40.0, stroke_rad=0.8)
    speed = close_loop(profile.loop_model()).simulate(excitation.reference_rad).velocity_rad_s
    passes = passes_of(excitation)
    for run in passes:
        along = speed[run.first_tick : run.end_tick] * np.sign(run.speed_rad_s)
        assert along.min() > 0.35 * abs(run.speed_rad_s)
        assert along.mean() == pytest.approx(abs(run.speed_rad_s), rel=0.05)
    assert {np.sign(run.speed_rad_s) for run in passes} == {1.0, -1.0}
    assert passes[-1].end_tick < excitation.reference_rad.size


def test_multisine_excites_its_band_uniformly(profile):
    excitation = multisine_excitation(profile, torque_percent=60.0, stroke_rad=0.8)
    speed = close_loop(profile.loop_model()).simulate(excitation.reference_rad).velocity_rad_s
    run = passes_of(excitation)[4]
    spectrum = np.abs(np.fft.rfft(speed[run.first_tick : run.end_tick]))
    lines = spectrum[3:38]  # 2.5 to 31 Hz
    assert lines.max() < 1.5 * lines.min()
    assert spectrum[45:].max() < 0.1 * lines.min()


@pytest.mark.parametrize("make", SESSIONS)
def test_cycles_are_equal_except_for_a_small_offset(profile, make):
    excitation = make(profile, torque_percent=40.0, stroke_rad=0.8)
    by_speed: dict[float, list[SpeedPass]] = {}
    for run in passes_of(excitation):
        by_speed.setdefault(run.speed_rad_s, []).append(run)
    for runs in by_speed.values():
        passes = np.array([excitation.reference_rad[run.first_tick : run.end_tick] for run in runs])
        offsets = passes[:, 0] - passes[0, 0]
        assert np.ptp(passes - offsets[:, None], axis=0).max() < 1e-12
        steps = offsets / profile.rig.encoder.resolution_rad
        assert np.abs(steps).max() < 45
        assert len(set(np.round(steps % 1.0, 2))) > len(runs) // 2


def test_a_smaller_stroke_is_swept_more_slowly(profile):
    wide, narrow = (
        multisine_excitation(profile, torque_percent=40.0, stroke_rad=stroke)
        for stroke in (0.8, 0.2)
    )
    assert np.abs(narrow.reference_rad).max() < 0.2
    assert passes_of(narrow)[0].speed_rad_s < 0.4 * passes_of(wide)[0].speed_rad_s


def test_half_of_the_speed_limit_remains(profile):
    slow = replace(profile, limits=replace(profile.limits, velocity_rad_s=0.6))
    excitation = multisine_excitation(slow, torque_percent=40.0, stroke_rad=0.8)
    assert passes_of(excitation)[0].speed_rad_s == pytest.approx(0.3)
    plan_session(slow, excitation)


@pytest.mark.parametrize("make", SESSIONS)
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"torque_percent": 0.0}, "--torque-percent 0"),
        ({"torque_percent": 101.0}, "at most 100 %"),
        ({"torque_percent": float("nan")}, "--torque-percent nan"),
        ({"torque_percent": 5.0}, "allow at least"),
        ({"stroke_rad": 0.0}, "--stroke-rad 0"),
        ({"stroke_rad": 1.6}, "limits.angle_rad"),
        ({"stroke_rad": float("nan")}, "--stroke-rad nan"),
    ],
)
def test_bad_options_are_refused(profile, make, options, words):
    with pytest.raises(ExcitationError, match=words):
        make(profile, **({"torque_percent": 40.0, "stroke_rad": 0.8} | options))


@pytest.mark.parametrize("change", [{"excitation": "chirp"}, {"cycles": "many"}, {"turn_s": None}])
def test_other_metadata_hold_no_layout(profile, change):
    metadata = as_text(multisine_excitation(profile, torque_percent=40.0, stroke_rad=0.8))
    assert read_schedule(metadata) is not None
    changed = {k: v for k, v in (metadata | change).items() if v is not None}
    assert read_schedule(changed) is None


@pytest.mark.parametrize(
    ("make", "end", "words"),
    [
        (constant_speeds_excitation, 5000, "Constant speeds alone .* motor-multisine"),
        (multisine_excitation, 100, "Too few passes: 0 of 0"),  # stopped before the first
    ],
)
def test_insufficient_sessions_are_reported(profile, tmp_path, make, end, words):
    excitation = make(profile, torque_percent=40.0, stroke_rad=0.8)
    reference = excitation.reference_rad
    signals = Signals(
        reference, reference, np.zeros(reference.size), excitation.segments, excitation.rate_hz,
        as_text(excitation),
    )  # fmt: skip
    path = write_session(tmp_path / "a.mcap", signals.part(slice(end)))
    with pytest.raises(MotorEstimateError, match=words):
        recording = read_recording([path], 0.0)
        estimate_motor(recording.windows, recording.timing)


@pytest.mark.process
def test_a_session_counts_once(short_chirps, tmp_path, monkeypatch):
    monkeypatch.setattr(_records, "_read_passes", lambda *_: ([], 0))
    copied = tmp_path / "copied.mcap"
    shutil.copy(short_chirps[0], copied)
    named = rf"copied\.mcap: it has samples of .*{short_chirps[0].name}"
    with pytest.raises(MotorEstimateError, match=named):
        read_recording([short_chirps[0], short_chirps[1], copied], 0.0)
