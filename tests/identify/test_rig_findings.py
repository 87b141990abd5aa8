"""Deviations of a rig are reported with their cause; beams by the textbook's closed form."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import further

from analysis.identify import Comparison, Measurement, fit_freest_alone, select
from analysis.identify._channel_checks import (
    clipping_findings,
    sign_and_unit_findings,
    standstill_findings,
)
from analysis.identify._leakage import repetition_period_s
from analysis.identify._time_varying import find_temporal_changes, temporal_change_findings
from analysis.identify.headline import CONTRADICTED_FILE_REASON
from rigd.beam import Beam, Damping, Plant, clamped_free_eigenvalues

pytestmark = pytest.mark.fit

RATE_HZ = 500.0
TICKS = 45_000
LINK = Beam(0.98, 4.7e-3, 0.090275)
ZETA, GAMMA = 7.1e-5, 1.2e-2


def response(s, tip_mass_kg=0.0, clamp_nm_per_rad=np.inf, gamma=GAMMA):
    """Torque per angle of a beam of type III, without cancellation only above 0.1 Hz."""
    external = LINK.density_over_stiffness * s**2 + gamma * s
    elastic = LINK.bending_stiffness_n_m2 * (1 + ZETA * s)
    k = (-LINK.bending_stiffness_n_m2 * external / elastic + 0j) ** 0.25
    z, tip = k * LINK.length_m, tip_mass_kg * s**2 / (elastic * k**3)
    sine, cosine, sinh, cosh = np.sin(z), np.cos(z), np.sinh(z), np.cosh(z)
    pinned = cosine * sinh - sine * cosh
    rigid = elastic * k * (pinned + 2 * tip * sinh * sine) / (1 + cosine * cosh - tip * pinned)
    return rigid / (1 + rigid / clamp_nm_per_rad)


@cache
def record(factor=1.0, filter_hz=np.inf, clock=0.0, noise_nm=3e-3, **ends):
    """Chirp of 80 s to 50 Hz; the torque as its channel shows it, with noise."""
    t = np.arange(TICKS) / RATE_HZ - 1
    chirp = np.where((t >= 0) & (t < 80), np.sin(2 * np.pi * (0.05 * t + 49.95 * t**2 / 160)), 0.0)
    decay = np.exp(-5.0 * np.arange(TICKS) / TICKS)
    s = 5.0 * RATE_HZ / TICKS + 2j * np.pi * np.fft.rfftfreq(4 * TICKS, 1 / RATE_HZ)
    loop = 2 * np.pi * 20
    angle = np.fft.rfft(0.025 * chirp * decay, 4 * TICKS)
    angle = angle / (1 + 1.4 * s / loop + (s / loop) ** 2)
    torque = angle * response(s, **ends) / (1 + s / (2 * np.pi * filter_hz))
    angle_rad = np.fft.irfft(angle, 4 * TICKS)[:TICKS] / decay
    # At t (1 + clock): the first terms of Taylor's series, enough for 1e-4 and 50 Hz.
    torque_nm, size = np.zeros(TICKS), np.ones(TICKS)
    for power in range(20 if clock else 1):
        torque_nm += size * np.fft.irfft(torque * s**power, 4 * TICKS)[:TICKS] / decay
        size = size * clock * np.arange(TICKS) / RATE_HZ / (power + 1)
    noise = np.random.default_rng(5).normal(scale=noise_nm, size=TICKS)
    known = np.ones(TICKS, dtype=bool)
    return Measurement(
        "x", angle_rad, factor * (torque_nm + noise), RATE_HZ, LINK, known, known, uniformity=0.0
    )


def assert_modes(headline, **ends):
    """Without a flag, and where those of the rig with these ends are."""
    loaded = Plant(LINK, Damping(ZETA, 1.0, GAMMA, 1.0), **ends)
    poles = loaded.poles(clamped_free_eigenvalues(3))[:, 0]
    for mode, pole in zip(headline.modes, poles, strict=True):
        for quantity, value in (
            (mode.frequency_hz, pole.imag / (2 * np.pi)),
            (mode.damping_ratio, -pole.real / abs(pole)),
        ):
            assert quantity.flag is None
            assert abs(quantity.value - value) < 4 * quantity.std


def judged(measurement):
    verdict = select(measurement).verdict
    return {finding.kind: finding for finding in verdict.findings}, verdict


@pytest.mark.parametrize(
    ("more", "ends", "words"),
    [
        ({"clamp_nm_per_rad": 30.0}, {"root_compliance_rad_per_nm": 1 / 30}, "clamp"),
        further({"tip_mass_kg": 1.5e-4}, {"tip_mass_kg": 1.5e-4}, "0.15 g at the tip"),
        further({"filter_hz": 120.0}, {}, "low-pass filter of first order at 120 Hz"),
    ],
)
def test_deviating_rig_has_its_cause_reported_without_facts(more, ends, words):
    selection = select(record(**more))
    (named,) = selection.verdict.findings
    assert named.kind == "rival explanations"
    assert words in named.sentence
    assert (named.value, named.interval) == (None, None)
    assert selection.verdict.adequate
    assert selection.headline.uniform_beam.status == "refused"
    orders = selection.verdict.alpha, selection.verdict.lambda_
    assert "fractional" not in {order.status for order in orders}
    assert_modes(selection.headline, **ends)


@pytest.mark.parametrize("clock", [1e-5, further(-1e-5), further(1e-4)])
def test_clocks_of_different_rates_are_found_with_their_difference(candidates_of, clock):
    """A positive difference: the torque with a time stamp is that of a later time."""
    uniform = candidates_of(record(clock=clock))
    with_clock, (change,) = find_temporal_changes(uniform)
    assert change.effect == "clock"
    assert abs(change.size - clock) < 3.5 * change.std
    assert change.std < 0.05 * abs(clock)
    assert with_clock.is_nearly_white(with_clock.likeliest_fit)


@pytest.mark.further  # as other rigs that are no uniform beam
def test_slightly_different_clocks_refuse_the_uniform_beam():
    """A delay that rises along a sweep is one that rises with the frequency."""
    selection = select(record(clock=1e-5))
    headline = selection.headline
    assert selection.verdict.adequate
    assert headline.uniform_beam.status == "refused"
    assert all(finding.interval is None for finding in selection.verdict.findings)
    assert_modes(headline)


@pytest.mark.further  # as other changes in one sweep
def test_very_different_clocks_flag_every_number():
    selection = select(record(clock=1e-4))
    found = {finding.kind: finding for finding in selection.verdict.findings}
    assert "ppm) would explain the record as well" in found["clock rate difference"].sentence
    assert all(finding.interval is None for finding in found.values())
    assert all(mode.damping_ratio.flag for mode in selection.headline.modes)


@pytest.mark.further  # as other records without a visible mode
def test_clocks_that_hide_every_mode_are_reported():
    """Only resonances outside the beam remain in the modal model, which is none of the beam."""
    selection = select(record(clock=5e-4))
    assert not selection.verdict.adequate
    assert {finding.kind for finding in selection.verdict.findings} == {"implausible"}
    assert all(mode.damping_ratio.flag for mode in selection.headline.modes)


@pytest.mark.parametrize(
    ("factor", "kinds"),
    [
        (-1.0, ["sign"]),
        (180 / np.pi, ["unit"]),
        (-1e-3, ["sign", "unit"]),
        (1e4, ["unit"]),
        (3.5, []),
        (1.3, []),
        (1.0, []),
        (0.8, []),
    ],
)
def test_wrong_sign_and_unit_are_found_immediately(factor, kinds):
    comparison = Comparison.from_measurement(record(factor), (0.0, 50.0))
    assert [finding.kind for finding in sign_and_unit_findings(comparison)] == kinds


@pytest.mark.parametrize("noise_nm", [3e-3, 3e-2])
def test_wrong_unit_has_its_factor_and_name_with_any_noise(noise_nm):
    """At most frequencies the larger noise exceeds the torque."""
    factor = 1 / 0.11298483
    measurement = record(factor, noise_nm=noise_nm)
    (found,) = sign_and_unit_findings(Comparison.from_measurement(measurement, (0.0, 50.0)))
    assert abs(found.value / factor - 1) < 0.08
    assert "pound-force inches" in found.sentence


@pytest.mark.parametrize("ends", [{"tip_mass_kg": 1e-3}, {"clamp_nm_per_rad": 3.0}])
def test_other_frequencies_are_no_wrong_unit(ends):
    comparison = Comparison.from_measurement(record(**ends), (0.0, 50.0))
    assert list(sign_and_unit_findings(comparison)) == []


def with_tool(factor, tool_inertia_kg_m2, stated_kg_m2=0.0, noise_nm=3e-3):
    """Return the comparison of a record whose torque has that of a tool, times a factor."""
    beam_alone = record(noise_nm=noise_nm)
    # The motor is at rest at the beginning and at the end.
    omega_rad_s = 2 * np.pi * np.fft.rfftfreq(TICKS, 1 / RATE_HZ)
    acceleration = np.fft.irfft(-(omega_rad_s**2) * np.fft.rfft(beam_alone.angle_rad), TICKS)
    measurement = replace(
        beam_alone,
        torque_nm=factor * (beam_alone.torque_nm + tool_inertia_kg_m2 * acceleration),
        tool_inertia_kg_m2=stated_kg_m2,
    )
    return Comparison.from_measurement(measurement, (0.0, 50.0))


@pytest.mark.parametrize("tool_inertia_kg_m2", [1e-4, 2e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("stated_fraction", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("noise_nm", [3e-3, further(3e-2)])
def test_tool_inertia_is_no_wrong_sign_and_no_wrong_unit(
    tool_inertia_kg_m2, stated_fraction, noise_nm
):
    """Its torque exceeds that of the beam at most frequencies, and is opposite to it."""
    comparison = with_tool(1.0, tool_inertia_kg_m2, stated_fraction * tool_inertia_kg_m2, noise_nm)
    assert list(sign_and_unit_findings(comparison)) == []


@pytest.mark.parametrize(
    ("factor", "kinds"),
    [(-1.0, ["sign"]), (180 / np.pi, ["unit"]), (np.pi / 180, ["unit"]), (-1e-3, ["sign", "unit"])],
)
@pytest.mark.parametrize("stated_fraction", [0.0, 1.0])
def test_wrong_sign_and_unit_are_found_with_a_tool_inertia(factor, kinds, stated_fraction):
    for tool_inertia_kg_m2 in (2e-4, 1e-3):
        comparison = with_tool(factor, tool_inertia_kg_m2, stated_fraction * tool_inertia_kg_m2)
        found = list(sign_and_unit_findings(comparison))
        assert [finding.kind for finding in found] == kinds
        if "unit" in kinds:
            assert found[-1].value == pytest.approx(abs(factor), rel=0.05)


def test_unit_of_a_short_record_is_not_that_of_its_resonances():
    """Of a beam that rings on at the end: few frequencies, most of them in a resonance."""
    whole = record(noise_nm=0.0)
    short = replace(
        whole,
        **{
            name: getattr(whole, name)[:7500]
            for name in ("angle_rad", "torque_nm", "angle_known", "torque_known")
        },
    )
    assert list(sign_and_unit_findings(Comparison.from_measurement(short, (0.0, 50.0)))) == []


def test_a_wrong_sign_comes_first():
    found = select(record(-1.0), band_hz=(0.0, 20.0))
    verdict, headline = found.verdict, found.headline
    assert [finding.kind for finding in verdict.findings] == ["sign"]
    assert verdict.sentences == (verdict.findings[0].sentence,)
    assert verdict.experiments == (verdict.findings[0].remedy,)
    assert not verdict.adequate
    quantities = [*headline.parameters.values(), *(mode.frequency_hz for mode in headline.modes)]
    assert {each.flag for each in quantities} == {CONTRADICTED_FILE_REASON}


@pytest.fixture(scope="module")
def slightly_clipped():
    """Even where so little is cut off that the residual is noise."""
    made = record()
    most = np.sort(np.abs(made.torque_nm))[-12]
    return replace(made, torque_nm=np.clip(made.torque_nm, -most, most))


def assert_flagged(headline, findings):
    assert "clipping" in {finding.kind for finding in findings}
    assert all(each.flag for each in headline.parameters.values())
    assert all(mode.damping_ratio.flag for mode in headline.modes)


def test_clipped_torque_flags_every_number(slightly_clipped):
    headline, findings, _ = fit_freest_alone(slightly_clipped, (0.0, 10.0))
    assert_flagged(headline, findings)


@pytest.mark.further  # as the freest structure alone
def test_clipped_torque_withholds_numbers(slightly_clipped):
    found = select(slightly_clipped, band_hz=(0.0, 20.0))
    assert_flagged(found.headline, found.verdict.findings)
    assert not any("no unmodelled effect" in sentence for sentence in found.verdict.sentences)


def test_a_torque_flat_at_its_extremes_is_clipped():
    made = record()
    most = 0.7 * np.abs(made.torque_nm).max()
    (finding,) = clipping_findings(replace(made, torque_nm=np.clip(made.torque_nm, -most, most)))
    assert finding.value == pytest.approx(most)
    assert not any(clipping_findings(made))
    coarse = np.round(made.torque_nm / 1e-3) * 1e-3
    assert not any(clipping_findings(replace(made, torque_nm=coarse)))


@pytest.mark.parametrize("step_nm", [5e-3, 2e-2])
def test_coarse_torque_is_clipped_only_if_its_extremes_are_more_frequent_than_others(step_nm):
    made = record()
    coarse_nm = np.round(made.torque_nm / step_nm) * step_nm
    # The step at the extreme of a resonance contains several successive values.
    largest_nm = coarse_nm.max()
    coarse_nm[np.flatnonzero(coarse_nm == largest_nm)[0] + np.arange(4)] = largest_nm
    assert not any(clipping_findings(replace(made, torque_nm=coarse_nm)))
    limit_nm = 0.8 * largest_nm
    for clipped_nm in (
        np.clip(coarse_nm, -limit_nm, limit_nm),
        np.round(np.clip(made.torque_nm, -limit_nm, limit_nm) / step_nm) * step_nm,
    ):
        (finding,) = clipping_findings(replace(made, torque_nm=clipped_nm))
        assert finding.value == pytest.approx(limit_nm, abs=step_nm)


@pytest.mark.parametrize("noise_nm", [0.0, 1e-3])
def test_steps_at_the_crests_of_a_sine_are_no_clipping(noise_nm):
    """The resolution of 20 mN·m just ends at the crest, where most values are in one step."""
    t, step_nm = np.arange(TICKS) / RATE_HZ, 0.02
    noise_nm = np.random.default_rng(1).normal(scale=noise_nm, size=TICKS)
    torque_nm = 14.49 * step_nm * np.sin(2 * np.pi * 1.7 * t) + noise_nm
    coarse_nm = np.round(torque_nm / step_nm) * step_nm
    assert not any(clipping_findings(replace(record(), torque_nm=coarse_nm)))


def test_motor_standstill_despite_reference():
    made = record()
    stopped = made.angle_rad.copy()
    stopped[20_000:22_000] = stopped[20_000]
    requested = replace(made, reference_rad=made.angle_rad)
    (finding,) = standstill_findings(replace(requested, angle_rad=stopped))
    assert finding.value == pytest.approx(4.0, abs=1.0)
    assert not any(standstill_findings(requested))


@pytest.mark.further  # as other residuals
def test_a_drifting_zero_is_no_hum():
    made = record()
    t = np.linspace(-1, 1, TICKS)
    found, verdict = judged(replace(made, torque_nm=made.torque_nm + 0.04 * t**2 + 0.02 * t))
    assert found.keys() == {"sensor drift"}
    assert found["sensor drift"].value == pytest.approx(0.06, rel=0.2)
    assert verdict.adequate


def changing_record(stiffness=0.0, damping=0.0, seconds=20.0, finer=8, back=False):
    """Chirp, of a beam that changes by so much from beginning to end: its modes step by step."""
    dt, modes = 1 / (finer * RATE_HZ), 6
    t = np.arange(round(seconds / dt)) * dt
    turn = 99 * np.pi / seconds * (2 if back else 1)
    phase, speed = np.pi * t + turn * t**2 / 2, np.pi + turn * t
    if back:  # up to 50 Hz in the first half, and down again
        half, returning = seconds / 2, t > seconds / 2
        since = t - half
        down = np.pi * half + turn * half**2 / 2 + (np.pi + turn * half) * since
        phase = np.where(returning, down - turn * since**2 / 2, phase)
        speed = np.where(returning, np.pi + turn * (seconds - t), speed)
        turn = np.where(returning, -turn, turn)
    window, rise = np.ones((3, t.size)) * [[1], [0], [0]], np.pi / 1.0
    for ends, sign in ((t < 1, 1), (t > seconds - 1, -1)):
        x = rise * (t[ends] if sign > 0 else seconds - t[ends])
        window[0, ends] = (1 - np.cos(x)) / 2
        window[1, ends] = sign * rise * np.sin(x) / 2
        window[2, ends] = rise**2 * np.cos(x) / 2
    sine, cosine = np.sin(phase), np.cos(phase)
    angle = 0.025 * window[0] * sine
    first = 0.025 * (window[1] * sine + window[0] * speed * cosine)
    second = 0.025 * (
        (window[2] - window[0] * speed**2) * sine
        + (2 * window[1] * speed + window[0] * turn) * cosine
    )
    ei, more = (1 + change * (t / seconds - 0.5) for change in (stiffness, damping))
    ei *= LINK.bending_stiffness_n_m2
    rho, cubed = LINK.density_kg_per_m, LINK.length_m**3 / 3
    z = np.array([1.87510407, 4.69409113, 7.85475744, *(np.pi * (np.arange(4, 7) - 0.5))])
    quartic, lever = (z / LINK.length_m) ** 4, 2 / (z / LINK.length_m) ** 2 / LINK.length_m**0.5
    assert modes == z.size
    # q'' + 2 d q' + w² q = f, f = -lever (θ'' + EI γ θ' / ρ): exactly, over each step with EI held.
    whole, lossy = ei[:, None] / rho, (ei * more)[:, None] / rho
    half = (lossy[1:] + lossy[:-1]) * (GAMMA + quartic * ZETA) / 4
    square = (whole[1:] + whole[:-1]) * quartic / 2
    force = -lever * (second[:, None] + lossy * GAMMA * first[:, None])
    turned = np.sqrt(square - half**2)
    decay, c, s = np.exp(-half * dt), np.cos(turned * dt), np.sin(turned * dt) / turned
    rows = [[decay * (c + half * s), decay * s], [-decay * square * s, decay * (c - half * s)]]
    steps = np.moveaxis(np.array(rows), (0, 1), (2, 3))
    before, after = force[:-1] / square, force[1:] / square  # static answers; linear between
    slope = (after - before) / dt
    lag = 2 * half / square * slope
    rests = np.stack([np.stack([before - lag, slope], -1), np.stack([after - lag, slope], -1)])
    # Steps of all parts of 400 at once, which lead from the state in which a part begins.
    affine = np.zeros((t.size, modes, 3, 3))
    affine[1:, :, :2, :2] = steps
    affine[1:, :, :2, 2] = rests[1] - (steps @ rests[0][..., None])[..., 0]
    affine[..., 2, 2] = 1.0
    parts = affine.reshape(-1, 400, modes, 3, 3)
    for i in range(1, 400):
        parts[:, i] = parts[:, i] @ parts[:, i - 1]
    state, out = np.array([[0.0], [0.0], [1.0]]), np.zeros((*parts.shape[:-1], 1))
    for part, found in zip(parts, out, strict=True):
        found[:] = part @ state
        state = found[-1]
    out = out.reshape(t.size, modes, 3)
    bent = force - lossy * (GAMMA + quartic * ZETA) * out[:, :, 1] - whole * quartic * out[:, :, 0]
    torque = rho * (cubed * second + bent @ lever)
    torque += ei * more * GAMMA * (cubed * first + out[:, :, 1] @ lever)
    noise = np.random.default_rng(6).normal(scale=3e-3, size=t[::finer].size)
    known = np.ones(noise.size, dtype=bool)
    torque_nm = torque[::finer] + noise
    return Measurement(
        "x", angle[::finer], torque_nm, RATE_HZ, LINK, known, known, uniformity=0.0,
        is_single_sweep=not back,
    )  # fmt: skip


def test_hopeless_changes_are_not_fitted(candidates_of):
    uniform = candidates_of(changing_record(damping=0.2))
    with_change, (change,) = find_temporal_changes(uniform)
    assert change.effect == "damping"
    assert abs(change.size - 0.2) < 3.5 * change.std
    # A fact only where time and frequency do not vary together.
    findings = {
        is_single: list(
            temporal_change_findings((change,), is_single_sweep=is_single, explained=True)
        )
        for is_single in (False, True)
    }
    assert [each.interval for each in findings[True]] == [None]
    assert f"({100 * change.size:+.2g} % " in findings[True][0].sentence
    # No size of a change that leaves part of the record unexplained.
    (unexplained,) = temporal_change_findings((change,), is_single_sweep=True, explained=False)
    assert (unexplained.value, unexplained.interval) == (None, None)
    assert "%" not in unexplained.sentence
    (finding,) = findings[False]
    assert finding.kind == "drifting damping"
    assert finding.interval[0] < change.size < finding.interval[1]
    saved = uniform.bic - with_change.bic
    again, changes = find_temporal_changes(uniform, rival_bic=uniform.bic - saved)
    assert changes == (change,)
    assert again.bic == with_change.bic
    assert find_temporal_changes(uniform, rival_bic=uniform.bic - 2 * saved) == (uniform, ())


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("stiffness", 0.005),
        further("damping", 0.2),
        further("stiffness", -0.01),
        further("damping", -0.3),
        further("damping", 0.0),
    ],
)
def test_drift_in_one_sweep_is_no_fact(what, change):
    """Time and frequency vary together there."""
    selection = select(changing_record(**{what: change}))
    found = selection.verdict.findings
    assert all(each.interval is None for each in found)
    assert bool(found) == bool(change)


@pytest.mark.parametrize(
    ("what", "change"), [("stiffness", 0.01), ("damping", 0.3), ("damping", 0.0)]
)
@pytest.mark.further  # the condition for a fact is tested above
def test_drift_during_a_double_sweep_is_reported(what, change):
    """A mode rings for seconds: it does not follow changes of its frequency and decay at once."""
    selection = select(changing_record(**{what: change}, seconds=40.0, back=True))
    verdict, numbers = selection.verdict, selection.headline.parameters
    found = {finding.kind: finding for finding in verdict.findings}
    assert found.keys() == ({f"drifting {what}"} if change else set())
    if change:
        low, high = found[f"drifting {what}"].interval
        assert abs((low + high) / 2 - change) < 3.5 * (high - low) / 3.92
        assert high - low < 0.3 * abs(change)
    assert verdict.adequate
    truth = {"zeta": ZETA, "alpha": 1.0, "gamma": GAMMA, "lambda": 1.0,
             "density_over_stiffness": LINK.density_over_stiffness}  # fmt: skip
    for name, value in truth.items():
        assert numbers[name].flag is None
        assert abs(numbers[name].value - value) < 3.5 * numbers[name].std, name


def test_a_drive_that_repeats_has_a_period():
    made = record()
    t = np.arange(TICKS) / RATE_HZ
    lines = sum(np.cos(2 * np.pi * k * t / 7.2 + k * k) for k in range(1, 200, 3))
    repeating = Comparison.from_measurement(replace(made, angle_rad=1e-3 * lines), (0.0, 50.0))
    assert repetition_period_s(repeating) == pytest.approx(7.2, abs=0.01)
    assert repetition_period_s(Comparison.from_measurement(made, (0.0, 50.0))) == 0.0
