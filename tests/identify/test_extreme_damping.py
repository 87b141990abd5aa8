"""Beams with so little damping that the encoder is too coarse, or so much that they hardly ring."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.identify import select
from rigd.beam import Damping, Plant

ENCODER_STEP_RAD = 7e-5


@pytest.fixture
def measured(responding, references, link):
    """Measure a chirp on a beam with a coarse encoder."""

    def measure(damping):
        session = responding(references(41_000), damping, link)
        counts = np.round(session.angle_rad / ENCODER_STEP_RAD)
        return replace(session, angle_rad=ENCODER_STEP_RAD * counts).measured(
            noise_nm=2e-3, seed=2
        )  # fmt: skip

    return measure


@pytest.mark.fit
def test_rounding_of_the_angle_is_part_of_the_noise(measured, link):
    damping = Damping(zeta=1e-5, alpha=1.0, gamma=6e-3, lambda_=0.6)
    headline = select(measured(damping)).headline
    assert headline.uniform_beam.status == "passed"
    for mode, pole in zip(headline.modes, Plant(link, damping).mode_poles(3), strict=True):
        frequency_hz, ratio = mode.frequency_hz, mode.damping_ratio
        assert ratio.flag is None
        assert abs(frequency_hz.value - pole.at_rad_s.imag / (2 * np.pi)) < 3 * frequency_hz.std
        assert abs(ratio.value + pole.at_rad_s.real / abs(pole.at_rad_s)) < 3 * ratio.std


@pytest.mark.fit
def test_much_too_coarse_encoder_is_flagged(measured):
    selection = select(measured(Damping(zeta=4e-6, alpha=1.0, gamma=2.5e-3, lambda_=0.6)))
    reason = "at a sharp resonance, the steps of the encoder exceed the noise of the torque"
    assert all(mode.damping_ratio.flag == reason for mode in selection.headline.modes)
    assert all(parameter.flag for parameter in selection.headline.parameters.values())
    assert f"The residual is white, but {reason}." in selection.verdict.sentences


@pytest.mark.fit
def test_mode_beyond_the_searched_damping_is_flagged(responding, references, link):
    damping = Damping(zeta=5e-4, alpha=1.0, gamma=1.0, lambda_=1.0)
    session = responding(references(41_000), damping, link)
    selection = select(session.measured(noise_nm=2e-3, seed=2))
    assert selection.headline.modes[0].damping_ratio.flag.endswith("range searched, 50 %")
    assert selection.headline.uniform_beam.status == "not tested"
    assert not any("uniform" in sentence for sentence in selection.verdict.sentences)
