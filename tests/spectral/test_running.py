"""The estimate of a record that grows: at its end Welch's, on the way near the truth."""

import tracemalloc
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.beam import Beam, Damping, TransferGrid
from rigd.excitation import chirp, multisine, step
from rigd.spectral import (
    RunningResponse,
    Segmentation,
    SpectralError,
    segmentation_of,
    welch_response,
)

RATE_HZ = 1000.0
LAST_HZ = 60.0
BEAM = Beam(0.98, 4.7e-3, 0.090275)
DAMPING = Damping(zeta=0.01, alpha=1.0)
SMALL = Segmentation(segment_length=400, overlap=60, nfft=1000)
SMALL_GAP = 20  # ticks at 200 Hz


@dataclass(frozen=True)
class Sweep:
    reference: np.ndarray
    angle: np.ndarray
    torque: np.ndarray

    def part(self, first, end):
        return self.reference[first:end], self.angle[first:end], self.torque[first:end]


def lagging(reference_rad, lag_s=3e-3):
    """A motor that follows its reference late, as those under control do."""
    spectrum = np.fft.rfft(reference_rad, 2 * reference_rad.size)
    omega = 2 * np.pi * np.fft.rfftfreq(2 * reference_rad.size, 1 / RATE_HZ)
    return np.fft.irfft(spectrum / (1 + 1j * omega * lag_s))[: reference_rad.size]


def exact_torque(angle_rad, window_per_s=0.1):
    """By the inverse Fourier transform along s = sigma + jω, which lets nothing wrap round."""
    t = np.arange(angle_rad.size) / RATE_HZ
    spectrum = np.fft.rfft(angle_rad * np.exp(-window_per_s * t), 2 * t.size)
    s = window_per_s + 2j * np.pi * np.fft.rfftfreq(2 * t.size, 1 / RATE_HZ)
    torque = np.fft.irfft(TransferGrid(s).evaluate(BEAM, DAMPING) * spectrum)[: t.size]
    return torque * np.exp(window_per_s * t)


def sweep_of_excitation(excitation):
    angle_rad = lagging(excitation.reference_rad)
    torque_nm = exact_torque(angle_rad)
    part = slice(*excitation.segments["sweep"])
    return Sweep(excitation.reference_rad[part], angle_rad[part], torque_nm[part])


@pytest.fixture(scope="module")
def paper():
    """The paper's chirp without noise."""
    return sweep_of_excitation(chirp(rate_hz=RATE_HZ))


@pytest.fixture(scope="module")
def noisy(paper):
    rng = np.random.default_rng(12_001)
    return replace(
        paper,
        angle=paper.angle + 2e-5 * rng.normal(size=paper.angle.size),
        torque=paper.torque + 2e-3 * rng.normal(size=paper.angle.size),
    )


def estimates(sweep, blocks, **settings):
    """One after each block of so many samples; the tick that follows it, and the estimate."""
    samples = sweep.reference.size
    running = RunningResponse(RATE_HZ, samples, last_hz=LAST_HZ, **settings)
    for first in range(0, samples, blocks):
        end = min(samples, first + blocks)
        running.feed(np.arange(first, end), *sweep.part(first, end))
        yield end, running.estimate()


def assert_equals_welch(found, whole, rtol=1e-9):
    whole = whole.band(0.0, found.response.frequency_hz[-1])
    np.testing.assert_array_equal(found.response.frequency_hz, whole.frequency_hz)
    np.testing.assert_allclose(found.response.response, whole.response, rtol=rtol)
    assert (found.response.segments, found.response.estimator) == (whole.segments, "h1")
    if whole.coherence is None:
        assert found.response.coherence is None
    else:
        np.testing.assert_allclose(found.response.coherence, whole.coherence, atol=1e-9)


def test_final_estimate_equals_welchs(noisy):
    samples = noisy.reference.size
    running = RunningResponse(RATE_HZ, samples, last_hz=LAST_HZ)
    for first in range(0, samples, 50):
        if first in (30_000, 119_950):
            assert not running.estimate().is_final
        running.feed(np.arange(first, first + 50), *noisy.part(first, first + 50))
    found = running.estimate()
    assert found.is_final
    assert found.response.frequency_hz[-1] == LAST_HZ
    assert_equals_welch(found, welch_response(noisy.angle, noisy.torque, RATE_HZ))
    assert found.response.segments == 8
    excited_hz = found.response.frequency_hz[found.is_excited]
    assert excited_hz.min() < 0.1
    assert 49.8 < excited_hz.max() < 50.05


