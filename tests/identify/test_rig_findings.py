"""Rigs that are not as assumed are named as what they are; beams by the textbook's closed form."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import further

from analysis.identify import Measurement, select
from analysis.identify._candidates import CandidateSet
from analysis.identify._channel_checks import clipping, stops, wrong_scale
from analysis.identify._headline import MISREAD
from analysis.identify._leakage import repeats_after_s
from analysis.identify._problem import Comparison
from analysis.report._text import damping_sentences
from rigd.beam import Beam

RATE_HZ = 500.0
TICKS = 45_000
LINK = Beam(0.98, 4.7e-3, 0.090275)
ZETA, GAMMA = 7.1e-5, 1.2e-2


def response(s, tip_mass_kg=0.0, clamp_nm_per_rad=np.inf):
    """Torque per angle of a beam of type III, without cancellation only above 0.1 Hz."""
    external = LINK.density_over_stiffness * s**2 + GAMMA * s
    elastic = LINK.bending_stiffness_n_m2 * (1 + ZETA * s)
    k = (-LINK.bending_stiffness_n_m2 * external / elastic + 0j) ** 0.25
    z, tip = k * LINK.length_m, tip_mass_kg * s**2 / (elastic * k**3)
    sine, cosine, sinh, cosh = np.sin(z), np.cos(z), np.sinh(z), np.cosh(z)
    pinned = cosine * sinh - sine * cosh
    rigid = elastic * k * (pinned + 2 * tip * sinh * sine) / (1 + cosine * cosh - tip * pinned)
    return rigid / (1 + rigid / clamp_nm_per_rad)


@cache
def record(factor=1.0, filter_hz=np.inf, clock=0.0, **ends):
    """Chirp of 80 s to 50 Hz; the torque as its channel shows it, with 3 mN·m of noise."""
    t = np.arange(TICKS) / RATE_HZ - 1
    chirp = np.where((t >= 0) & (t < 80), np.sin(2 * np.pi * (0.05 * t + 49.95 * t**2 / 160)), 0.0)
    decay = np.exp(-5.0 * np.arange(TICKS) / TICKS)
    s = 5.0 * RATE_HZ / TICKS + 2j * np.pi * np.fft.rfftfreq(4 * TICKS, 1 / RATE_HZ)
    loop = 2 * np.pi * 20
    angle = np.fft.rfft(0.025 * chirp * decay, 4 * TICKS)
    angle = angle / (1 + 1.4 * s / loop + (s / loop) ** 2)
    torque = angle * response(s, **ends) / (1 + s / (2 * np.pi * filter_hz))
    angle_rad = np.fft.irfft(angle, 4 * TICKS)[:TICKS] / decay
    # At t (1 + clock): the first terms of Taylor's series, enough for 1e-5 and 50 Hz.
    torque_nm, size = np.zeros(TICKS), np.ones(TICKS)
    for power in range(5):
        torque_nm += size * np.fft.irfft(torque * s**power, 4 * TICKS)[:TICKS] / decay
        size = size * clock * np.arange(TICKS) / RATE_HZ / (power + 1)
    noise = np.random.default_rng(5).normal(scale=3e-3, size=TICKS)
    known = np.ones(TICKS, dtype=bool)
    return Measurement("x", angle_rad, factor * (torque_nm + noise), RATE_HZ, LINK, known, known)


def judged(measurement):
    verdict = select(measurement).verdict
    return {finding.kind: finding for finding in verdict.findings}, verdict


@pytest.mark.parametrize(
    ("more", "kind", "true"),
    [
        ({"clamp_nm_per_rad": 30.0}, "elastic clamp", 30.0),
        further({"filter_hz": 120.0}, "torque filter", 120.0),
        further({"clock": 1e-5}, "clock rate difference", 1e-5),
    ],
)
def test_a_rig_that_is_otherwise_is_named_with_its_size(more, kind, true):
    found, verdict = judged(record(**more))
    assert found.keys() == {kind}
    low, high = found[kind].interval
    assert low < true < high
    assert high - low < 0.4 * true
    assert verdict.structure == "III"
    assert verdict.adequate


def test_a_tip_mass_is_named_beside_what_explains_it_as_well():
    field = CandidateSet.of(record(tip_mass_kg=1.5e-4), (), (0.0, 50.0))
    assert field.best.extras == ("tip_mass_kg",)
    assert field.best.fit.parameters["tip_mass_kg"] == pytest.approx(1.5e-4, rel=0.02)
    assert all(mode.damping_ratio_std > 0 for mode in field.best.fit.modes)
    assert field.freest.extras == ("tip_mass_kg",)


def test_a_plain_rig_carries_nothing():
    field = CandidateSet.of(record(), (), (0.0, 50.0))
    assert all(not candidate.extras for candidate in field.candidates)
    assert not any(wrong_scale(field.comparison))


@pytest.mark.parametrize(
    ("factor", "kinds"),
    [
        (-1.0, ["sign"]),
        (180 / np.pi, ["unit"]),
        (-1e-3, ["sign", "unit"]),
        (1e4, ["unit"]),
        (3.5, []),
        (1.3, []),
        (0.8, []),
    ],
)
def test_a_sign_and_a_unit_are_seen_at_once(factor, kinds):
    comparison = Comparison.of(record(factor), (0.0, 50.0))
    assert [finding.kind for finding in wrong_scale(comparison)] == kinds


def test_a_wrong_sign_comes_first():
    found = select(record(-1.0), band_hz=(0.0, 20.0))
    verdict, told = found.verdict, found.headline
    assert [finding.kind for finding in verdict.findings] == ["sign"]
    assert verdict.sentences == (verdict.findings[0].sentence,)
    assert verdict.experiments == (verdict.findings[0].remedy,)
    assert not verdict.adequate
    quantities = [*told.parameters.values(), *(mode.frequency_hz for mode in told.modes)]
    assert {each.flag for each in quantities} == {MISREAD}
    assert damping_sentences(told) == ()


def test_a_clipped_torque_leaves_no_number_without_a_flag():
    """Even where so little is cut off that what remains is noise."""
    made = record()
    most = np.sort(np.abs(made.torque_nm))[-12]
    clipped = replace(made, torque_nm=np.clip(made.torque_nm, -most, most))
    found = select(clipped, band_hz=(0.0, 20.0))
    assert "clipping" in {finding.kind for finding in found.verdict.findings}
    assert all(each.flag for each in found.headline.parameters.values())
    assert all(mode.damping_ratio.flag for mode in found.headline.modes)
    assert not any("no unmodelled effect" in sentence for sentence in found.verdict.sentences)


def test_a_torque_flat_at_its_extremes_is_clipped():
    made = record()
    most = 0.7 * np.abs(made.torque_nm).max()
    (finding,) = clipping(replace(made, torque_nm=np.clip(made.torque_nm, -most, most)))
    assert finding.value == pytest.approx(most)
    assert not any(clipping(made))
    coarse = np.round(made.torque_nm / 1e-3) * 1e-3
    assert not any(clipping(replace(made, torque_nm=coarse)))


def test_a_motor_that_stands_still_when_asked_to_move():
    made = record()
    stopped = made.angle_rad.copy()
    stopped[20_000:22_000] = stopped[20_000]
    asked = replace(made, reference_rad=made.angle_rad)
    (finding,) = stops(replace(asked, angle_rad=stopped))
    assert finding.value == pytest.approx(4.0, abs=1.0)
    assert not any(stops(asked))


@pytest.mark.further  # as other residuals
def test_a_drifting_zero_is_no_hum():
    made = record()
    t = np.linspace(-1, 1, TICKS)
    found, verdict = judged(replace(made, torque_nm=made.torque_nm + 0.04 * t**2 + 0.02 * t))
    assert found.keys() == {"sensor drift"}
    assert found["sensor drift"].value == pytest.approx(0.06, rel=0.2)
    assert verdict.adequate


def test_a_damping_that_drifts_is_no_order():
    """By the response at each moment's damping, in steps of 1 %."""
    made, steps = record(), np.linspace(-0.1, 0.1, 21)
    place = np.linspace(-0.1, 0.1, TICKS)
    decay = np.exp(-5.0 * np.arange(TICKS) / TICKS)
    s = 5.0 * RATE_HZ / TICKS + 2j * np.pi * np.fft.rfftfreq(4 * TICKS, 1 / RATE_HZ)
    angle = np.fft.rfft(made.angle_rad * decay, 4 * TICKS)
    torque = np.zeros(TICKS)
    for share in steps:
        external = LINK.density_over_stiffness * s**2 + GAMMA * (1 + share) * s
        elastic = LINK.bending_stiffness_n_m2 * (1 + ZETA * (1 + share) * s)
        k = (-LINK.bending_stiffness_n_m2 * external / elastic + 0j) ** 0.25
        z = k * LINK.length_m
        rigid = elastic * k * (np.cos(z) * np.sinh(z) - np.sin(z) * np.cosh(z))
        now = np.fft.irfft(angle * rigid / (1 + np.cos(z) * np.cosh(z)), 4 * TICKS)[:TICKS]
        torque += np.maximum(1 - np.abs(place - share) / (steps[1] - steps[0]), 0) * now / decay
    noise = np.random.default_rng(5).normal(scale=3e-3, size=TICKS)
    found, verdict = judged(replace(made, torque_nm=torque + noise))
    assert found.keys() == {"drifting damping"}
    assert found["drifting damping"].value == pytest.approx(0.2, abs=0.02)
    assert verdict.structure == "III"


def test_a_drive_that_repeats_has_a_period():
    made = record()
    t = np.arange(TICKS) / RATE_HZ
    lines = sum(np.cos(2 * np.pi * k * t / 7.2 + k * k) for k in range(1, 200, 3))
    repeating = Comparison.of(replace(made, angle_rad=1e-3 * lines), (0.0, 50.0))
    assert repeats_after_s(repeating) == pytest.approx(7.2, abs=0.01)
    assert repeats_after_s(Comparison.of(made, (0.0, 50.0))) == 0.0
