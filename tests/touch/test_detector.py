"""Innovations of the free beam, and the test for a touch, on records of the exact model."""

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
REST = 1000
NOISE = ChannelNoise(torque_nm=5e-3, shear_n=0.02, angle_rad=7e-5 / 12**0.5)
SHIFT_PER_S = 1.5
"""Of the line along which the transform is taken back: what it wraps round has died away by
exp(-16 · 1.5), or could not be told from noise."""


def respond(transfers, inputs, ticks):
    """Sum of responses to sampled inputs (n,), by the Laplace transform along a shifted line."""
    n = 16 * 1024
    damped = np.exp(-SHIFT_PER_S * np.arange(n) / RATE_HZ)
    s = SHIFT_PER_S + 2j * pi * np.fft.rfftfreq(n, 1 / RATE_HZ)
    total = np.zeros(s.size, dtype=complex)
    for response, signal in zip(transfers(s), inputs, strict=True):
        padded = np.zeros(n)
        padded[: signal.size] = signal
        total += response * np.fft.rfft(padded * damped)
    return (np.fft.irfft(total, n) / damped)[:ticks]


def slewed(speed_rad_s, ticks=3000):
    """Angle that starts after the rest within 0.1 s, smoothly."""
    u = np.clip(np.arange(ticks) / 100 - REST / 100, 0, 1)
    return np.cumsum(speed_rad_s * u**3 * (10 - 15 * u + 6 * u**2)) / RATE_HZ


def record(angle_rad, beam=BEAM, *, force_n=None, at_m=0.6, seed=0, noise=NOISE):
    """Quantised angle, and torque and shear with noise."""
    ticks = angle_rad.size
    force = np.zeros(ticks) if force_n is None else force_n

    def torque(s):
        grid = PointForceGrid(s, beam, DAMPING)
        return grid.torque_per_angle(), grid.torque_per_force(at_m)

    def shear(s):
        grid = PointForceGrid(s, beam, DAMPING)
        return grid.shear_per_angle(), grid.shear_per_force(at_m)

    random = np.random.default_rng(seed).standard_normal((2, ticks))
    # Beyond what the angle's end can reach: the transform would otherwise see it fall to zero.
    held = np.concatenate([angle_rad, np.full(4096, angle_rad[-1])])
    inputs = (held, force)
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
    told = []
    for angle, torque, shear in np.column_stack(readings).tolist():
        filter_.step(angle, torque, shear)
        told.append(filter_.whitened)
    return np.array(told)


def detector_of(model):
    beam = DetectorModel(model, contact_templates(BEAM, DAMPING, RATE_HZ, model))
    return TouchDetector(beam, RATE_HZ, DetectorSettings())


def detection(model, readings):
    detector = detector_of(model)
    for tick, (angle, torque, shear) in enumerate(np.column_stack(readings).tolist()):
        if tick == REST:
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
def test_the_filter_follows_the_exact_response(sensor_filter):
    fitted = _fit_filter(BEAM, DAMPING, RATE_HZ, 1e-5, 4e-4, sensor_filter)
    for frequency_hz in (0.5, 2.0, 8.0, 30.0, 50.0):
        s = 2j * pi * frequency_hz
        z = np.exp(s / RATE_HZ)
        told = fitted.c @ np.linalg.solve(z * np.eye(len(fitted.b)) - fitted.a, fitted.b) + fitted.d
        exact = (transfer(s, BEAM, DAMPING) + 1e-5 * s**2) * np.exp(-4e-4 * s)
        shear = PointForceGrid(s, BEAM, DAMPING).shear_per_angle() * np.exp(-4e-4 * s)
        seen = np.array([exact, shear]) * sensor_filter.response(s)
        assert told == pytest.approx(seen, rel=3e-3)


@pytest.mark.parametrize("speed_rad_s", [0.3, 2.0])
def test_innovations_of_a_free_beam_are_white(model, speed_rad_s):
    white = innovations(model, record(slewed(speed_rad_s)))
    assert np.cov(white.T) == pytest.approx(np.eye(2), abs=0.12)
    for channel in white.T:
        assert abs(np.corrcoef(channel[1:], channel[:-1])[0, 1]) < 0.1


@pytest.mark.parametrize("wrong", [0.99, 1.01])
@pytest.mark.parametrize("key", ["bending_stiffness_n_m2", further("density_kg_per_m")])
def test_a_model_that_is_one_per_cent_wrong_makes_no_touch(model, key, wrong):
    beam = replace(BEAM, **{key: wrong * getattr(BEAM, key)})
    tick, _ = detection(model, record(slewed(2.0), beam))
    assert tick is None


@pytest.mark.parametrize("at_m", [0.05, 0.3, 0.6, 0.95])
def test_a_touch_is_detected_within_ten_milliseconds(model, at_m):
    begin = 2000
    # A force of one newton that rises within 2 ms, against the motion.
    force = -np.clip((np.arange(3000) - begin) / 2, 0, 1)
    tick, detector = detection(model, record(slewed(1.0), force_n=force, at_m=at_m))
    assert begin < tick <= begin + 10
    assert detector.level > 1


def test_torque_alone_detects_as_well():
    model = observed_beam(BEAM, DAMPING, RATE_HZ, replace(NOISE, shear_n=None))
    assert model.channels == 1
    force = -np.clip((np.arange(3000) - 2000) / 2, 0, 1)
    angle, torque, _ = record(slewed(1.0), force_n=force)
    tick, _ = detection(model, (angle, torque, np.zeros(3000)))
    assert 2000 < tick <= 2015
    assert detection(model, (*record(slewed(1.0))[:2], np.zeros(3000)))[0] is None


