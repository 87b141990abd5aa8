"""Records of random defects: their distribution, and signals that obey the equations of motion."""

import json
from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from defect_records import (
    DRAG_COEFFICIENT,
    RATE_HZ,
    DampingLaw,
    Defect,
    DefectRecord,
    NoiseSpectrum,
    TorqueChannel,
    simulate,
)
from independent_records import LENGTH_M, Truth, characteristic, exact
from numpy.typing import NDArray
from random_defects import (
    AMPLITUDES_RAD,
    CONTROL,
    DAMPING_LEVELS,
    KINDS,
    LINEAR,
    OTHER,
    draw_defect,
    heavier_half,
    make_beam,
    tilted_axis,
)

Real = NDArray[np.float64]

SENSOR_NM = 1.25e-4
LAW = DampingLaw(7.1e-5, 1.0, 0.012, 1.0)
RIG = Defect("none", {}, True, LAW, make_beam(LAW))
SILENT = NoiseSpectrum(white_nm=0.0)
_EVERY = 2


SECONDS = 8.4
"""The first mode resonates 7 s after the beginning."""


def record(defect: Defect = RIG, seconds: float = SECONDS) -> DefectRecord:
    return simulate(1, defect, 0.025, 1.0, SILENT, seconds)


@pytest.fixture(scope="module")
def plain() -> DefectRecord:
    return record()


def test_all_kinds_are_drawn_with_all_settings():
    drawn = [draw_defect(seed) for seed in range(150)]
    kinds = Counter(defect.kind for defect, *_ in drawn)
    assert set(kinds) == set(KINDS)
    assert len(LINEAR) + len(OTHER) >= 12
    assert {amplitude for _, amplitude, _, _ in drawn} == set(AMPLITUDES_RAD)
    assert {level for *_, level, _ in drawn} == set(DAMPING_LEVELS)
    coloured = sum(bool(noise.corner_hz or noise.bumps) for *_, noise in drawn)
    assert 0.35 < coloured / len(drawn) < 0.65
    for defect, *_ in drawn:
        assert defect.linear_constant == (defect.kind in CONTROL | LINEAR)


def test_seed_determines_the_rig():
    (one, *rest), (again, *rest_again) = draw_defect(7), draw_defect(7)
    assert (one.kind, one.size, one.damping, rest) == (
        again.kind, again.size, again.damping, rest_again,
    )  # fmt: skip
    assert draw_defect(8)[0].size != one.size
    assert draw_defect(7, "tilt")[0].kind == "tilt"


@pytest.mark.parametrize("seconds", [SECONDS, pytest.param(136.0, marks=pytest.mark.further)])
def test_record_of_a_uniform_beam_matches_the_closed_form(seconds: float):
    channel = TorqueChannel(delay_s=3e-4, tool_inertia_kg_m2=1e-5)
    found = record(replace(RIG, channel=channel), seconds)
    truth = Truth(7.1e-5, 1.0, 0.012, 1.0, delay_s=3e-4, tool_inertia_kg_m2=1e-5)
    expected, count = exact(truth), round(seconds * RATE_HZ)
    assert found.torque_nm.size == count
    assert np.abs(found.torque_nm - expected.torque_nm[:count]).max() <= SENSOR_NM
    assert np.abs(found.angle_rad - expected.angle_rad[:count]).max() <= 7e-5
    assert np.array_equal(found.reference_rad, expected.reference_rad[:count])
    visible = [mode.mode for mode in found.modes if mode.visible]
    assert visible == ([1, 2, 3] if seconds > 120 else visible)


def test_modes_match_the_closed_form_with_delay(plain: DefectRecord):
    delayed = record(replace(RIG, channel=TorqueChannel(delay_s=3e-4, tool_inertia_kg_m2=1e-5)))
    truth = Truth(7.1e-5, 1.0, 0.012, 1.0)
    assert [mode.mode for mode in plain.modes] == [1, 2, 3, 4]
    for mode, turned in zip(plain.modes, delayed.modes, strict=True):
        assert mode.frequency_hz == pytest.approx(truth.frequency_hz(mode.mode), rel=1e-6)
        assert mode.damping_ratio == pytest.approx(truth.damping_ratio(mode.mode), rel=1e-4)
        # A delay turns the residue; the tool inertia has no effect on modes.
        turn = np.exp(-3e-4 * truth.pole(mode.mode))
        assert turned.residue == pytest.approx(mode.residue * turn, rel=1e-5)


