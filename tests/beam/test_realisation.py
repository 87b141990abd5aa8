"""The real-time realisation against Eq. 25, and its refusals."""

import numpy as np
import pytest
from cases import further
from paper_table import table_3

from rigd.beam import Beam, Damping, Plant, modes, transfer
from rigd.beam.realisation import RealisationError, couple, realise

PAPER_BEAM = Beam(0.98, 4.7e-3, 0.090275)


SETS = table_3() | {"undamped": Damping()}


def random_rigs(n, seed):
    """Beams from centimetres to metres; damping from almost none to over-damped first modes."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        beam = Beam(rng.uniform(0.3, 2), 10 ** rng.uniform(-3, 0), 10 ** rng.uniform(-2, 1.5))
        yield (
            beam,
            Damping(
                10 ** rng.uniform(-6, -2.7),
                rng.uniform(0.2, 1.8),
                10 ** rng.uniform(-3, 0),
                rng.uniform(0.2, 1.8),
            ),
        )


def measured_error(realisation, beam, damping):
    """Largest relative error on a grid of this test's own: 0.05 to 100 Hz, dense at resonances."""
    hz = [np.geomspace(0.05, 100, 4001)]
    for mode in modes(beam, damping, 4):
        width = max(mode.damping_ratio, 1e-4) * mode.natural_frequency_rad_s / (2 * np.pi)
        hz.append(mode.frequency_hz + width * np.linspace(-2, 2, 41))
    hz = np.concatenate(hz)
    s = 2j * np.pi * hz[(hz > 0.05) & (hz < 100)]
    separate = [abs(s - mode.poles_rad_s[0]) > 1e-6 * abs(s) for mode in modes(beam, damping, 4)]
    s = s[np.all(separate, axis=0)]
    return np.max(np.abs(realisation.transfer(s) / transfer(s, beam, damping) - 1))


@pytest.mark.parametrize("name", SETS)
def test_table_3(name):
    realisation = realise(Plant(PAPER_BEAM, SETS[name]))
    error = measured_error(realisation, PAPER_BEAM, SETS[name])
    assert error < 5e-5
    assert error < 2 * realisation.relative_error + 1e-9
    assert realisation.b.size <= 60


@pytest.mark.parametrize(
    "damping",
    [
        Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594),
        Damping(zeta=0.54e-4, alpha=1.0, gamma=0.02, lambda_=1.0),
        Damping(zeta=2.49e-4, alpha=0.8),
    ],
    ids=["VI", "III", "IV"],
)
def test_plants_of_the_analysis_tests(damping):
    """EI is known to 4e-4 from 20 pooled chirps or from one session of narrow sweeps."""
    assert measured_error(realise(Plant(PAPER_BEAM, damping)), PAPER_BEAM, damping) < 5e-5


@pytest.mark.parametrize("count", [20, further(60)])
def test_random_beams_and_dampings(count):
    for beam, damping in random_rigs(count, seed=1):
        realisation = realise(Plant(beam, damping))
        assert measured_error(realisation, beam, damping) < 3 * realisation.relative_error + 1e-9
        for fraction in (0.1, 1.0, 10.0):
            motor = couple(realisation, motor_inertia_kg_m2=fraction * beam.inertia_kg_m2)
            assert np.linalg.eigvals(motor.a).real.max() < 1e-2


def test_state_space_is_the_transfer_function_and_block_diagonal():
    realisation = realise(Plant(PAPER_BEAM, SETS["VI-omega"]))
    s = 2j * np.pi * np.geomspace(0.01, 500, 40)
    states = np.array(
        [np.linalg.solve(x * np.eye(realisation.b.size) - realisation.a, realisation.b) for x in s]
    )
    g = (
        s**2 * (states @ realisation.c + realisation.direct_inertia_kg_m2)
        + s * realisation.direct_viscosity_nm_s_per_rad
        + realisation.direct_stiffness_nm_per_rad
    )
    np.testing.assert_allclose(g, realisation.transfer(s), rtol=1e-10)
    pair = realisation.poles_rad_s.imag > 0
    blocks = 2 * pair.sum()
    poles = np.concatenate([realisation.poles_rad_s, realisation.poles_rad_s[pair].conj()])
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(realisation.a)), np.sort_complex(poles), rtol=1e-10
    )
    assert not np.triu(realisation.a, 2).any()
    assert not np.diag(realisation.a, 1)[1:blocks:2].any()
    assert not np.diag(realisation.a, 1)[blocks:].any()
    np.testing.assert_array_equal(np.diag(realisation.a, 1), -np.diag(realisation.a, -1))


