"""Sessions under a controller that feeds the noise of the torque back into the motor."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cases import further

from analysis.identify import Comparison, Measurement, fit_freest_alone, fit_record, select
from analysis.identify._instrument import reference_coherent_angle
from analysis.models import STRUCTURES
from analysis.record import load_record
from rigd.beam import Beam, Damping, Plant, clamped_free_eigenvalues, transfer

RATE_HZ = 1000.0
NOISE_NM = 1e-2
CLAMP = 1e-5
DAMPED = Damping(zeta=2e-5, alpha=1.0, gamma=0.02, lambda_=1.0)
LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)


def fit(measurement, name):
    return fit_record(measurement, [STRUCTURES[name]]).fits[0]


@cache
def answers(n, damping):
    """Answers of beam and motor (2e-3 kg m², 80 rad/s, one tick late) to a torque, in Laplace."""
    s = 5 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1 / RATE_HZ)
    turned = 500 * s * (s + 310) / (s + 80) ** 4 * np.exp(-s / RATE_HZ)
    return turned, turned * (transfer(s, LINK, damping) + CLAMP * s**2)


@pytest.fixture
def controlled(sessions, plants, references):
    """Let the sensor's noise (and a hum: Hz, N·m) move the motor, and the beam answer."""

    def make(name, seed, *, multisine=False, hum=(0.0, 0.0), **masks):
        session = sessions(name, tool_inertia_kg_m2=CLAMP, multisine=multisine)
        n = session.angle_rad.size
        decay = np.exp(-5 * np.arange(n) / n)
        noise = np.random.default_rng(seed).normal(scale=NOISE_NM, size=n)
        hum_hz, amplitude_nm = hum
        noise += amplitude_nm * np.sin(2 * np.pi * hum_hz * np.arange(n) / RATE_HZ)
        spectrum = np.fft.rfft(noise * decay, 4 * n)
        turned, answered = (
            np.fft.irfft(spectrum * answer, 4 * n)[:n] / decay
            for answer in answers(n, plants[name])
        )
        moved = replace(
            session,
            angle_rad=session.angle_rad + turned,
            torque_nm=session.torque_nm + answered + noise,
        )
        return replace(moved.measured(**masks), reference_rad=references(n, multisine))

    return make


def deviates(found, name="tool_inertia_kg_m2", value=CLAMP):
    return (found.parameters[name] - value) / found.std[name]


@pytest.mark.fit
@pytest.mark.further  # `analyze` refuses this band, because the file states the sweep
def test_no_mode_is_fitted_to_noise_beyond_the_sweep():
    """Up to 50 Hz the sweep excites three modes; at the fourth, at 88 Hz, the angle is noise."""
    path = Path(__file__).parents[2] / "docs" / "tutorials" / "antenna.mcap"
    measurement = Measurement.from_record(load_record(path, highest_hz=90.0))
    assert fit_freest_alone(measurement, (0.0, 90.0))[0].visible_modes == (1, 2, 3)


def test_coherent_part_is_found_through_lag_and_noise():
    n, rng = 20_000, np.random.default_rng(1)
    reference = rng.normal(size=n) * np.hanning(n)
    lag = np.exp(-np.arange(200) / 10.0)
    follows = np.convolve(reference, lag)[:n]
    noise = rng.normal(size=n) * 0.3 * follows.std()
    found = reference_coherent_angle(follows + noise, reference, 125.0)
    assert np.std(found - follows) < 0.2 * noise.std()


def test_angle_equal_to_reference_is_fully_coherent():
    angle = np.random.default_rng(2).normal(size=5000)
    assert reference_coherent_angle(angle, angle, 125.0) == pytest.approx(angle, abs=1e-6)


def test_no_part_is_coherent_with_constant_reference():
    assert not reference_coherent_angle(np.ones(500), np.zeros(500), 125.0).any()


@pytest.mark.fit
@pytest.mark.further  # as a hum that does
def test_noise_that_moves_the_motor_is_no_response(sessions, controlled):
    """Against the same noise in the torque alone, which leaves nothing to chance."""
    session = sessions("III", tool_inertia_kg_m2=CLAMP)
    biased, unbiased = [], []
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(scale=NOISE_NM, size=session.angle_rad.size)
        alone = replace(session, torque_nm=session.torque_nm + noise).measured()
        by_chance = deviates(fit(alone, "III"))
        measured = controlled("III", seed)
        biased.append(deviates(fit(replace(measured, reference_rad=None), "III")) - by_chance)
        unbiased.append(deviates(fit(measured, "III")) - by_chance)
    assert np.mean(biased) > 0.3
    assert abs(np.mean(unbiased)) < 0.1


def test_a_reference_may_end_anywhere():
    n, rng = 20_000, np.random.default_rng(4)
    reference = 0.1 * rng.normal(size=n) * np.hanning(n) + np.where(np.arange(n) < 15_000, 0.0, 3.0)
    lag = np.exp(-np.arange(200) / 10.0) / 10.0
    follows = np.convolve(reference, lag)[:n]
    found = reference_coherent_angle(follows, reference, 125.0)
    assert np.abs(found - follows)[-125:].max() < 0.01 * follows[-1]


