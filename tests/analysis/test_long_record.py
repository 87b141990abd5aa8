"""A long record is decimated while it is read, and an analysis of it finds the same."""

from dataclasses import replace

import numpy as np
import pytest

from analysis import api
from analysis.decimation import Decimation
from analysis.exchange import export_record
from analysis.identify import BAND_HZ, Measurement, fit_freest_alone
from analysis.record import RecordError, load_record, record_of
from rigd.session import read_session
from rigd.session.layout import Status
from rigd.testing import chirp_signals

LONGEST = 100_000
FACTOR, REACH = 8, 33
"""Decimation from 1000 Hz for a band of 50 Hz, and half the length of its filter in samples."""


@pytest.fixture(scope="module")
def decimated(paper_file):
    return load_record(paper_file, longest_samples=LONGEST)


def test_result_does_not_depend_on_blocks(paper_file, decimated):
    whole = load_record(paper_file)
    decimation = Decimation.to_band(1000.0, 50.0, 2.5)
    assert (decimation.downsampling_factor, decimation.half_length_samples) == (FACTOR, REACH)
    inside = decimation.samples_inside_record(whole.time_s.size)
    for name in ("reference_rad", "angle_rad", "torque_nm"):
        expected = decimation.apply(getattr(whole, name))[inside]
        values = getattr(decimated, name)
        np.testing.assert_allclose(values, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert decimated.rate_hz == 125.0
    np.testing.assert_array_equal(
        decimated.time_s, whole.time_s[FACTOR * REACH : -FACTOR * REACH : FACTOR]
    )
    assert decimated.time_s[decimated.sweep][0] == pytest.approx(1.0, abs=0.008)
    assert decimated.rest_angle_rad == whole.rest_angle_rad
    full_rate = decimated.full_rate
    assert (full_rate.rate_hz, full_rate.samples, full_rate.sweep) == (
        whole.rate_hz, whole.time_s.size, whole.sweep,
    )  # fmt: skip


@pytest.mark.parametrize("part_s", [(40.0, 100.0), (None, 60.0), (60.0, None)])
def test_part_of_a_long_file_is_that_of_the_whole(paper_file, part_s):
    """Only its chunks, and those of the rest, are read from a long file."""
    expected = record_of(read_session(paper_file), part_s, longest_samples=20_000)
    found = load_record(paper_file, part_s, longest_samples=20_000)
    for name in ("time_s", "reference_rad", "angle_rad", "torque_nm", "torque_known"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=0, atol=1e-15
        )
    for name in ("rate_hz", "sweep", "rest_angle_rad", "gaps", "part_s", "swept_hz", "warnings"):
        assert getattr(found, name) == getattr(expected, name)


@pytest.mark.parametrize("time_of", ["stalls", "is shifted"])
def test_part_is_whole_if_its_time_stamps_are_wrong(tmp_path, write_session, make_signals, time_of):
    """The chunks of a part are found by their times, and its samples by their ticks."""
    signals = make_signals(sweep_s=60.0)
    t_ns = np.arange(len(signals.angle_rad)) * 1_000_000
    if time_of == "stalls":  # for 20 s, and then goes on
        t_ns = np.maximum(np.minimum(t_ns, 10_000_000_000), t_ns - 20_000_000_000)
    else:
        t_ns = t_ns + 15_000_000_000
    path = write_session(tmp_path / "a.mcap", signals, t_ns=t_ns)
    table = export_record(path, tmp_path / "a.csv", part_s=(40.0, 60.0))
    assert table.columns[0].values.tolist() == list(range(40_000, 60_000))


@pytest.mark.parametrize(
    ("part_s", "words"),
    [
        ((60.0, 140.0), "beyond the record, which covers 0 to 136 s"),
        ((137.0, None), "beyond the record, which covers 0 to 136 s"),
        ((135.0, 136.0), "from 135 to 136 s contains nothing of the sweep"),
    ],
)
def test_unusable_part_of_a_long_file_is_refused(paper_file, part_s, words):
    with pytest.raises(RecordError, match=words):
        load_record(paper_file, part_s, longest_samples=20_000)


def test_short_record_is_not_decimated(paper_file):
    whole, twice_read = (
        load_record(paper_file, longest_samples=longest) for longest in (10**9, 140_000)
    )
    assert whole.decimated_from is None is twice_read.decimated_from
    for name in ("time_s", "reference_rad", "angle_rad", "torque_nm", "torque_known"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(twice_read, name))


@pytest.mark.fit
@pytest.mark.further  # of a record that is equal, as tested above
def test_decimated_record_has_the_same_modes(paper_file, decimated):
    """Both fits are to the same time: 0.26 s at either end are inside no filter window."""
    ends_s = decimated.time_s[0], decimated.time_s[-1] + 1e-3
    whole, shorter = (
        api.fit(record, ["VI"]).fits[0].modes
        for record in (load_record(paper_file, ends_s), decimated)
    )
    assert len(whole) == len(shorter) == 3
    for expected, found in zip(whole, shorter, strict=True):
        for value, std in (
            ("frequency_hz", "frequency_std_hz"),
            ("damping_ratio", "damping_ratio_std"),
        ):
            expected_std = getattr(expected, std)
            assert abs(getattr(found, value) - getattr(expected, value)) < 0.1 * expected_std
            assert getattr(found, std) == pytest.approx(expected_std, rel=0.1)


def test_short_gaps_are_interpolated_and_long_ones_widened(
    paper_file, paper_signals, write_session, tmp_path, decimated
):
    status = np.zeros(paper_signals.angle_rad.size, int)
    status[40_000:40_004] = Status.ANGLE_STALE | Status.WRENCH_STALE
    status[70_000:70_030] = Status.WRENCH_SATURATED
    status[90_000:90_050] = Status.ANGLE_STALE
    path = write_session(tmp_path / "gaps.mcap", paper_signals, status=status)
    record = load_record(path, longest_samples=LONGEST)
    assert (record.gaps.sweep_stale_angles, record.gaps.sweep_stale_torques) == (54, 4)
    assert record.flags == {"wrench saturated": 30, "angle stale": 54, "wrench stale": 4}

    def samples_near(first, end):
        ticks = np.round(1000 * record.time_s)
        return (ticks >= first - FACTOR * REACH) & (ticks < end + FACTOR * REACH)

    unknown = samples_near(70_000, 70_030) | samples_near(90_000, 90_050)
    np.testing.assert_array_equal(~record.torque_known, unknown)
    (gap,) = Measurement.from_record(record).long_gaps(50.0)
    assert gap[0] * FACTOR == pytest.approx(90_000 - FACTOR * REACH, abs=FACTOR)
    short = samples_near(40_000, 40_004)
    assert record.torque_known[short].all()
    for name in ("angle_rad", "torque_nm"):
        expected, found = getattr(decimated, name), getattr(record, name)
        error = np.abs(found - expected)
        assert error[~unknown & ~short].max() < 1e-12
        assert 0 < error[short].max() < 0.01 * np.abs(expected).max()


def test_clipping_is_found_in_all_samples(
    paper_file, paper_signals, write_session, tmp_path, decimated
):
    most_nm = 0.9 * np.abs(paper_signals.torque_nm).max()
    torque_nm = np.clip(paper_signals.torque_nm, -most_nm, None)
    at_limit = torque_nm == -most_nm
    path = write_session(tmp_path / "clipped.mcap", replace(paper_signals, torque_nm=torque_nm))
    largest, smallest = load_record(path, longest_samples=LONGEST).torque_extremes
    assert (smallest.limit_nm, smallest.sample_count) == (-most_nm, np.count_nonzero(at_limit))
    neighbours = np.roll(at_limit, 1) | np.roll(at_limit, -1)
    assert smallest.repeated_count == np.count_nonzero(at_limit & neighbours) >= 4
    assert (largest.limit_nm, largest.sample_count) == (torque_nm.max(), 1)
    levels_nm, counts = np.unique(torque_nm, return_counts=True)
    assert smallest.inner_counts == tuple(counts[1:3])
    assert largest.inner_counts == tuple(counts[-2:-4:-1])
    assert levels_nm[0] == smallest.limit_nm
    assert decimated.torque_extremes[1].sample_count == 1
    assert load_record(paper_file).torque_extremes == ()
    measurement = Measurement.from_record(load_record(path, longest_samples=LONGEST))
    assert measurement.torque_extremes == (largest, smallest)


def test_record_too_long_for_memory_names_remedies(paper_file, monkeypatch):
    monkeypatch.setattr("analysis.signal_decimation.MAX_DECIMATED_SAMPLES", 16_000)
    with pytest.raises(RecordError, match=r"16\d\d\d samples.*--from, --to\) or lower --band"):
        load_record(paper_file, longest_samples=LONGEST)
    assert load_record(paper_file, highest_hz=20.0, longest_samples=LONGEST).rate_hz == 50.0
    part = load_record(paper_file, (1.0, 90.0), longest_samples=LONGEST)
    assert (part.rate_hz, part.part_s) == (1000.0, (1.0, 90.0))


def test_constant_torque_is_no_sensor_data(paper_signals, write_session, tmp_path):
    silent = replace(paper_signals, torque_nm=np.full_like(paper_signals.torque_nm, 0.25))
    path = write_session(tmp_path / "silent.mcap", silent)
    with pytest.raises(RecordError, match="delivered no data"):
        load_record(path, longest_samples=LONGEST)


@pytest.mark.fit
def test_fit_in_blocks_of_bins_agrees(monkeypatch, write_session, tmp_path):
    path = write_session(tmp_path / "a.mcap", chirp_signals(sweep_s=8.0))
    measurement = Measurement.from_record(load_record(path))
    whole = fit_freest_alone(measurement, BAND_HZ)[0]
    for module, name, most in (
        ("_comparison", "MAX_BINS_OF_STORED_RESULTS", 300),
        ("_modal_problem", "MAX_BINS_OF_STORED_RESULTS", 300),
        ("_modal_problem", "_COLUMNS_PER_BLOCK", 500),
    ):
        monkeypatch.setattr(f"analysis.identify.{module}.{name}", most)
    in_blocks = fit_freest_alone(measurement, BAND_HZ)[0]
    assert len(whole.modes) == 3
    for expected, found in zip(whole.modes, in_blocks.modes, strict=True):
        for name in ("frequency_hz", "damping_ratio"):
            value, other = getattr(expected, name), getattr(found, name)
            assert other.value == pytest.approx(value.value, abs=0.01 * value.std)
            assert other.std == pytest.approx(value.std, rel=0.01)
