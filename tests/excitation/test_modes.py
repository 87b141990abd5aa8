"""Narrow sweeps: joints, bands, duration, limits, and the benefit of the split of the time."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cases import further

from rigd import excitation
from rigd.beam import GRADIENT_NAMES, Beam, transfer_and_gradient
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD
from rigd.excitation import KINDS, ExcitationError, make_excitation
from rigd.excitation._narrow_sweeps import Band, FoundMode, first_order_damping, time_fractions
from rigd.runner import with_tip_slope
from rigd.runner.planning import RigPreview, excitation_for, plan_session

LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)


def bands_of(made):
    """(start_hz, stop_hz, amplitude_rad, duration_s) of each sweep, from the file's metadata."""
    rows = []
    for text in made.parameters["bands"].split("; "):
        band, amplitude, duration = text.split(", ")
        start, stop = band.removesuffix(" Hz").split("-")
        rows.append([float(start), float(stop), float(amplitude[:-4]), float(duration[:-2])])
    return rows


@pytest.fixture(scope="module")
def make(document_of_modes, rig):
    return partial(
        excitation.modes, rate_hz=1000.0, path=document_of_modes, duration_s=31.234, rest_s=2.0,
        ring_down_s=7.5, rig=rig,
    )  # fmt: skip


@pytest.fixture(scope="module")
def made(make):
    return make()


def test_duration_is_the_requested_one_to_the_tick(made):
    assert made.segments == {
        "rest": (0, 2000),
        "sweep": (2000, 33_234),
        "ring_down": (33_234, 40_734),
    }
    assert made.reference_rad.shape == (40_734,)
    assert sum(row[3] for row in bands_of(made)) == pytest.approx(31.234, abs=1e-3)
    assert not made.reference_rad[:2001].any()
    assert abs(made.reference_rad[-1]) < 1e-6


def test_angle_and_speed_are_continuous_and_zero_at_joints(made):
    rows = bands_of(made)
    joints = 2000 + np.round(1000 * np.cumsum([0.0, *(row[3] for row in rows)])).astype(int)
    speed = np.diff(made.reference_rad) * 1000
    fastest = np.abs(speed).max()
    for joint in joints:
        assert np.abs(made.reference_rad[joint - 3 : joint + 4]).max() < 1e-5
        assert np.abs(speed[joint - 3 : joint + 3]).max() < 1e-3 * fastest
    # A sine of the highest frequency changes its speed by omega dt of its peak from tick to tick.
    highest_hz = max(row[1] for row in rows)
    assert np.abs(np.diff(speed)).max() < 1.05 * 2 * np.pi * highest_hz / 1000 * fastest


def test_each_sweep_covers_only_its_band(document):
    made = excitation.modes(rate_hz=1000.0, path=document(), duration_s=90.0, widths=3.0)
    frequency_hz = np.fft.rfftfreq(30_000, 1e-3)
    first = 1000
    for start_hz, stop_hz, amplitude_rad, duration_s in bands_of(made):
        ticks = round(1000 * duration_s)
        assert ticks == 30_000
        energy = np.abs(np.fft.rfft(made.reference_rad[first : first + ticks])) ** 2
        spread_hz = 1.0  # of the fades
        inside = (frequency_hz > start_hz - spread_hz) & (frequency_hz < stop_hz + spread_hz)
        assert energy[inside].sum() > 0.999 * energy.sum()
        middle = np.abs(frequency_hz - 0.5 * (start_hz + stop_hz)) < 0.3 * (stop_hz - start_hz)
        assert energy[middle].min() > 0.05 * energy.max()
        assert np.abs(made.reference_rad[first : first + ticks]).max() == pytest.approx(
            amplitude_rad, rel=2e-3
        )
        first += ticks


def test_band_has_half_power_widths_and_uncertainty():
    band = Band.around_mode(FoundMode(16.0, 0.005, 0.1), half_power_widths=2.0)
    assert (band.start_hz, band.stop_hz) == pytest.approx((16 - 0.42, 16 + 0.42))
    assert band.decay_s == pytest.approx(1 / (2 * np.pi * 16 * 0.005))
    heavy = Band.around_mode(FoundMode(2.0, 0.6, 0.0), half_power_widths=2.0)
    assert 0 < heavy.start_hz < heavy.stop_hz