def test_direct_terms_dissipate_or_store():
    for name, damping in SETS.items():
        realisation = realise(Plant(PAPER_BEAM, damping))
        assert realisation.direct_inertia_kg_m2 >= 0, name
        assert realisation.direct_viscosity_nm_s_per_rad >= 0, name
        assert realisation.direct_stiffness_nm_per_rad >= 0, name


def test_refusal_states_the_achieved_error():
    achieved = realise(Plant(PAPER_BEAM, SETS["VI-omega"])).relative_error
    with pytest.raises(RealisationError, match=rf"{achieved:.1e}.*1\.0e-07 was requested"):
        realise(Plant(PAPER_BEAM, SETS["VI-omega"]), max_relative_error=1e-7)
    assert realise(Plant(PAPER_BEAM, SETS["VI-omega"]), max_relative_error=1.01 * achieved)


def test_realisation_that_destabilises_a_motor_is_refused(monkeypatch):
    """No damping is known that fails this check; the undamped beam does under a stricter limit."""
    monkeypatch.setattr("rigd.beam.realisation.MAX_GROWTH_PER_S", 1e-6)
    with pytest.raises(RealisationError, match="without friction would be unstable"):
        realise(Plant(PAPER_BEAM, Damping()))


@pytest.mark.parametrize(
    "damping",
    [
        Damping(zeta=-1e-5),
        Damping(gamma=-0.01),
        Damping(zeta=1e-5, alpha=2.0),
        Damping(gamma=0.01, lambda_=2.1),
        Damping(zeta=1e-5, alpha=-0.1),
        Damping(zeta=float("nan")),
    ],
)
def test_active_beams_are_refused(damping):
    with pytest.raises(RealisationError, match="creates energy"):
        realise(Plant(PAPER_BEAM, damping))


def test_a_beam_of_too_many_modes_is_refused_at_once():
    millimetres_for_metres = Beam(980.0, 4.7e-3, 0.090275)
    with pytest.raises(RealisationError, match=r"modes below 1200 Hz.*units"):
        realise(Plant(millimetres_for_metres, Damping()))


@pytest.mark.parametrize("fraction", [0.95, *map(further, (0.98, 1.02, 1.05))])
def test_number_of_states_does_not_depend_on_stiffness(fraction):
    # At 1200 Hz, where no more modes are realised, and at critical damping a mode changes sides.
    for length_m in np.linspace(0.5, 1.5, 21):
        for damping in (Damping(7.1e-5, 0.996, 0.055, 0.594), Damping(zeta=1.075e-3)):
            beam = Beam(length_m, 4.7e-3, 0.090275)
            other = Beam(length_m, 4.7e-3, fraction * 0.090275)
            one, two = (
                realise(Plant(beam, damping)),
                realise(Plant(other, damping), mode_selection_beam=beam),
            )
            assert one.b.size == two.b.size
            assert np.array_equal(np.unique(one.mode_indices), np.unique(two.mode_indices))
            of_first = (
                two.poles_rad_s[two.mode_indices == 0] / one.poles_rad_s[one.mode_indices == 0]
            )
            assert of_first.imag == pytest.approx(0.0, abs=1e-2)
            assert of_first.real == pytest.approx(fraction**0.5, rel=1e-2)
            own = realise(Plant(beam, damping), mode_selection_beam=beam)
            assert np.array_equal(own.c, one.c)


def test_modes_of_a_very_different_beam_are_refused():
    with pytest.raises(RealisationError, match="does not have the modes of"):
        realise(
            Plant(Beam(0.98, 4.7e-3, 0.090275), Damping(zeta=1.075e-3)),
            mode_selection_beam=Beam(0.98, 4.7e-3, 0.9),
        )
