"""Drag where each mode has one amplitude: fitted with the modes, which are those without air."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify import select
from rigd.beam import modes

pytestmark = pytest.mark.fit

RATE_HZ = 1000.0
NOISE_NM = 10e-3
DRAG_M = 1.2e-3


BURST_S = 2.0


@pytest.fixture(scope="module")
def bursts_of_modes(responding, plants, link):
    """Two seconds of each of three modes at one amplitude, each with a second of decay."""
    time_s = np.arange(round(10 * RATE_HZ)) / RATE_HZ
    reference_rad = np.zeros(time_s.size)
    for mode, amplitude_rad in zip(
        modes(link, plants["III"], 3), (0.003, 0.004, 0.01), strict=True
    ):
        elapsed_s = time_s - 1.0 - 3.0 * (mode.number - 1)
        during = (elapsed_s >= 0) & (elapsed_s < BURST_S)
        elapsed_s = elapsed_s[during]
        fade = np.minimum(1.0, 4 * np.minimum(elapsed_s, BURST_S - elapsed_s))
        sine = np.sin(2 * np.pi * mode.frequency_hz * elapsed_s)
        reference_rad[during] = amplitude_rad * np.sin(0.5 * np.pi * fade) ** 2 * sine
    return responding(reference_rad, plants["III"], link)


def judged(session, seed, noise_nm=NOISE_NM):
    measurement = replace(session.measured(noise_nm=noise_nm, seed=seed), uniformity=1e-3)
    return select(measurement)


def deviations(selection, plants, link):
    """Deviation of each damping ratio from that without air, in standard deviations."""
    truth = {mode.number: mode.damping_ratio for mode in modes(link, plants["III"], 3)}
    ratios = [(mode.number, mode.damping_ratio) for mode in selection.headline.modes if mode.shown]
    assert [number for number, _ in ratios] == [1, 2, 3]
    assert all(ratio.flag is None for _, ratio in ratios)
    return [(ratio.value - truth[number]) / ratio.std for number, ratio in ratios]


def test_damping_ratios_are_those_without_air(bursts_of_modes, brake, plants, link):
    drag_nm = brake.drag_torque(bursts_of_modes.angle_rad, RATE_HZ, link, plants["III"], DRAG_M)
    braked = replace(bursts_of_modes, torque_nm=bursts_of_modes.torque_nm + drag_nm)
    selection = judged(braked, 7)
    assert np.abs(deviations(selection, plants, link)).max() < 3.5
    assert selection.verdict.adequate
    (finding,) = (each for each in selection.verdict.findings if each.kind == "air drag")
    assert "without air" in finding.sentence
    assert "hardly distinguishes drag" in finding.sentence
    assert (finding.value, finding.interval) == (None, None)


def test_significant_drag_is_found_with_its_size(bursts_of_modes, brake, plants, link):
    drag_m = 2 * DRAG_M
    drag_nm = brake.drag_torque(bursts_of_modes.angle_rad, RATE_HZ, link, plants["III"], drag_m)
    braked = replace(bursts_of_modes, torque_nm=bursts_of_modes.torque_nm + drag_nm)
    selection = judged(braked, 7, noise_nm=NOISE_NM / 3)
    assert np.abs(deviations(selection, plants, link)).max() < 3.5
    (finding,) = (each for each in selection.verdict.findings if each.kind == "air drag")
    assert finding.sentence.startswith("Air drag acts on the beam: C_D d = ")
    assert "mm; 95 %), so damping grows with the amplitude." in finding.sentence
    assert finding.sentence.endswith("damping ratios are those without air.")
    assert finding.unit == "m"
    low_m, high_m = finding.interval
    assert low_m < drag_m < high_m
    assert finding.value == pytest.approx((low_m + high_m) / 2)


@pytest.mark.further  # that no drag is found is in test_drag.py
def test_damping_ratios_without_air_include_drag_uncertainty(bursts_of_modes, plants, link):
    selection = judged(bursts_of_modes, 8)
    assert np.abs(deviations(selection, plants, link)).max() < 3.5
    assert {"air drag"} >= {each.kind for each in selection.verdict.findings}