@cache
def marched(step_at_s: float = np.inf, stiffness: float = 1.0, drag_m: float = 0.0) -> Real:
    """Return the torque of the first modes by the method of Runge and Kutta, from rest."""
    beam = RIG.beam
    frequencies, participations = (each[:3] for each in beam.participations())
    position = (np.arange(30) + 0.5) / 30 * 0.98
    width, shapes = 0.98 / 30, beam.shapes_at(position)[:3]
    damping = LAW.gamma * 0.090275 / 4.7e-3
    per_speed = 0.5 * 1.2 * DRAG_COEFFICIENT * drag_m
    step = _EVERY / RATE_HZ
    count = round(SECONDS / step)
    # The hub's motion on half steps, by the motor loop's own equation.
    t = np.arange(2 * count + 2) * step / 2 - 1.0
    slope = (50 - 0.05) / 240
    reference = np.where(t >= 0, 0.025 * np.sin(2 * np.pi * (0.05 + slope * t) * t), 0.0)
    hub = np.zeros((t.size, 3))
    loop = 2 * np.pi * 20
    for i, (low, high) in enumerate(pairwise(reference)):
        angle, speed, _ = hub[i]
        middle = 0.5 * (low + high)

        def rate(a: float, v: float, r: float) -> float:
            return loop**2 * (r - a) - 1.4 * loop * v

        h = step / 2
        k1 = rate(angle, speed, low)
        k2 = rate(angle + h / 2 * speed, speed + h / 2 * k1, middle)
        k3 = rate(angle + h / 2 * speed + h * h / 4 * k1, speed + h / 2 * k2, middle)
        k4 = rate(angle + h * speed + h * h / 2 * k2, speed + h * k3, high)
        angle, speed = (
            angle + h * speed + h * h / 6 * (k1 + k2 + k3),
            speed + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4),
        )
        hub[i + 1] = angle, speed, rate(angle, speed, high)

    def rates(j: int, q: Real, v: Real, stiffer: float) -> tuple[Real, Real]:
        speed = v @ shapes + position * hub[j, 1]
        drag = per_speed * np.abs(speed) * speed
        elastic = stiffer * frequencies**2 * (q + LAW.zeta * v)
        drive = participations * (hub[j, 2] + damping * hub[j, 1])
        return -drive - damping * v - elastic - shapes @ drag * width, drag

    torque, q, v = np.zeros(count), np.zeros(3), np.zeros(3)
    rest = 4.7e-3 * 0.98**3 / 3
    for i in range(count):
        j, stiffer = 2 * i, stiffness if i * step > step_at_s - 1e-9 else 1.0
        a1, drag = rates(j, q, v, stiffer)
        torque[i] = (
            rest * (hub[j, 2] + damping * hub[j, 1])
            + participations @ (a1 + damping * v)
            + drag @ position * width
        )
        a2, _ = rates(j + 1, q + step / 2 * v, v + step / 2 * a1, stiffer)
        a3, _ = rates(j + 1, q + step / 2 * v + step**2 / 4 * a1, v + step / 2 * a2, stiffer)
        a4, _ = rates(j + 2, q + step * v + step**2 / 2 * a2, v + step * a3, stiffer)
        q = q + step * v + step**2 / 6 * (a1 + a2 + a3)
        v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return torque


def test_a_step_of_stiffness_conserves_the_state(plain: DefectRecord):
    at_s, change = 6.5, 0.01
    found = record(replace(RIG, step=(at_s, change)))
    before = round(at_s * RATE_HZ)
    assert np.array_equal(found.torque_nm[:before], plain.torque_nm[:before])
    expected = marched(at_s, 1 + change) - marched()
    difference = (found.torque_nm - plain.torque_nm)[::_EVERY]
    assert np.abs(expected).max() > 25 * SENSOR_NM
    assert np.abs(difference - expected).max() < 1.1 * SENSOR_NM + 0.01 * np.abs(expected).max()
    for mode in found.modes:
        assert mode.later_frequency_hz == pytest.approx(
            mode.frequency_hz * (1 + change) ** 0.5, rel=1e-4
        )


