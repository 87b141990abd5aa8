"""Fisher information of a record: against finite differences, a closed form and a fit."""

import json
from dataclasses import replace

import beam_estimates
import numpy as np
import pytest
from beam_estimates import UNIFORM, covariance_of

from analysis.identify import Measurement, fit_record
from analysis.models import STRUCTURES
from rigd.beam import LOGARITHMIC_PARAMETERS, Beam, modes, transfer
from rigd.excitation import BeamEstimate, ExcitationError, information

RATE_HZ = 1000.0
LINK = beam_estimates.ESTIMATE.plant.beam
NOISE_NM = 5e-3
ESTIMATE = replace(
    beam_estimates.ESTIMATE,
    noise_nm2_per_hz=np.array([2.0 * NOISE_NM**2 / RATE_HZ]),
    plant=replace(beam_estimates.ESTIMATE.plant, delay_s=3e-4, tool_inertia_kg_m2=1e-5),
)


def moved(angle, estimate):
    """Torque (n,) from rest, on a finer grid than the product's."""
    n = angle.size
    decay = np.exp(-7.0 * np.arange(n) / n)
    s = 7.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1 / RATE_HZ)
    plant = estimate.plant
    g = transfer(s, plant.beam, plant.damping) + plant.tool_inertia_kg_m2 * s * s
    spectrum = np.fft.rfft(angle * decay, 4 * n) * g * np.exp(-s * plant.delay_s)
    return np.fft.irfft(spectrum, 4 * n)[:n] / decay


def stepped(estimate, name, step):
    """Estimate with one parameter changed; by a factor where its logarithm counts."""
    value = estimate.parameter_values[name]
    value = value * np.exp(step) if name in LOGARITHMIC_PARAMETERS else value + step
    return replace(estimate, plant=estimate.plant.with_parameters({name: value}))


def scan():
    """Sweep over all modes whose beginning and end are smooth: nothing lies beyond the band."""
    t = np.arange(9000) / RATE_HZ
    phase = 2 * np.pi * (0.5 * t + 0.5 * (46.0 - 0.5) * t**2 / 8.0)
    # Mode 3 rings down in the record's last second: a fit leaves out the reach of its filter.
    window = np.where(t < 8.0, np.minimum(1.0, 12.0 * np.sin(np.pi * t / 8.0)) ** 4, 0.0)
    return 0.02 * window * np.sin(phase)


def test_information_is_the_gram_matrix_of_differences():
    angle = scan()
    steps = dict.fromkeys(UNIFORM, 1e-5) | {"delay_s": 1e-7, "tool_inertia_kg_m2": 1e-9}
    rows = np.array(
        [
            (moved(angle, stepped(ESTIMATE, n, h)) - moved(angle, stepped(ESTIMATE, n, -h)))
            / (2 * h * NOISE_NM)
            for n, h in steps.items()
        ]
    )
    t = np.arange(angle.size) / RATE_HZ
    unknown = [np.ones(t.size), t]
    for mode in modes(LINK, ESTIMATE.plant.damping, 3):
        decay = np.exp(mode.poles_rad_s[0] * t)
        unknown += [decay.real, decay.imag]
    left = rows - (np.linalg.lstsq(np.array(unknown).T, rows.T)[0].T @ np.array(unknown))
    found = information(angle, ESTIMATE, RATE_HZ)
    size = np.sqrt(np.diag(found))
    np.testing.assert_allclose(
        found / np.outer(size, size), left @ left.T / np.outer(size, size), atol=0.01
    )


def test_information_of_a_sine_on_stiffness_in_closed_form():
    """Far from the modes: half the squared amplitude over the noise's density, per second."""
    alone = replace(ESTIMATE, free_parameters=("bending_stiffness_n_m2",))
    alone = replace(alone, plant=replace(alone.plant, delay_s=0.0))
    t = np.arange(30_000) / RATE_HZ
    ramp = np.minimum(1.0, t / 5.0)
    angle = 0.02 * ramp * np.sin(2 * np.pi * 8.0 * t)
    s = 2j * np.pi * 8.0
    # The stiffness, at the same density over stiffness, scales the torque.
    size = abs(transfer(np.array([s]), alone.plant.beam, alone.plant.damping)[0]) * 0.02
    per_s = size**2 / alone.noise_nm2_per_hz[0]
    longer, shorter = (
        information(angle[: round(end * RATE_HZ)], alone, RATE_HZ)[0, 0] for end in (28.0, 18.0)
    )
    assert (longer - shorter) / 10.0 == pytest.approx(per_s, rel=0.03)


@pytest.mark.fit
def test_predicted_uncertainty_is_that_of_a_fit():
    angle = scan()
    torque = moved(angle, ESTIMATE)
    noise = np.random.default_rng(5).normal(scale=NOISE_NM, size=torque.size)
    known = np.ones(torque.size, dtype=bool)
    measurement = Measurement("record", angle, torque + noise, RATE_HZ, LINK, known, known, 0.0)
    fit = fit_record(measurement, [STRUCTURES["VI"]]).fits[0]
    predicted = covariance_of(information(angle, ESTIMATE, RATE_HZ))
    for name, spread in zip(fit.determined, np.sqrt(np.diag(fit.covariance)), strict=True):
        index = UNIFORM.index(name)
        assert spread == pytest.approx(np.sqrt(predicted[index, index]), rel=0.25), name


def test_twice_the_noise_gives_a_quarter_of_information():
    angle = scan()
    loud = replace(ESTIMATE, noise_nm2_per_hz=4.0 * ESTIMATE.noise_nm2_per_hz)
    np.testing.assert_allclose(
        4.0 * information(angle, loud, RATE_HZ), information(angle, ESTIMATE, RATE_HZ), rtol=1e-9
    )


# The estimate from JSON

DOCUMENT = {
    "beam": {"length_m": 0.98, "density_kg_per_m": 4.7e-3, "bending_stiffness_n_m2": 0.09},
    "damping": {"zeta": 7e-5, "alpha": 1.0, "gamma": 0.0, "lambda": 1.0},
    "names": ["zeta", "alpha", "density_over_stiffness", "stiffness_offset_2"],
    "noise": {"frequency_hz": [1.0, 50.0], "nm2_per_hz": [1e-7, 2e-7]},
    "delay_s": 1e-3,
    "structure": "II",
}


def test_an_estimate_is_read_from_json():
    estimate = BeamEstimate.from_dict(json.loads(json.dumps(DOCUMENT)))
    assert estimate.plant.beam == Beam(0.98, 4.7e-3, 0.09)
    assert estimate.free_parameters == ("zeta", "alpha", "density_over_stiffness")
    assert estimate.plant.delay_s == 1e-3
    assert len(estimate.modes()) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise": {"frequency_hz": [1.0], "nm2_per_hz": [0.0]}}, "positive noise"),
        ({"noise": {"frequency_hz": [2.0, 1.0], "nm2_per_hz": [1.0, 1.0]}}, "increasing"),
        ({"damping": {"zeta": 7e-5, "alpha": 2.5, "gamma": 0.0, "lambda": 1.0}}, "alpha = 2.5"),
        ({"beam": {"length_m": 0.98}}, "no key 'density_kg_per_m'"),
        ({"names": []}, "no free parameter"),
        ({"tip_mass_kg": float("inf")}, "tip_mass_kg = inf"),
        ({"delay_s": "late"}, "cannot be read"),
        ({"delay_s": float("nan")}, "delay_s = nan"),
    ],
)
def test_unusable_estimate_is_refused(change, message):
    with pytest.raises(ExcitationError, match=message):
        BeamEstimate.from_dict({**DOCUMENT, **change})