def test_the_threshold_rises_with_the_noise_at_rest(model):
    noise = ChannelNoise(2 * NOISE.torque_nm, 2 * NOISE.shear_n)
    tick, detector = detection(model, record(slewed(1.0), noise=noise))
    assert tick is None
    assert detector.noise == pytest.approx((2.0, 2.0), rel=0.1)


def test_rate_of_false_alarms(model):
    # White noise straight into the comparisons.
    known = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    settings = DetectorSettings(false_alarms_per_hour=2e3)
    threshold = settings.threshold(RATE_HZ, len(known))
    white = np.random.default_rng(1).standard_normal((200_000, 2))
    ticks = known.shape[1] // 2
    windows = np.lib.stride_tricks.sliding_window_view(white.ravel(), 2 * ticks)[::2]
    above = np.concatenate(
        [np.abs(known @ part.T).max(axis=0) > threshold for part in np.array_split(windows, 40)]
    )
    expected = 2e3 * len(windows) / RATE_HZ / 3600
    assert 0.5 * expected < above.sum() < 1.3 * expected


def test_signatures_are_unit_vectors_of_the_last_ticks(model):
    known = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    assert known.shape[1] == 2 * 24
    assert np.linalg.norm(known, axis=1) == pytest.approx(1.0)
    ages = {24 - int(np.flatnonzero(np.any(row, axis=1))[0]) for row in known.reshape(-1, 24, 2)}
    assert min(ages) <= 3
    assert max(ages) == 24


def test_no_two_signatures_are_alike(model):
    known = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    alike = np.abs(known @ known.T) - np.eye(len(known))
    assert alike.max() < 0.9


def test_a_contact_makes_no_touch_after_its_end(model):
    """The zero of the sensor does not follow a force that lasts for seconds."""
    tick = np.arange(6000)
    force = -3.0 * np.clip((tick - 1500) / 2, 0, 1) * np.clip((3500 - tick) / 200, 0, 1)
    detector, touches = detector_of(model), []
    for now, readings in enumerate(np.column_stack(record(np.zeros(6000), force_n=force)).tolist()):
        if now in (REST, 4500):
            detector.arm()
        if detector.step(*readings):
            touches.append(now)
            detector.disarm()
    (touch,) = touches
    assert 1500 < touch <= 1510


@pytest.mark.parametrize("name", ["soft", "middle", "hard"])
def test_a_contact_looks_like_a_signature(name, struck):
    # Of records that another simulation has made; the innovations are large beside their noise.
    beam = observed_beam(LINK, DAMPED, RATE_HZ, NOISE)
    known = contact_templates(LINK, DAMPED, RATE_HZ, beam)
    record = struck[name]
    white = innovations(beam, (record.angle_rad, record.torque_nm, record.shear_n))
    last = int(record.touch_s * RATE_HZ) + 15
    window = white[last - known.shape[1] // 2 + 1 : last + 1].ravel()
    # Noise alone has a norm of 5 there, and 2 to 3 in the largest comparison.
    size = np.linalg.norm(window)
    assert size > 15
    assert np.abs(known @ window).max() > 0.85 * size


@pytest.mark.parametrize("key", ["bending_stiffness_n_m2", further("density_kg_per_m")])
def test_modes_that_are_elsewhere_make_no_touch_in_a_chirp(model, key):
    t = np.arange(8000) / RATE_HZ
    swept = np.clip((t - 1.0) / 7.0, 0, 1) * 7.0
    angle = 0.02 * np.sin(2 * pi * (2.0 * swept + 1.5 * swept**2)) * np.clip(swept, 0, 1)
    beam = replace(BEAM, **{key: 0.99 * getattr(BEAM, key)})
    readings = record(angle, beam)
    detector = detector_of(model)
    level = []
    for tick, now in enumerate(np.column_stack(readings).tolist()):
        if tick == REST:
            detector.arm()
        assert not detector.step(*now)
        level.append(detector.level)
    # It would be one, were the innovations taken to be as small as at rest.
    white = innovations(model, readings) / detector.noise
    known = contact_templates(BEAM, DAMPING, RATE_HZ, model)
    ticks = known.shape[1] // 2
    windows = np.lib.stride_tricks.sliding_window_view(white[REST:].ravel(), 2 * ticks)[::2]
    threshold = DetectorSettings().threshold(RATE_HZ, len(known))
    assert np.abs(windows @ known.T).max() > 1.2 * threshold
    assert max(level) < 0.9


def test_missed_ticks_and_old_readings_are_passed_over(model):
    readings = np.column_stack(record(slewed(1.0)))
    detector = detector_of(model)
    missed = 0
    before = readings[0]
    for tick, now in enumerate(readings):
        if tick == REST:
            detector.arm()
        if 1500 <= tick < 1530 or tick in (1700, 1800):
            missed += 1
            continue
        stale_wrench, stale_angle = tick % 97 == 0, tick % 89 == 0
        angle = before[0] if stale_angle else now[0]
        torque, shear = before[1:] if stale_wrench else now[1:]
        touched = detector.step(
            angle, torque, shear, missed=missed, angle_stale=stale_angle, wrench_stale=stale_wrench
        )
        assert not touched
        missed, before = 0, now