def test_drag_matches_the_equations_of_motion(plain: DefectRecord):
    found = record(replace(RIG, drag_m=1e-3))
    expected = marched(drag_m=1e-3) - marched()
    difference = (found.torque_nm - plain.torque_nm)[::_EVERY]
    assert np.abs(expected).max() > 50 * SENSOR_NM
    assert np.abs(difference - expected).max() < 1.1 * SENSOR_NM + 0.01 * np.abs(expected).max()
    assert all(mode.damping_ratio is None for mode in found.modes)
    assert found.defect.ranges()["drag_m"] == (1.2e-3, 1.2e-3)


def test_coloured_noise_has_its_spectrum():
    noise = NoiseSpectrum(5e-3, corner_hz=10.0, bumps=((30.0, 0.1, 8.0),))
    drawn = noise.drawn(400_000, np.random.default_rng(1))
    density = np.abs(np.fft.rfft(drawn)) ** 2 / drawn.size / 5e-3**2
    frequency_hz = np.fft.rfftfreq(drawn.size, 1 / RATE_HZ)

    def mean(low: float, high: float) -> float:
        return float(density[(frequency_hz >= low) & (frequency_hz < high)].mean())

    assert mean(200, 500) == pytest.approx(1.0, rel=0.05)
    assert mean(0.95, 1.05) == pytest.approx(11, rel=0.4)
    assert mean(29.8, 30.2) == pytest.approx(1 + 10 / 30 + 8, rel=0.3)


def test_truths_are_ranges_where_a_property_varies():
    uneven, *_ = draw_defect(3, "stiffness, sections")
    ranges = uneven.ranges()
    assert ranges["bending_stiffness_n_m2"][0] < ranges["bending_stiffness_n_m2"][1]
    assert {"alpha", "zeta", "lambda"} <= set(uneven.parameters)
    assert "bending_stiffness_n_m2" not in uneven.parameters
    control, *_ = draw_defect(3, "none")
    assert control.parameters["bending_stiffness_n_m2"] == 0.090275
    relaxing, *_ = draw_defect(3, "relaxations")
    assert "zeta" not in relaxing.ranges()
    assert relaxing.ranges()["alpha"][0] <= relaxing.ranges()["alpha"][1] <= 1.0


def shape(number: int, xi: Real) -> Real:
    """Clamped-free eigenfunction."""
    z = characteristic(number)
    ratio = (np.cos(z) + np.cosh(z)) / (np.sin(z) + np.sinh(z))
    return np.cosh(z * xi) - np.cos(z * xi) - ratio * (np.sinh(z * xi) - np.sin(z * xi))


@pytest.mark.parametrize("number", [1, 2, 3])
def test_small_defects_shift_frequencies_by_rayleigh(number: int):
    xi = np.linspace(0, 1, 20_001)
    y = shape(number, xi)
    plain = RIG.beam.undamped()[0][number - 1] ** 2
    fraction = np.trapezoid(np.where(xi > 0.5, y**2, 0.0), xi) / np.trapezoid(y**2, xi)
    heavier = heavier_half().beam.undamped()[0][number - 1] ** 2
    assert heavier / plain == pytest.approx(1 / (1 + 0.03 * fraction), abs=3e-4)
    slope = np.gradient(y, xi)
    tension = 9.81 * np.sin(np.radians(2)) / LENGTH_M * (1 - xi)
    stiffer = np.trapezoid(tension * slope**2, xi) / np.trapezoid(y**2, xi)
    hanging = tilted_axis().beam.undamped()[0][number - 1] ** 2
    assert hanging - plain == pytest.approx(stiffer, rel=0.01)


def test_a_truth_is_a_json_document(plain: DefectRecord):
    truth = json.loads(json.dumps(plain.truth(), allow_nan=False))
    assert truth["kind"] == "none"
    assert truth["ranges"]["alpha"] == [1.0, 1.0]
    assert truth["modes"][0]["residue"][1] > 0