@pytest.mark.fit
@pytest.mark.fit
def test_noise_that_moves_the_motor_does_not_bias_a_fit_with_drag(sessions, controlled):
    """At this amplitude drag of unknown size is fitted, with the whole angle as input."""
    amplitude = 0.15
    deviations = []
    for seed in (1, 2):
        larger, noisy = sessions("III", tool_inertia_kg_m2=CLAMP), controlled("III", seed)
        selection = select(
            replace(
                noisy,
                angle_rad=noisy.angle_rad - (1 - amplitude) * larger.angle_rad,
                torque_nm=noisy.torque_nm - (1 - amplitude) * larger.torque_nm,
                reference_rad=amplitude * noisy.reference_rad,
            )
        )
        assert "air drag" in {finding.kind for finding in selection.verdict.findings}
        deviations.append(deviates(selection.candidates[0].fit))
    assert abs(np.mean(deviations)) < 2.0


def test_noise_between_narrow_bands_is_no_response():
    """There, the reference has hardly any power, such as that of the ends of its sweeps."""
    n, rate_hz, rng = 20_000, 125.0, np.random.default_rng(1)
    time_s = np.arange(n) / rate_hz
    reference = sum(
        np.hanning(n) ** 2 * np.sin(2 * np.pi * (first_hz + time_s / 160.0) * time_s)
        for first_hz in (2.0, 16.0, 44.0)
    )
    reference += rng.normal(size=n) * 3e-5
    noise = rng.normal(size=n) * 0.01
    found = reference_coherent_angle(reference + noise, reference, rate_hz)
    frequency_hz = np.fft.rfftfreq(n, 1 / rate_hz)
    between = (frequency_hz > 25.0) & (frequency_hz < 40.0)
    found_power, noise_power = (
        np.sum(np.abs(np.fft.rfft(signal)[between]) ** 2) for signal in (found, noise)
    )
    assert found_power < 1e-5 * noise_power
    assert found == pytest.approx(reference, abs=0.01)


def test_drift_does_not_reduce_the_coherent_part(controlled):
    measured = controlled("III", 2)
    drift = np.linspace(0.0, 0.2, measured.angle_rad.size)
    comparison = Comparison.from_measurement(
        replace(measured, angle_rad=measured.angle_rad + drift), (0.0, 50.0)
    )
    assert comparison.reference_coherent_angle_rad() is not comparison.angle_rad


@pytest.mark.fit
def test_unknown_torques_do_not_count_with_a_controller(controlled):
    unknown = np.concatenate([np.arange(10_000, 10_050), np.arange(20_000, 30_000, 100)])
    every = fit(controlled("III", 5), "III")
    found = fit(controlled("III", 5, unknown_torque=unknown), "III")
    for name, std in every.std.items():
        if std:
            assert abs(found.parameters[name] - every.parameters[name]) < 0.3 * std, name


@pytest.mark.fit
def test_unrelated_reference_is_not_used(sessions, references):
    measured = sessions("III").measured()
    other = np.random.default_rng(0).normal(size=measured.angle_rad.size)
    comparison = Comparison.from_measurement(replace(measured, reference_rad=other), (0.0, 50.0))
    plant = fit(measured, "III").plant
    assert comparison.use_reference_coherent_angle(plant) is comparison
    explained = replace(measured, reference_rad=references(measured.angle_rad.size))
    comparison = Comparison.from_measurement(explained, (0.0, 50.0))
    assert comparison.use_reference_coherent_angle(plant) is not comparison


@pytest.mark.fit
@pytest.mark.further  # as a hum that moves the motor, and a multisine in test_hum.py
def test_only_noise_between_lines_of_a_multisine(controlled, true_parameters):
    """It moves the motor there too: no response, no hum, and no other structure."""
    measured = controlled("VI", 7, multisine=True)
    found = fit_record(measured, [STRUCTURES[name] for name in ("III", "VI", "VII")])
    third, sixth, seventh = found.fits
    assert found.lines == ()
    assert seventh.cost < third.cost - 50
    assert abs(sixth.cost - seventh.cost) < 10  # its alpha is all but 1
    for name, value in true_parameters("VI", tool_inertia_kg_m2=CLAMP).items():
        if seventh.std[name]:
            assert abs(deviates(seventh, name, value)) < 3.0, name


@pytest.mark.fit
@pytest.mark.parametrize("hum", [(16.011, 5e-3), further((16.08, 2e-2))])
def test_a_hum_on_a_mode_that_moves_the_motor_is_no_response(controlled, hum):
    quiet = fit(controlled("VI", 5), "VI")
    analysis = fit_record(controlled("VI", 5, hum=hum), [STRUCTURES["VI"]])
    (found,), (line,) = analysis.fits, analysis.lines
    assert line.frequency_hz == pytest.approx(hum[0], abs=2e-3)
    assert line.amplitude_nm == pytest.approx(hum[1], abs=3e-4)
    for name in quiet.determined:
        assert abs(found.parameters[name] - quiet.parameters[name]) < quiet.std[name], name


