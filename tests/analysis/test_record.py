from dataclasses import replace

import numpy as np
import pytest
from cases import further
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from analysis.identify import Measurement
from analysis.record import MAX_UNKNOWN_FRACTION, RecordError, load_record
from rigd.session import SessionError
from rigd.session.layout import Status


def test_arrays_units_and_segments_are_read(tmp_path, write_session, short_signals):
    path = write_session(
        tmp_path / "a.mcap", short_signals,
        metadata={"angle_delay_s": "0.001", "torque_delay_s": "-2e-4",
                  "tool_inertia_kg_m2": "1e-5", "uncertainty_torque_scale_percent": "0.5",
                  "uncertainty_length_percent": "0"},
    )  # fmt: skip
    record = load_record(path)
    np.testing.assert_array_equal(record.angle_rad, short_signals.angle_rad)
    np.testing.assert_array_equal(record.reference_rad, short_signals.reference_rad)
    np.testing.assert_array_equal(record.torque_nm, short_signals.torque_nm)
    np.testing.assert_allclose(record.time_s, np.arange(5000) / 1000, rtol=1e-15)
    assert record.beam.length_m == 0.98
    assert record.beam.bending_stiffness_n_m2 == pytest.approx(0.0902750)
    assert (record.angle_delay_s, record.torque_delay_s) == (0.001, -2e-4)
    assert record.tool_inertia_kg_m2 == 1e-5
    assert record.uncertainty == {"torque_scale": 0.005}
    assert record.sweep == slice(500, 4500)
    assert record.sweep_samples == 4000
    assert record.rest_angle_rad == np.median(short_signals.angle_rad[:500])
    assert record.outcome == "complete"
    assert record.warnings == ()
    assert record.flags == {}


def test_record_without_segments_is_all_sweep(tmp_path, write_session, short_signals):
    record = load_record(write_session(tmp_path / "a.mcap", short_signals, segments={}))
    assert record.sweep == slice(0, 5000)
    assert record.rest_angle_rad is None


def test_missing_ticks_are_interpolated_and_counted(tmp_path, write_session, short_signals):
    present = np.ones(5000, bool)
    present[[1000, 2000, 2001, 2002, 4800]] = False  # the last one after the sweep
    ticks = np.flatnonzero(present)
    path = write_session(tmp_path / "a.mcap", short_signals.part(present), ticks=ticks)
    record = load_record(path)
    assert len(record.angle_rad) == 5000
    assert record.gaps.missing_ticks == 5
    assert record.gaps.longest_gap_ticks == 3
    assert record.gaps.sweep_missing_ticks == 4
    np.testing.assert_array_equal(record.angle_rad[present], short_signals.angle_rad[present])
    before, after = short_signals.torque_nm[1999], short_signals.torque_nm[2003]
    np.testing.assert_allclose(
        record.torque_nm[2000:2003], before + (after - before) * np.array([1, 2, 3]) / 4
    )
    assert any("4 missing ticks" in warning for warning in record.warnings)
    np.testing.assert_array_equal(record.angle_known, present)
    np.testing.assert_array_equal(record.torque_known, present)


def test_stale_values_are_interpolated_in_their_channel_only(
    tmp_path, write_session, short_signals
):
    status = np.zeros(5000, int)
    status[3000] = Status.ANGLE_STALE
    status[3100:3102] = Status.WRENCH_STALE
    angle, torque = short_signals.angle_rad.copy(), short_signals.torque_nm.copy()
    angle[3000], torque[3100:3102] = 9.0, 9.0
    held = replace(short_signals, angle_rad=angle, torque_nm=torque)
    record = load_record(write_session(tmp_path / "a.mcap", held, status=status))
    assert record.gaps.sweep_stale_angles == 1
    assert record.gaps.sweep_stale_torques == 2
    assert record.angle_rad[3000] == pytest.approx((angle[2999] + angle[3001]) / 2)
    assert record.torque_nm[3000] == torque[3000]
    assert record.torque_nm.max() < 1.0
    assert record.flags == {"angle stale": 1, "wrench stale": 2}
    assert np.flatnonzero(~record.angle_known).tolist() == [3000]
    assert np.flatnonzero(~record.torque_known).tolist() == [3100, 3101]