def test_longest_ringing_mode_comes_first(document):
    made = excitation.modes(rate_hz=1000.0, path=document(), stop_hz=20.0)
    assert [row[0] < mode < row[1] for row, mode in zip(bands_of(made), (2.57, 16.01), strict=True)]
    assert len(bands_of(made)) == 2
    with pytest.raises(ExcitationError, match=r"fits\.json.*2\.57 Hz.*stop_hz = 2 Hz"):
        excitation.modes(rate_hz=1000.0, path=document(), stop_hz=2.0)


@pytest.mark.parametrize("amplitude_rad", [further(0.025), 0.3])
def test_amplitudes_pass_the_planning(document, profile, amplitude_rad):
    options = {"path": document(), "amplitude_rad": amplitude_rad, "duration_s": 24.0}
    made = excitation_for(profile, "modes", options)
    plan = plan_session(profile, made)
    assert plan.warnings == ()
    peak = plan.prediction.peak_torque_nm / profile.rig.motor.peak_torque_nm
    assert RigPreview(profile).fraction_of_limits(made.reference_rad) == pytest.approx(peak)
    assert peak < 0.95
    if amplitude_rad == 0.3:
        assert peak > 0.8


def test_tighter_limit_lowers_the_affected_amplitude(document, profile):
    # Behind the motor loop the angle is small at the third mode, and the error the whole amplitude.
    limits = replace(profile.limits, tracking_error_rad=0.02)
    profile, tight = (with_tip_slope(replace(profile, limits=each), 10.0) for each in
                      (profile.limits, limits))  # fmt: skip
    options = {"path": document(), "duration_s": 24.0}
    free, held = (bands_of(excitation_for(p, "modes", options)) for p in (profile, tight))
    assert [row[2] for row in free] == pytest.approx([0.025] * 3, rel=0.05)
    assert held[2][2] < 0.018
    assert held[0][2] == pytest.approx(free[0][2], rel=0.03)
    plan_session(tight, excitation_for(tight, "modes", options))


@pytest.mark.parametrize("limit_rad", [further(None), 0.05, further(0.4)])
def test_amplitudes_stay_within_the_tip_slope(document, profile, limit_rad):
    """Each of the three sweeps comes as near to it as it may."""
    rig = with_tip_slope(profile, limit_rad)
    options = {"path": document(), "duration_s": 24.0}
    made = excitation_for(rig, "modes", options)
    plan = plan_session(rig, made)
    limit_rad = limit_rad or SMALL_TIP_SLOPE_RAD
    assert made.parameters["tip_slope_rad"] == limit_rad
    assert 0.8 * limit_rad < plan.prediction.tip.slope_rad <= 0.91 * limit_rad


def test_split_of_the_time_is_optimal(rig):
    """Against all splits of a grid, by the information computed in another way."""
    modes = [
        FoundMode(2.57, 0.0091, 0.0),
        FoundMode(16.01, 0.0042, 0.0),
        FoundMode(44.8, 0.0099, 0.0),
    ]
    bands = [Band.around_mode(mode, 1.0) for mode in modes]
    fractions = time_fractions(bands, [0.025] * 3, rig)
    assert fractions.sum() == pytest.approx(1.0)
    damping = first_order_damping(modes, LINK)
    rates = []
    for band in bands:
        f = np.linspace(band.start_hz, band.stop_hz, 301)
        tuned = min(
            (Beam(0.98, 4.7e-3 * x, 0.090275) for x in np.linspace(0.97, 1.03, 2001)),
            key=lambda beam, hz=band.mode.frequency_hz: min(
                abs(z**2 / (0.98**2 * beam.density_over_stiffness**0.5) / (2 * np.pi) - hz)
                for z in (1.8751040687, 4.6940911330, 7.8547574382)
            ),
        )
        g, gradient = transfer_and_gradient(2j * np.pi * f, tuned, damping, GRADIENT_NAMES)
        rows = np.stack([*gradient, f * g * 2j * np.pi, (2 * np.pi * f) ** 2 + 0j])
        rows *= rig.tracking_response(f)
        rates.append((rows.conj() @ rows.T).real / f.size)
    rates = np.array(rates)
    scale = np.sqrt(rates.sum(axis=0).diagonal())
    rates /= np.outer(scale, scale)

    def spread(split):
        return np.log(np.diag(np.linalg.inv(np.tensordot(split, rates, axes=1)))[:4]).sum()

    grid = [
        (a, b, 1 - a - b) for a in np.arange(0.02, 1, 0.02) for b in np.arange(0.02, 0.99 - a, 0.02)
    ]
    best = min(map(spread, grid))
    assert spread(fractions) < best + 0.02
    assert spread(fractions) < spread([1 / 3] * 3) - 0.3