@pytest.fixture(scope="module")
def in_narrow_bands():
    """Beam with a mass at its tip, which moves the motor as it rings, driven at its modes alone."""
    loaded = Plant(LINK, DAMPED, tip_mass_kg=1.8e-4)
    n = 30_000
    t = np.arange(n) / RATE_HZ
    reference = np.zeros(n)
    for number, pole in enumerate(loaded.poles(clamped_free_eigenvalues(3))[:, 0]):
        for begins in (1.0 + 3.0 * number, 11.0 + 6.0 * number):
            window = np.clip(np.sin(np.pi * (t - begins) / 5.0), 0.0, 1.0) ** 2
            window[(t < begins) | (t > begins + 5.0)] = 0.0
            reference += 0.008 * window * np.sin(pole.imag * (t - begins))
    # A first estimate of all modes, too short to distinguish them from those of another beam.
    sweep = np.sin(2 * np.pi * (0.5 * t + 5.0 * t**2)) * np.clip(np.sin(np.pi * t / 5.0), 0.0, 1.0)
    reference += 0.02 * np.where(t < 5.0, sweep, 0.0)
    s = 6.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1 / RATE_HZ)
    g = loaded.transfer(s)
    decay = np.exp(-6.0 * np.arange(n) / n)
    turned = -100 * s * (s + 310) / (s + 80) ** 4 * np.exp(-s / RATE_HZ)
    spectrum = np.fft.rfft(reference * decay, 4 * n) / (1 - turned * g)
    angle, torque = (np.fft.irfft(each, 4 * n)[:n] / decay for each in (spectrum, spectrum * g))
    torque += np.random.default_rng(11).normal(scale=4e-3, size=n)
    known = np.ones(n, dtype=bool)
    return Measurement(
        "narrow", angle, torque, RATE_HZ, LINK, known, known, 0.0, reference_rad=reference
    )


@pytest.mark.fit
def test_wrong_first_beam_does_not_decide_the_incoherent_part(in_narrow_bands):
    """Ringing modes turn the motor in much narrower bands than the smoothing of the estimate."""
    headline, _, _ = fit_freest_alone(in_narrow_bands, (0.0, 50.0))
    poles = Plant(LINK, DAMPED, tip_mass_kg=1.8e-4).poles(clamped_free_eigenvalues(3))[:, 0]
    for mode, pole in zip(headline.modes, poles, strict=True):
        frequency, ratio = mode.frequency_hz, mode.damping_ratio
        assert frequency.flag is ratio.flag is None
        assert abs(frequency.value - pole.imag / (2 * np.pi)) < 4 * frequency.std
        assert abs(ratio.value + pole.real / abs(pole)) < 4 * ratio.std


@pytest.mark.fit
def test_coherent_part_is_reestimated_after_a_wrong_beam(controlled):
    unknown = np.arange(15_000, 15_050)
    measured = controlled("III", 1, unknown_torque=unknown)
    comparison = Comparison.from_measurement(measured, (0.0, 50.0))
    found = fit_record(measured, [STRUCTURES["III"]])
    plant = found.fits[0].plant
    first = comparison.use_reference_coherent_angle(plant)
    assert first.with_reestimated_angle(plant, found.noise) is first
    other = first.with_reestimated_angle(
        replace(plant, beam=replace(LINK, density_kg_per_m=5.2e-3)), found.noise
    ).with_reestimated_angle(plant, found.noise)
    assert other.angle_rad + other.incoherent_angle_rad == pytest.approx(
        first.angle_rad + first.incoherent_angle_rad
    )
    for each in (first, other):
        retained = each.torque_nm[each.retained_samples] + each.incoherent_torque_nm
        assert retained == pytest.approx(comparison.torque_nm[comparison.retained_samples])
    # Nothing was taken out there.
    assert comparison.with_reestimated_angle(plant, found.noise) is comparison


@pytest.mark.fit
def test_narrow_band_ringing_is_followed_with_its_torque(in_narrow_bands):
    loaded = Plant(LINK, DAMPED, tip_mass_kg=1.8e-4)
    plant = Plant(LINK, DAMPED, tip_mass_kg=1.8e-4)
    first = Comparison.from_measurement(in_narrow_bands, (0.0, 50.0)).use_reference_coherent_angle(
        plant
    )
    noise = fit_record(in_narrow_bands, [STRUCTURES["III"]]).noise
    wrong = first.with_reestimated_angle(Plant(LINK, DAMPED), noise)
    reestimated = wrong.with_reestimated_angle(plant, noise)
    assert loaded.tip_mass_kg == plant.tip_mass_kg
    first_std, reestimated_std = (
        np.std(each.incoherent_angle_rad[each.retained_samples]) for each in (first, reestimated)
    )
    assert reestimated_std < 0.2 * first_std