def test_flags_in_the_sweep_are_counted_and_warned_of(tmp_path, write_session, short_signals):
    status = np.zeros(5000, int)
    status[:10] = Status.TORQUE_OFF  # before the sweep: without effect
    status[600:603] = Status.WRENCH_SATURATED | Status.LATE
    record = load_record(write_session(tmp_path / "a.mcap", short_signals, status=status))
    assert record.flags == {"wrench saturated": 3, "late tick": 3}
    assert any("clipped" in warning for warning in record.warnings)
    assert record.angle_known.all()
    assert np.flatnonzero(~record.torque_known).tolist() == [600, 601, 602]


def test_stopped_sweep_is_cut_to_its_recorded_part(tmp_path, write_session, short_signals):
    present = np.arange(5000) < 3000
    path = write_session(tmp_path / "a.mcap", short_signals.part(present), outcome="stopped")
    record = load_record(path)
    assert record.sweep == slice(500, 3000)
    assert record.outcome == "stopped"
    assert any("1.5 s were not" in warning for warning in record.warnings)


def test_a_session_stopped_before_its_sweep_is_refused(tmp_path, write_session, short_signals):
    present = np.arange(5000) < 400
    path = write_session(tmp_path / "a.mcap", short_signals.part(present))
    with pytest.raises(RecordError, match=r"a\.mcap.*'sweep'.*500.*399"):
        load_record(path)


def test_too_many_missing_ticks_are_refused(tmp_path, write_session, short_signals):
    present = np.ones(5000, bool)
    present[1000:3000:10] = False  # 200 of 4000, 5 %: as much as there may be
    path = write_session(
        tmp_path / "most.mcap", short_signals.part(present), ticks=np.flatnonzero(present)
    )
    assert load_record(path).gaps.sweep_missing_ticks == 200
    present[3001] = False
    path = write_session(
        tmp_path / "a.mcap", short_signals.part(present), ticks=np.flatnonzero(present)
    )
    with pytest.raises(RecordError, match=r"201 of 4000 .* angle .* 5 %"):
        load_record(path)


def test_a_long_gap_is_refused_even_if_few_ticks_are_missing(tmp_path, write_session, signals_of):
    n = 40_000
    wave = 0.01 * np.sin(np.arange(n) / 100)
    present = np.ones(n, bool)
    present[10_000:10_101] = False
    signals = signals_of(wave, wave, wave, {}).part(present)
    path = write_session(tmp_path / "a.mcap", signals, ticks=np.flatnonzero(present))
    assert 101 / n < MAX_UNKNOWN_FRACTION
    with pytest.raises(RecordError, match=r"101 ticks .* from tick 10000 .*100 ms"):
        load_record(path)


@pytest.mark.parametrize(
    ("field", "name"),
    [("angle_rad", "angle_rad"), ("torque_nm", "coupling_torque_nm"),
     ("reference_rad", "angle_reference_rad")],
)  # fmt: skip
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nonfinite_values_are_refused_by_field_and_tick(
    tmp_path, write_session, short_signals, field, name, value
):
    values = getattr(short_signals, field).copy()
    values[[1234, 2000]] = value
    path = write_session(tmp_path / "a.mcap", replace(short_signals, **{field: values}))
    with pytest.raises(RecordError, match=rf"a\.mcap: {name} .* tick 1234 .* 2 of 5000"):
        load_record(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [("rate_hz", "0"), further("rate_hz", "-1000"), ("beam_length_m", "0"),
     ("beam_density_kg_per_m", "-1"), ("tool_inertia_kg_m2", "-1e-5"), ("rate_hz", "nan"),
     ("beam_bending_stiffness_n_m2", "stiff"), ("beam_length_m", "1e300"),
     ("beam_length_m", "980"), ("beam_length_m", "0.01"), ("beam_density_kg_per_m", "1e300"),
     ("beam_bending_stiffness_n_m2", "1e-300"), ("beam_bending_stiffness_n_m2", "1e300"),
     ("torque_delay_s", "300"), ("angle_delay_s", "-1e300"), ("tool_inertia_kg_m2", "1e300"),
     ("uncertainty_length_percent", "-1"), ("uncertainty_density_percent", "80"),
     ("uniformity_percent", "-0.1"), ("uniformity_percent", "11"), ("uniformity_percent", "nan"),
     ("tip_mass_kg", "-1e-3"), ("tip_mass_kg", "heavy"), ("axis_tilt_deg", "-91"),
     ("axis_tilt_deg", "inf"), ("uncertainty_tip_mass_percent", "51")],
)  # fmt: skip
def test_absurd_metadata_is_refused_by_key(tmp_path, write_session, short_signals, key, value):
    path = write_session(tmp_path / "a.mcap", short_signals, metadata={key: value})
    with pytest.raises((RecordError, SessionError), match=key):
        load_record(path)


