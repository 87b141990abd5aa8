"""Innovations of the free beam and detection of touches, in records of the exact model."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from cases import further
from touch_records import DAMPED, LINK

from rigd.beam import Beam, Damping, PointForceGrid, transfer
from rigd.touch import (
    ChannelNoise,
    DetectorModel,
    DetectorSettings,
    InnovationFilter,
    SensorFilter,
    TouchDetector,
    contact_templates,
    observed_beam,
)
from rigd.touch._innovations import _fit_filter

BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
DAMPING = Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)
RATE_HZ = 1000.0
REST_TICKS = 1000
NOISE = ChannelNoise(torque_nm=5e-3, shear_n=0.02, angle_rad=7e-5 / 12**0.5)
SHIFT_PER_S = 1.5
"""Real part of the line of the inverse transform; it reduces values that wrap round by the factor
exp(-16 · 1.5)."""


def respond(transfers, inputs, ticks):
    """Return the summed responses (ticks,) to sampled inputs, by a shifted Laplace transform."""
    n = 16 * 1024
    decay = np.exp(-SHIFT_PER_S * np.arange(n) / RATE_HZ)
    s = SHIFT_PER_S + 2j * pi * np.fft.rfftfreq(n, 1 / RATE_HZ)
    total = np.zeros(s.size, dtype=complex)
    for response, signal in zip(transfers(s), inputs, strict=True):
        padded = np.zeros(n)
        padded[: signal.size] = signal
        total += response * np.fft.rfft(padded * decay)
    return (np.fft.irfft(total, n) / decay)[:ticks]


def slew_angle(speed_rad_s, ticks=3000):
    """Return the angle of a motor that accelerates smoothly within 0.1 s after the rest."""
    u = np.clip(np.arange(ticks) / 100 - REST_TICKS / 100, 0, 1)
    return np.cumsum(speed_rad_s * u**3 * (10 - 15 * u + 6 * u**2)) / RATE_HZ


def record(angle_rad, beam=BEAM, *, force_n=None, at_m=0.6, seed=0, noise=NOISE):
    """Return the quantised angle, and torque and shear with noise."""
    ticks = angle_rad.size
    force = np.zeros(ticks) if force_n is None else force_n

    def torque(s):
        grid = PointForceGrid(s, beam, DAMPING)
        return grid.torque_per_angle(), grid.torque_per_force(at_m)

    def shear(s):
        grid = PointForceGrid(s, beam, DAMPING)
        return grid.shear_per_angle(), grid.shear_per_force(at_m)

    random = np.random.default_rng(seed).standard_normal((2, ticks))
    # Without this extension, the transform would include a jump of the angle to zero.
    extended_angle = np.concatenate([angle_rad, np.full(4096, angle_rad[-1])])
    inputs = (extended_angle, force)
    return (
        np.round(angle_rad / 7e-5) * 7e-5,
        respond(torque, inputs, ticks) + noise.torque_nm * random[0],
        respond(shear, inputs, ticks) + noise.shear_n * random[1],
    )


@pytest.fixture(scope="module")
def model():
    return observed_beam(BEAM, DAMPING, RATE_HZ, NOISE)


def innovations(model, readings):
    filter_ = InnovationFilter(model)
    whitened = []
    for angle, torque, shear in np.column_stack(readings).tolist():
        filter_.step(angle, torque, shear)
        whitened.append(filter_.whitened)
    return np.array(whitened)


def make_detector(model):
    beam = DetectorModel(model, contact_templates(BEAM, DAMPING, RATE_HZ, model))
    return TouchDetector(beam, RATE_HZ, DetectorSettings())


def detection(model, readings):
    detector = make_detector(model)
    for tick, (angle, torque, shear) in enumerate(np.column_stack(readings).tolist()):
        if tick == REST_TICKS:
            detector.arm()
        if detector.step(angle, torque, shear):
            return tick, detector
    return None, detector


@pytest.mark.parametrize(
    "sensor_filter",
    [
        SensorFilter(),
        SensorFilter(corner_hz=120.0, order=2),
        SensorFilter(weights=(1 / 7,) * 7, spacing_s=1 / 7000),
    ],
)
def test_filter_matches_exact_response(sensor_filter):
    fitted = _fit_filter(BEAM, DAMPING, RATE_HZ, 1e-5, 4e-4, sensor_filter)
    for frequency_hz in (0.5, 2.0, 8.0, 30.0, 50.0):
        s = 2j * pi * frequency_hz
        z = np.exp(s / RATE_HZ)
        response = (
            fitted.c @ np.linalg.solve(z * np.eye(len(fitted.b)) - fitted.a, fitted.b) + fitted.d
        )
        exact = (transfer(s, BEAM, DAMPING) + 1e-5 * s**2) * np.exp(-4e-4 * s)
        shear = PointForceGrid(s, BEAM, DAMPING).shear_per_angle() * np.exp(-4e-4 * s)
        expected = np.array([exact, shear]) * sensor_filter.response(s)
        assert response == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize("speed_rad_s", [0.3, 2.0])
def test_innovations_of_a_free_beam_are_white(model, speed_rad_s):
    whitened = innovations(model, record(slew_angle(speed_rad_s)))
    assert np.cov(whitened.T) == pytest.approx(np.eye(2), abs=0.12)
    for channel in whitened.T:
        assert abs(np.corrcoef(channel[1:], channel[:-1])[0, 1]) < 0.1


@pytest.mark.parametrize("factor", [0.99, 1.01])
@pytest.mark.parametrize("key", ["bending_stiffness_n_m2", further("density_kg_per_m")])
def test_no_detection_with_one_percent_model_error(model, key, factor):
    beam = replace(BEAM, **{key: factor * getattr(BEAM, key)})
    tick, _ = detection(model, record(slew_angle(2.0), beam))
    assert tick is None


@pytest.mark.parametrize("at_m", [0.05, 0.3, 0.6, 0.95])
def test_a_touch_is_detected_within_ten_milliseconds(model, at_m):
    begin = 2000
    # A force of one newton that rises within 2 ms, against the motion.
    force = -np.clip((np.arange(3000) - begin) / 2, 0, 1)
    tick, detector = detection(model, record(slew_angle(1.0), force_n=force, at_m=at_m))
    assert begin < tick <= begin + 10
    assert detector.level > 1


def test_detection_with_torque_alone():
    model = observed_beam(BEAM, DAMPING, RATE_HZ, replace(NOISE, shear_n=None))
    assert model.channel_count == 1
    force = -np.clip((np.arange(3000) - 2000) / 2, 0, 1)
    angle, torque, _ = record(slew_angle(1.0), force_n=force)
    tick, _ = detection(model, (angle, torque, np.zeros(3000)))
    assert 2000 < tick <= 2015
    assert detection(model, (*record(slew_angle(1.0))[:2], np.zeros(3000)))[0] is None


def test_the_threshold_rises_with_the_noise_at_rest(model):
    noise = ChannelNoise(2 * NOISE.torque_nm, 2 * NOISE.shear_n)
    tick, detector = detection(model, record(slew_angle(1.0), noise=noise))
    assert tick is None
    assert detector.noise == pytest.approx((2.0, 2.0), rel=0.1)


def test_rate_of_false_alarms(model):
    # White noise is correlated with the templates directly.
    templates = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    settings = DetectorSettings(false_alarms_per_hour=2e3)
    threshold = settings.threshold(RATE_HZ, len(templates))
    white_noise = np.random.default_rng(1).standard_normal((200_000, 2))
    ticks = templates.shape[1] // 2
    windows = np.lib.stride_tricks.sliding_window_view(white_noise.ravel(), 2 * ticks)[::2]
    exceeds = np.concatenate(
        [
            np.abs(templates @ chunk.T).max(axis=0) > threshold
            for chunk in np.array_split(windows, 40)
        ]
    )
    expected = 2e3 * len(windows) / RATE_HZ / 3600
    assert 0.5 * expected < exceeds.sum() < 1.3 * expected


def test_templates_are_unit_vectors(model):
    templates = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    assert templates.shape[1] == 2 * 24
    assert np.linalg.norm(templates, axis=1) == pytest.approx(1.0)
    ages = {
        24 - int(np.flatnonzero(np.any(row, axis=1))[0]) for row in templates.reshape(-1, 24, 2)
    }
    assert min(ages) <= 3
    assert max(ages) == 24


def test_templates_are_dissimilar(model):
    templates = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    correlations = np.abs(templates @ templates.T) - np.eye(len(templates))
    assert correlations.max() < 0.9


def test_no_second_detection_after_contact_ends(model):
    """The zeros of the sensor do not follow a contact force of two seconds."""
    tick = np.arange(6000)
    force = -3.0 * np.clip((tick - 1500) / 2, 0, 1) * np.clip((3500 - tick) / 200, 0, 1)
    detector, touches = make_detector(model), []
    for index, readings in enumerate(
        np.column_stack(record(np.zeros(6000), force_n=force)).tolist()
    ):
        if index in (REST_TICKS, 4500):
            detector.arm()
        if detector.step(*readings):
            touches.append(index)
            detector.disarm()
    (touch,) = touches
    assert 1500 < touch <= 1510


@pytest.mark.parametrize("name", ["soft", "middle", "hard"])
def test_template_matches_simulated_contact(name, records_by_name):
    # The records are of another simulation; their innovations are much larger than noise.
    beam = observed_beam(LINK, DAMPED, RATE_HZ, NOISE)
    templates = contact_templates(LINK, DAMPED, RATE_HZ, beam)
    record = records_by_name[name]
    whitened = innovations(beam, (record.angle_rad, record.torque_nm, record.shear_n))
    last = int(record.touch_s * RATE_HZ) + 15
    window = whitened[last - templates.shape[1] // 2 + 1 : last + 1].ravel()
    # Noise alone has a norm of 5 there, and 2 to 3 in the largest comparison.
    size = np.linalg.norm(window)
    assert size > 15
    assert np.abs(templates @ window).max() > 0.85 * size


@pytest.mark.parametrize("key", ["bending_stiffness_n_m2", further("density_kg_per_m")])
def test_no_detection_in_chirp_with_mode_errors(model, key):
    t = np.arange(8000) / RATE_HZ
    sweep_s = np.clip((t - 1.0) / 7.0, 0, 1) * 7.0
    angle = 0.02 * np.sin(2 * pi * (2.0 * sweep_s + 1.5 * sweep_s**2)) * np.clip(sweep_s, 0, 1)
    beam = replace(BEAM, **{key: 0.99 * getattr(BEAM, key)})
    readings = record(angle, beam)
    detector = make_detector(model)
    level = []
    for tick, tick_readings in enumerate(np.column_stack(readings).tolist()):
        if tick == REST_TICKS:
            detector.arm()
        assert not detector.step(*tick_readings)
        level.append(detector.level)
    # With a constant threshold, the chirp would be a false alarm.
    whitened = innovations(model, readings) / detector.noise
    templates = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    ticks = templates.shape[1] // 2
    windows = np.lib.stride_tricks.sliding_window_view(whitened[REST_TICKS:].ravel(), 2 * ticks)[
        ::2
    ]
    threshold = DetectorSettings().threshold(RATE_HZ, len(templates))
    assert np.abs(windows @ templates.T).max() > 1.2 * threshold
    assert max(level) < 0.9


def test_no_detection_with_missed_ticks_and_stale_readings(model):
    readings = np.column_stack(record(slew_angle(1.0)))
    detector = make_detector(model)
    missed = 0
    last_readings = readings[0]
    for tick, tick_readings in enumerate(readings):
        if tick == REST_TICKS:
            detector.arm()
        if 1500 <= tick < 1530 or tick in (1700, 1800):
            missed += 1
            continue
        stale_wrench, stale_angle = tick % 97 == 0, tick % 89 == 0
        angle = last_readings[0] if stale_angle else tick_readings[0]
        torque, shear = last_readings[1:] if stale_wrench else tick_readings[1:]
        is_detected = detector.step(
            angle,
            torque,
            shear,
            missed_tick_count=missed,
            angle_stale=stale_angle,
            wrench_stale=stale_wrench,
        )
        assert not is_detected
        missed, last_readings = 0, tick_readings
