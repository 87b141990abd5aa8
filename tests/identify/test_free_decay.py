import numpy as np
import pytest

from analysis.identify.free_decay import DecaySpectra, LaterDecaySpectra
from rigd.beam import Beam, Damping, Plant, Pole, poles

BEAM = Beam(0.98, 4.7e-3, 0.090275)
NAMES = ("zeta", "alpha", "gamma", "lambda", "ln_density_over_stiffness", "ln_stiffness")
FRACTIONAL = Damping(7.1e-5, 0.996, 5.5e-2, 0.594)
OVER_DAMPED = Damping(0.03, 1.0, 0.02, 1.0)


def at(values):
    ratio, stiffness = np.exp(values[4]), np.exp(values[5])
    return Plant(Beam(0.98, ratio * stiffness, stiffness), Damping(*values[:4]))


@pytest.mark.parametrize("damping", [FRACTIONAL, OVER_DAMPED])
def test_poles_and_their_derivatives(damping):
    values = [damping.zeta, damping.alpha, damping.gamma, damping.lambda_]
    values = np.array(
        [*values, np.log(BEAM.density_over_stiffness), np.log(BEAM.bending_stiffness_n_m2)]
    )
    found = at(values).mode_poles(3, NAMES)
    expected = poles(BEAM, damping, 3)
    flat = [p for pair in expected for p in (pair[:1] if pair[0].imag else pair)]
    assert [pole.at_rad_s for pole in found] == pytest.approx(flat)
    for i, name in enumerate(NAMES):
        if damping is OVER_DAMPED and name in ("alpha", "lambda"):
            continue  # for orders other than 1 the real poles become complex
        step = np.zeros(6)
        step[i] = 1e-6 * (abs(values[i]) or 1.0)
        after, before = (at(values + s).mode_poles(3, ()) for s in (step, -step))
        for pole, p, q in zip(found, after, before, strict=True):
            slope = (p.at_rad_s - q.at_rad_s) / (2 * step[i])
            assert pole.derivative[i] == pytest.approx(slope, rel=1e-4, abs=1e-6)
            if name == "ln_stiffness":
                assert pole.derivative[i] == 0


def test_an_offset_moves_its_own_mode():
    loose = Plant(BEAM, FRACTIONAL, stiffness_offsets=(0.03, -0.05)).mode_poles(3, ())
    uniform = Plant(BEAM, FRACTIONAL).mode_poles(3, ())
    ratio = [abs(p.at_rad_s) / abs(q.at_rad_s) for p, q in zip(loose, uniform, strict=True)]
    assert ratio == pytest.approx([1, 1.03**0.5, 0.95**0.5], rel=1e-3)


def signal(pole, t):
    wave = np.exp(pole.at_rad_s * t)
    return [wave.real, wave.imag] if pole.oscillates else [wave.real]


def test_spectra_are_those_of_the_decays():
    samples, rate_hz = 500, 125.0
    bins = slice(1, 120)
    omega = 2 * np.pi * np.fft.rfftfreq(samples, 1 / rate_hz)[bins]
    t = np.arange(samples) / rate_hz
    spectra = DecaySpectra(samples, rate_hz, omega)
    derivative = np.array([1 + 2j, -0.5j, 0.3])
    some = [Pole(1, -0.15 + 16j, derivative), Pole(2, -4.0 + 0j, derivative.real + 0j)]
    expected = np.fft.rfft([wave for pole in some for wave in signal(pole, t)])[:, bins]
    assert spectra.spectra(some) == pytest.approx(expected, rel=1e-9, abs=1e-9)

    assert_gradient(spectra, some)


def assert_gradient(spectra, some):
    amplitudes = np.array([0.7, -0.4, 1.2])
    gradient = spectra.gradient(some, amplitudes)
    for k in range(3):
        after, before = (
            [Pole(p.mode, p.at_rad_s + h * p.derivative[k], p.derivative) for p in some]
            for h in (1e-6, -1e-6)
        )
        numeric = amplitudes @ (spectra.spectra(after) - spectra.spectra(before)) / 2e-6
        assert gradient[k] == pytest.approx(numeric, rel=1e-5, abs=1e-5)


@pytest.mark.fit
def test_spectra_of_decays_that_begin_within_a_filtered_record(decimation):
    rate_hz, begin = 1000.0, 2345
    inside = decimation.samples_inside_record(7000)
    samples = inside.stop - inside.start
    hz = np.fft.rfftfreq(samples, 1 / decimation.rate_hz)
    bins = slice(1, int(np.searchsorted(hz, 50.0)))
    first_s = (
        begin - (inside.start - decimation.half_length_samples) * decimation.downsampling_factor
    ) / rate_hz
    spectra = LaterDecaySpectra(
        samples, decimation.rate_hz, 2 * np.pi * hz[bins], first_s, 1 / rate_hz
    )
    derivative = np.array([1 + 2j, -0.5j, 0.3])
    some = [Pole(1, -0.15 + 16j, derivative), Pole(2, -4.0 + 0j, derivative.real + 0j)]
    since_s = (np.arange(7000) - begin) / rate_hz
    expected = [
        np.fft.rfft(decimation.apply(np.where(since_s >= 0, wave, 0.0))[inside])[bins]
        for pole in some
        for wave in signal(pole, np.maximum(since_s, 0.0))
    ]
    columns = spectra.spectra(some)
    assert np.abs(columns - expected).max() < 1e-4 * np.abs(columns).max()
    assert_gradient(spectra, some)


def test_no_column_without_a_mode():
    spectra = DecaySpectra(100, 125.0, np.array([1.0, 2.0]))
    assert spectra.spectra(()).shape == (0, 2)
    assert Plant(BEAM, FRACTIONAL).mode_poles(0, NAMES) == ()


@pytest.mark.parametrize(
    "plant",
    [
        Plant(BEAM, FRACTIONAL),
        Plant(BEAM, Damping(zeta=1e-3, alpha=0.7)),
        Plant(BEAM, FRACTIONAL, stiffness_offsets=(0.03, -0.05)),
        Plant(BEAM, FRACTIONAL, tip_mass_kg=2e-4),
        Plant(BEAM, FRACTIONAL, root_compliance_rad_per_nm=0.01),
        Plant(BEAM, Damping(), tip_mass_kg=2e-4),
        Plant(BEAM, FRACTIONAL, tip_mass_kg=1e-12),
    ],
)
def test_expected_poles_do_not_change_the_result(plant):
    found = plant.mode_poles(3, ("zeta",))
    first, second, third = (pole.at_rad_s for pole in found)
    expectations = {
        "close by": (first * (1.01 + 0.01j), second * 0.99, third * (1 - 0.02j)),
        "exactly": (first, second, third),
        "far away": (1.4 * first, second, third),
        "real": (-1 + 0j, second, third),
        "lost": (complex(np.nan, np.nan), second, third),
        "too few": (first, second),
    }
    for name, near in expectations.items():
        again = plant.mode_poles(3, ("zeta",), near)
        assert [pole.mode for pole in again] == [1, 2, 3], name
        for one, other in zip(again, found, strict=True):
            assert one.at_rad_s == pytest.approx(other.at_rad_s, rel=1e-10), name
            np.testing.assert_allclose(one.derivative, other.derivative, rtol=1e-7, atol=1e-7)