@pytest.mark.parametrize(
    ("metadata", "uniformity"),
    [({}, 1e-3), ({"uniformity_percent": "0"}, 0.0), ({"uniformity_percent": "0.3"}, 3e-3)],
)
def test_uniformity_is_read_from_the_file(
    tmp_path, write_session, short_signals, metadata, uniformity
):
    path = write_session(tmp_path / "a.mcap", short_signals, metadata=metadata)
    record = load_record(path)
    assert (record.uniformity, Measurement.from_record(record).uniformity) == (
        uniformity,
        uniformity,
    )


def test_unstated_tip_mass_and_tilt_are_unknown(tmp_path, write_session, short_signals):
    def of(**stated):
        path = write_session(tmp_path / f"{len(stated)}.mcap", short_signals, metadata=stated)
        record = load_record(path)
        measurement = Measurement.from_record(record)
        values = record.tip_mass_kg, record.axis_tilt_deg
        assert (measurement.tip_mass_kg, measurement.axis_tilt_deg) == values
        return (*values, record.uncertainty)

    assert of() == (None, None, {})
    stated = {"tip_mass_kg": "0", "axis_tilt_deg": "-0.4", "uncertainty_tip_mass_percent": "2"}
    assert of(**stated) == (0.0, -0.4, {"tip_mass": 0.02})


def test_wrong_beam_units_are_found_by_the_first_mode(tmp_path, write_session, short_signals):
    """Millimetres for metres: 2.55 Hz a million times lower."""
    path = write_session(tmp_path / "a.mcap", short_signals, metadata={"beam_length_m": "980"})
    with pytest.raises(RecordError, match=r"the first mode would be at 2\.55e-06 Hz, which 5 s"):
        load_record(path)


@pytest.mark.parametrize("value", [0.0, 1.5])
def test_sensor_without_data_is_reported(tmp_path, write_session, short_signals, value):
    dead = replace(short_signals, torque_nm=np.full(5000, value))
    path = write_session(tmp_path / "a.mcap", dead)
    with pytest.raises(RecordError, match=rf"is {value:g} N·m in every sample, so the sensor"):
        load_record(path)


@pytest.mark.parametrize("value", [1e200, -1e10])
def test_impossible_values_are_refused(tmp_path, write_session, short_signals, value):
    values = short_signals.torque_nm.copy()
    values[[1234, 2000]] = value
    path = write_session(tmp_path / "a.mcap", replace(short_signals, torque_nm=values))
    with pytest.raises(RecordError, match=r"coupling_torque_nm .* tick 1234 .* 2 of 5000"):
        load_record(path)


def test_rate_that_contradicts_time_stamps_is_refused(tmp_path, write_session, short_signals):
    path = write_session(tmp_path / "a.mcap", short_signals, metadata={"rate_hz": "500"})
    with pytest.raises(RecordError, match=r"500 Hz.*1000 ticks per second"):
        load_record(path)


def test_almost_empty_span_is_refused(tmp_path, write_session, short_signals):
    """Its grid would take tens of gigabytes."""
    two = short_signals.part(slice(2))
    path = write_session(tmp_path / "a.mcap", two, ticks=[0, 2**32 - 1], segments={})
    with pytest.raises(RecordError, match=r"a\.mcap: only 2 of the 4294967296 ticks"):
        load_record(path)


def test_ticks_out_of_order_are_refused(tmp_path, write_session, short_signals):
    ticks = np.arange(5000)
    ticks[2000] = 1999
    path = write_session(tmp_path / "a.mcap", short_signals, ticks=ticks)
    with pytest.raises(SessionError, match="1999"):
        load_record(path)