def test_damping_reproduces_the_ratios_of_modes():
    omega = 2 * np.pi * np.array([2.57, 16.01, 44.8])
    for zeta, gamma in ((5.4e-5, 0.02), (5.4e-5, 0.0), (0.0, 0.03)):
        ratio = 0.5 * (zeta * omega + gamma / (LINK.density_over_stiffness * omega))
        modes = [FoundMode(w / (2 * np.pi), r, 0.0) for w, r in zip(omega, ratio, strict=True)]
        found = first_order_damping(modes, LINK)
        assert (found.zeta, found.gamma) == pytest.approx((zeta, gamma), rel=1e-9, abs=1e-12)
    rising = [FoundMode(2.57, 1e-4, 0.0), FoundMode(16.01, 5e-3, 0.0)]
    assert first_order_damping(rising, LINK).gamma == 0.0


@pytest.mark.parametrize("count", [1, further(2)])
def test_few_modes_are_enough_for_a_session(document, rig, count):
    modes = [{"frequency_hz": f, "damping_ratio": 0.005} for f in (2.6, 16.0)][:count]
    rows = bands_of(
        excitation.modes(rate_hz=1000.0, path=document(modes), duration_s=40.0, rig=rig)
    )
    assert len(rows) == count
    assert sum(row[3] for row in rows) == pytest.approx(40.0)
    assert min(row[3] for row in rows) >= 0.5 * 40.0 / count - 1e-3


def test_equal_documents_give_equal_references(make, made):
    again = make()
    assert (made.reference_rad == again.reference_rad).all()
    assert made.parameters == again.parameters


def test_metadata_have_units_and_plain_values(made):
    assert made.kind == "modes"
    assert made.parameters["tip_slope_rad"] == SMALL_TIP_SLOPE_RAD
    assert made.parameters["file"] == "fits.json"
    assert json.loads(json.dumps(dict(made.parameters))) == made.parameters
    numbers = {name for name, value in made.parameters.items() if isinstance(value, float)}
    assert all(name == "widths" or name.endswith(("_rad", "_hz", "_s")) for name in numbers)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"duration_s": 10.0}, ("duration_s = 10 s", "taper_s = 1 s", "3 sweeps", "12 s")),
        ({"amplitude_rad": 0.0}, ("amplitude_rad = 0 rad",)),
        ({"widths": 0.0}, ("widths = 0",)),
        ({"taper_s": 0.0}, ("taper_s = 0 s",)),
        ({"widths": 1e3}, ("widths", "Hz")),
        ({"stop_hz": float("nan")}, ("stop_hz",)),
    ],
)
def test_absurd_options_are_refused(document, options, words):
    with pytest.raises(ExcitationError) as refused:
        excitation.modes(rate_hz=1000.0, path=document(), **options)
    assert all(word in str(refused.value) for word in words), str(refused.value)


def test_bands_without_a_rig_get_equal_times(document):
    made = make_excitation("modes", {"path": document(), "amplitude_rad": 0.04}, 1000.0)
    assert {(row[2], row[3]) for row in bands_of(made)} == {(0.04, 40.0)}
    assert KINDS["modes"] is excitation.modes