@pytest.mark.parametrize("duration_s", [5.0, 10.0, 20.0])
def test_short_records_use_the_segments_of_analyze(duration_s):
    sweep = sweep_of_excitation(chirp(rate_hz=RATE_HZ, duration_s=duration_s, ring_down_s=0.0))
    samples = sweep.reference.size
    chosen = segmentation_of(samples, RATE_HZ)
    *earlier, (_, found) = estimates(sweep, samples // 20)
    assert found.is_final
    whole = welch_response(
        sweep.angle,
        sweep.torque,
        RATE_HZ,
        segment_length=chosen.segment_length,
        overlap=chosen.overlap,
        nfft=chosen.nfft,
    )
    assert_equals_welch(found, whole)
    shown = [end / samples for end, estimate in earlier if estimate is not None]
    assert shown[0] <= 0.3


def test_estimate_is_near_the_truth_throughout_the_sweep(paper):
    """Where the reference has been, from above the first resonance, which Welch itself blurs."""
    last_hz = []
    for end, found in estimates(paper, 6000):
        frequency_hz = found.response.frequency_hz
        seen = found.is_excited & (frequency_hz > 4.0)
        last_hz.append(frequency_hz[found.is_excited].max())
        if end < 18_000:
            continue
        true = TransferGrid(2j * np.pi * frequency_hz[seen]).evaluate(BEAM, DAMPING)
        error = np.abs(found.response.response[seen] / true - 1)
        assert np.median(error) < 0.01, end
        assert np.quantile(error, 0.9) < 0.03, end
        assert error.max() < 0.1, end
    # It reaches as far as the sweep, block by block.
    np.testing.assert_allclose(np.diff(last_hz), 6 * 50 / 120, atol=0.25)


@pytest.mark.parametrize(
    ("start_hz", "stop_hz", "duration_s", "taper_s"),
    [
        (0.05, 50.0, 120.0, 0.0),
        (0.05, 50.0, 120.0, 1.0),
        (50.0, 0.05, 120.0, 0.0),
        (0.05, 50.0, 60.0, 0.0),
        (0.05, 50.0, 20.0, 0.0),
        (0.05, 50.0, 10.0, 0.0),
        (0.05, 20.0, 120.0, 0.0),
        (5.0, 40.0, 40.0, 0.0),
    ],
)
def test_chirp_excites_up_to_its_frequency(start_hz, stop_hz, duration_s, taper_s):
    """To within the resolution of the shortest window, and half a second of the sweep."""
    excitation = chirp(
        rate_hz=RATE_HZ,
        start_hz=start_hz,
        stop_hz=stop_hz,
        duration_s=duration_s,
        taper_s=taper_s,
    )
    reference = excitation.reference_rad[slice(*excitation.segments["sweep"])]
    length = segmentation_of(reference.size, RATE_HZ).segment_length
    hz_per_s = (stop_hz - start_hz) / duration_s
    inspected = 0
    for end, found in estimates(Sweep(reference, reference, reference), reference.size // 40):
        if found is None or found.is_final:
            continue
        inspected += 1
        now_hz = start_hz + hz_per_s * end / RATE_HZ
        frequency_hz = found.response.frequency_hz
        first_hz, last_hz = frequency_hz[found.is_excited][[0, -1]]
        front_hz, back_hz = (last_hz, first_hz) if hz_per_s > 0 else (first_hz, last_hz)
        lead_hz = (front_hz - now_hz) * np.sign(hz_per_s)
        resolution_hz = RATE_HZ / min(end, length)
        assert lead_hz < resolution_hz, end
        # The fade at the end is not visible before.
        behind_s = 0.5 + (taper_s if end > reference.size - 1000 * taper_s else 0.0)
        assert lead_hz > -resolution_hz - behind_s * abs(hz_per_s), end
        if end >= length and min(start_hz, stop_hz) < now_hz - 1.0:
            assert lead_hz < max(0.2, 0.5 * resolution_hz), end
        assert abs(back_hz - start_hz) < resolution_hz + (0.5 + taper_s) * abs(hz_per_s), end
        # One band, except perhaps for frequencies passed quickly at its lower end.
        within = (frequency_hz > max(first_hz, 0.5)) & (frequency_hz < last_hz)
        assert found.is_excited[within].all(), end
    assert inspected >= 20


def test_a_multisine_has_excited_its_band_from_the_beginning():
    excitation = multisine(rate_hz=RATE_HZ, start_hz=2.0, stop_hz=30.0, duration_s=40.0)
    reference = excitation.reference_rad[slice(*excitation.segments["sweep"])]
    for _, found in estimates(Sweep(reference, reference, reference), 5000):
        excited_hz = found.response.frequency_hz[found.is_excited]
        assert excited_hz.min() == pytest.approx(2.0, abs=0.1)
        assert excited_hz.max() == pytest.approx(30.0, abs=0.1)
        assert excited_hz.size == np.ptp(excited_hz).round(6) * 160 + 1


def test_step_and_hold_have_no_excited_band():
    excitation = step(rate_hz=RATE_HZ, duration_s=20.0)
    stepped = sweep_of_excitation(excitation)
    held = replace(stepped, reference=np.zeros(stepped.reference.size))
    for sweep in (stepped, held):
        seen = [found for _, found in estimates(sweep, 5000) if found is not None]
        assert seen
        for found in seen:
            above = found.response.frequency_hz > 0.25
            assert not found.is_excited[above].any()


@pytest.mark.parametrize("offset_rad", [0.05, -0.3])
def test_excited_band_does_not_depend_on_the_mean_angle(paper, offset_rad):
    there = replace(paper, reference=paper.reference + offset_rad)
    for (_, here), (_, shifted) in zip(
        estimates(paper, 20_000), estimates(there, 20_000), strict=True
    ):
        np.testing.assert_array_equal(here.is_excited, shifted.is_excited)
        np.testing.assert_array_equal(here.response.response, shifted.response.response)


def test_coherence_from_two_whole_segments_on(noisy):
    for end, found in estimates(noisy, 8000):
        whole = (end - 2590) // (17_266 - 2590)
        assert (found.response.coherence is not None) == (whole >= 2)
        if whole >= 2:
            beyond = found.response.frequency_hz > 55.0
            passed = found.is_excited & (found.response.frequency_hz > 5.0)
            assert np.median(found.response.coherence[passed]) > 0.99
            assert np.median(found.response.coherence[beyond]) < 0.9


def small_record(samples=3000, seed=3):
    rng = np.random.default_rng(seed)
    x, noise = rng.normal(size=(2, samples))
    y = np.convolve(x, [0.2, 0.5, -0.4])[:samples] + 0.3 * noise
    return np.stack((x, x, y))


def small(samples=3000):
    return RunningResponse(200.0, samples, last_hz=80.0, segmentation=SMALL)


def small_welch(record):
    return welch_response(record[1], record[2], 200.0, segment_length=400, overlap=60, nfft=1000)


@given(data=st.data())
def test_estimate_does_not_depend_on_blocks(data):
    record = small_record()
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    ticks = np.arange(3000)
    missing = rng.random(3000) < data.draw(st.sampled_from([0.0, 0.01]))
    hole = data.draw(st.integers(0, 3000))
    missing[hole : hole + data.draw(st.integers(0, 200))] = True
    ticks, record = ticks[~missing], record[:, ~missing]
    until = data.draw(st.integers(0, ticks.size))
    edges = sorted(data.draw(st.lists(st.integers(0, until), max_size=10)))
    at_once, in_blocks = small(), small()
    at_once.feed(ticks[:until], *record[:, :until])
    for start, stop in zip([0, *edges], [*edges, until], strict=True):
        in_blocks.feed(ticks[start:stop], *record[:, start:stop])
        in_blocks.estimate()  # looking changes nothing
    one, other = at_once.estimate(), in_blocks.estimate()
    assert (one is None) == (other is None)
    if one is not None:
        np.testing.assert_array_equal(one.response.response, other.response.response)
        np.testing.assert_array_equal(one.is_excited, other.is_excited)
        assert (one.is_final, one.response.segments) == (other.is_final, other.response.segments)
        assert (one.response.coherence is None) == (other.response.coherence is None)


@pytest.mark.parametrize("first", [0, -300])
def test_short_gaps_are_interpolated_as_analyze_does(first):
    """With or without samples before and after the record."""
    ticks = np.arange(first, 3000 - first)
    record = small_record(ticks.size)
    missing = np.random.default_rng(8).random(ticks.size) < 0.05
    missing[700 : 700 + SMALL_GAP] = True
    missing[[699, 700 + SMALL_GAP, -1]] = False
    missing[(ticks > -4) & (ticks < 3)] = True
    missing[(ticks > 2990) & (ticks < 2999)] = True
    missing[ticks == 2999] = first < 0
    running = small()
    running.feed(ticks[~missing], *record[:, ~missing])
    filled = [np.interp(ticks, ticks[~missing], channel[~missing]) for channel in record]
    found = running.estimate()
    assert found.is_final
    assert_equals_welch(found, small_welch(np.stack(filled)[:, -first : 3000 - first]))


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_missing(unknown):
    record = small_record()
    spoilt = record.copy()
    for channel, tick in enumerate((900, 1200, 1500)):
        spoilt[channel, tick] = unknown
        record[:, tick] = (record[:, tick - 1] + record[:, tick + 1]) / 2
    running = small()
    running.feed(np.arange(3000), *spoilt)
    assert_equals_welch(running.estimate(), small_welch(record))


def test_segments_with_a_long_gap_are_left_out():
    record, ticks = small_record(), np.arange(3000)
    # In the first segment before the second begins: all the others remain.
    known = (ticks < 300) | (ticks >= 300 + SMALL_GAP + 1)
    running = small()
    running.feed(ticks[known], *record[:, known])
    assert_equals_welch(running.estimate(), small_welch(record[:, 340:]))
    # As if the looking on had begun in mid-sweep.
    running = small()
    running.feed(ticks[700:], *record[:, 700:])
    assert_equals_welch(running.estimate(), small_welch(record[:, 1020:]))


def test_long_enough_part_after_a_gap_counts():
    record, ticks = small_record(), np.arange(3000)
    known = (ticks < 900) | (ticks >= 1000)
    seen = []
    for until in (899, 1099, 1100):
        running = small()
        fed = known & (ticks < until)
        running.feed(ticks[fed], *record[:, fed])
        seen.append(running.estimate().response.segments)
    assert seen == [3, 2, 3]


def test_trailing_gap_is_closed_by_later_samples():
    record, ticks = small_record(3300), np.arange(3300)
    known = (ticks < 2900) | (ticks >= 3100)
    running = small()
    running.feed(ticks[:2900], *record[:, :2900])
    assert not running.estimate().is_final
    running.feed(ticks[known][2900:], *record[:, known][:, 2900:])
    found = running.estimate()
    assert found.is_final
    assert_equals_welch(found, small_welch(record[:, :2900]))


def test_no_estimate_from_too_few_samples():
    record = small_record()
    running = small()
    assert running.estimate() is None
    running.feed([], [], [], [])
    running.feed(np.arange(99), *record[:, :99])
    assert running.estimate() is None
    running.feed([99], *record[:, 99:100])
    found = running.estimate()
    assert (found.response.segments, found.response.coherence, found.is_final) == (1, None, False)
    assert found.is_excited.all()


def test_memory_does_not_grow_with_the_record():
    record = small_record(1000)
    running = small(10**6)
    tracemalloc.start()
    for k in range(300):
        running.feed(np.arange(1000 * k, 1000 * (k + 1)), *record)
        if k == 100:
            before, _ = tracemalloc.get_traced_memory()
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 20_000


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        (Segmentation(1, 0, 100), "at least 2"),
        (Segmentation(100, 100, 100), "overlap"),
        (Segmentation(100, 10, 99), "nfft = 99"),
    ],
)
def test_invalid_settings_are_refused(segmentation, message):
    with pytest.raises(SpectralError, match=message):
        RunningResponse(RATE_HZ, 1000, last_hz=LAST_HZ, segmentation=segmentation)