def test_a_session_without_samples_is_refused(tmp_path, write_session, short_signals):
    path = write_session(tmp_path / "a.mcap", short_signals.part(slice(0, 0)))
    with pytest.raises((RecordError, SessionError), match=r"a\.mcap"):
        load_record(path)


@settings(
    max_examples=20,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(missing=st.sets(st.integers(1, 3998), max_size=30))
def test_line_with_missing_ticks_is_recovered(tmp_path_factory, write_session, signals_of, missing):
    n = 4000
    line = 1e-3 * np.arange(n)
    present = np.ones(n, bool)
    present[list(missing)] = False
    signals = signals_of(line, line, -line, {}).part(present)
    folder = tmp_path_factory.mktemp("gaps")
    record = load_record(write_session(folder / "a.mcap", signals, ticks=np.flatnonzero(present)))
    # A straight line is its own interpolation.
    np.testing.assert_allclose(record.angle_rad, line, atol=1e-12)
    np.testing.assert_allclose(record.torque_nm, -line, atol=1e-12)
    assert record.gaps.missing_ticks == len(missing)


# Parts of a session


def test_a_part_has_the_samples_segments_and_counts_of_its_time(
    tmp_path, write_session, make_signals
):
    signals = make_signals(sweep_s=16.0, rest_s=0.5, ring_down_s=0.5)
    present = np.ones(17_000, bool)
    present[[1000, 9000]] = False
    path = write_session(
        tmp_path / "a.mcap", signals.part(present), ticks=np.flatnonzero(present),
        metadata={"start_hz": "0", "stop_hz": "32"},
    )  # fmt: skip
    whole = load_record(path)
    assert (whole.part_s, whole.part_json, whole.swept_hz) == (None, None, None)
    part = load_record(path, (4.5, 12.5))
    assert part.part_json == {"from_s": 4.5, "to_s": 12.5}
    assert (part.time_s[0], part.time_s.size) == (4.5, 8000)
    np.testing.assert_array_equal(part.torque_nm, whole.torque_nm[4500:12_500])
    # Angles count from the angle that was held before the sweep, which the part does not show.
    np.testing.assert_allclose(
        part.angle_rad, whole.angle_rad[4500:12_500] - whole.rest_angle_rad, atol=1e-15
    )
    assert part.rest_angle_rad is None
    assert (part.sweep, part.sweep_samples) == (slice(0, 8000), 8000)
    assert part.swept_hz == pytest.approx((8.0, 24.0), abs=0.01)
    assert part.gaps.missing_ticks == 1
    assert not any("cut short" in each for each in part.warnings)


@pytest.mark.parametrize("kind", ["multisine", "until", "of a package"])
def test_a_part_of_another_excitation_than_a_sweep_has_its_whole_band(
    tmp_path, write_session, short_signals, kind
):
    metadata = {"excitation": kind, "start_hz": "0.5", "stop_hz": "32"}
    path = write_session(tmp_path / "a.mcap", short_signals, metadata=metadata)
    part = load_record(path, (None, 4.4))
    assert (part.swept_hz, part.excited_hz) == (None, (0.5, 32.0))


def test_a_part_with_the_rest_begins_from_it(tmp_path, write_session, short_signals):
    path = write_session(tmp_path / "a.mcap", short_signals)
    whole, part = load_record(path), load_record(path, (None, 4.4))
    assert part.part_s == (0.0, 4.4)
    assert part.rest_angle_rad == whole.rest_angle_rad
    np.testing.assert_array_equal(part.angle_rad, whole.angle_rad[:4400])
    assert part.sweep == slice(500, 4400)


@pytest.mark.parametrize(
    ("part_s", "words"),
    [
        ((1.0, 5.5), ("beyond the record", "0 to 5 s")),
        ((4.6, None), ("nothing of the sweep", "0.5 to 4.5 s")),
        ((1.0, 1.5), ("too short", "10 periods of the first mode")),
        ((4.0, 2.0), ("is empty", "--from must be less than --to")),
        ((6.0, None), ("beyond the record", "0 to 5 s")),
    ],
)
def test_unusable_part_is_refused(tmp_path, write_session, short_signals, part_s, words):
    path = write_session(tmp_path / "a.mcap", short_signals)
    with pytest.raises(RecordError) as refusal:
        load_record(path, part_s)
    assert all(word in str(refusal.value) for word in (str(path), *words))
