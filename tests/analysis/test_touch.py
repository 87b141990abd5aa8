"""Touches of recorded sessions, against the truth of an independent simulation."""

from dataclasses import replace
from math import atan2

import numpy as np
import pytest
from cases import further

from analysis.record import RecordError
from analysis.touch import TouchAnalysis
from analysis.touch import _sensor_filter as sensor_filter_of
from rigd.identified_beam import IdentifiedBeamError
from rigd.profile import load_profile
from rigd.runner._touch_search import _sensor_filter
from rigd.session import SessionError, read_session


def test_a_marked_touch_is_estimated(touched, touch_file):
    (touch,) = touched.touches
    found, truth = touch.estimate, touch_file.obstacle
    assert (touched.detection_source, touched.has_shear, touched.warnings) == ("loop", True, ())
    assert found.kind == "rigid"
    assert found.x_m.value == pytest.approx(truth.x_m, abs=4e-3)
    assert touch.start_s + found.time_s.value == pytest.approx(touch_file.time_s, abs=5e-4)
    assert found.force_n.value == pytest.approx(touch_file.peak_n, rel=0.2)
    low, high = found.stiffness_n_per_m.interval_95
    assert 0.6 * low < truth.stiffness_n_per_m < 1.6 * high


def test_map_shows_touch_at_the_obstacle(touched, touch_file):
    (touch,) = touched.touches
    # The obstacle is met by the straight antenna at this angle; the bent one is ahead or behind.
    assert atan2(*touch.contact_point_m[::-1]) == pytest.approx(
        touch_file.obstacle.angle_rad, abs=3e-3
    )
    assert np.hypot(*touch.contact_point_m) == pytest.approx(touch_file.obstacle.x_m, abs=4e-3)
    inner, outer = np.hypot(*touch.interval_ends_m.T)
    assert inner < np.hypot(*touch.contact_point_m) < outer
    assert touch.antenna_points_m[0] == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("metadata", [{}, further({"shear_projection": "0,0,0,0,0,0"})])
def test_unmarked_touch_is_found(touch_file, touch_analysis, tmp_path, metadata):
    path = touch_file.write(tmp_path / "a.mcap", marked=False, metadata=metadata)
    session = touch_analysis.analyse_session(path)
    (touch,) = session.touches
    assert (session.detection_source, session.has_shear) == ("record", not metadata)
    assert 0 < touch.tick - 1000 * touch_file.time_s < 40


def test_nothing_is_found_before_the_touch(touch_file, touch_analysis, tmp_path):
    length = round(1000 * touch_file.time_s) - 1
    path = touch_file.write(tmp_path / "a.mcap", marked=False, length=length)
    session = touch_analysis.analyse_session(path)
    assert (session.detection_source, session.touches) == ("record", ())


def test_missed_ticks_are_bridged(touch_file, touch_analysis, touched, tmp_path):
    first = round(1000 * touch_file.time_s)
    gap = {first - 200, first - 199, first + 20}
    session = touch_analysis.analyse_session(touch_file.write(tmp_path / "a.mcap", gap=gap))
    x_m = session.touches[0].estimate.x_m.value
    assert x_m == pytest.approx(touched.touches[0].estimate.x_m.value, abs=5e-3)


def test_touch_at_the_end_is_not_estimated(touch_file, touch_analysis, tmp_path):
    length = round(1000 * touch_file.time_s) + 10
    session = touch_analysis.analyse_session(touch_file.write(tmp_path / "a.mcap", length=length))
    (touch,) = session.touches
    assert (touch.estimate, touch.contact_point_m) == (None, None)
    assert "Touch 1: not estimated, because that requires 0.3 s" in session.warnings[0]
    assert set(touch.as_dict()) >= {"number", "tick", "angle_rad"}


def test_missing_shear_is_reported(touch_file, touch_analysis, tmp_path):
    path = touch_file.write(
        tmp_path / "a.mcap", marked=False, length=1000, metadata={"shear_projection": "0,0,0,0,0,0"}
    )
    session = touch_analysis.analyse_session(path)
    assert not session.has_shear
    assert "from the torque alone" in session.warnings[0]


@pytest.mark.parametrize("text", ["0,1,0", "a,b,c,d,e,f", "nan,1,0,0,0,0"])
def test_a_wrong_projection_is_named(touch_file, touch_analysis, tmp_path, text):
    path = touch_file.write(tmp_path / "a.mcap", metadata={"shear_projection": text})
    with pytest.raises(RecordError, match=r"a\.mcap: shear_projection is .*must be six numbers"):
        touch_analysis.analyse_session(path)


@pytest.mark.parametrize("profile", ["antenna_serial", "sim"])
@pytest.mark.parametrize("kind", ["mean", "triangle"])
def test_sensor_filters_come_from_the_profile(profile, kind, touch_file, tmp_path):
    rig = load_profile(profile).rig
    sensor = replace(rig.sensor, filter_hz=200.0, filter_order=2)
    serial, metadata = rig.ati_serial, {"torque_filter_hz": "200.0", "torque_filter_order": "2"}
    if serial is not None:
        serial = replace(serial, filter=kind)
        metadata |= {
            "sensor_filter": kind,
            "sensor_filter_delay_s": repr(serial.filter_delay_s(rig.rate_hz)),
        }
    stated = _sensor_filter(replace(rig, sensor=sensor, ati_serial=serial))
    if serial is not None:
        assert stated.weights == pytest.approx(serial.filter_weights(rig.rate_hz), rel=1e-12)
    path = touch_file.write(tmp_path / "a.mcap", length=20, metadata=metadata)
    read = sensor_filter_of(read_session(path), rig.rate_hz)
    s = 2j * np.pi * np.array([1.0, 100.0, 400.0])
    assert read.response(s) == pytest.approx(stated.response(s), rel=1e-9)
    assert read.weights_delay_s == pytest.approx(stated.weights_delay_s)
    assert (read.corner_hz, read.order) == (pytest.approx(200.0), 2)


@pytest.mark.parametrize(("kind", "delay_s"), [("mean", "6e-4"), ("boxcar", "1e-4")])
def test_an_unknown_filter_is_named(touch_file, touch_analysis, tmp_path, kind, delay_s):
    metadata = {"sensor_filter": kind, "sensor_filter_delay_s": delay_s}
    path = touch_file.write(tmp_path / "a.mcap", metadata=metadata)
    with pytest.raises(RecordError, match=r"a\.mcap: sensor_filter is .*must be a mean"):
        touch_analysis.analyse_session(path)


def test_a_mass_at_the_tip_is_refused(touch_file, touch_analysis, tmp_path):
    path = touch_file.write(tmp_path / "a.mcap", metadata={"tip_mass_kg": "1e-4"})
    with pytest.raises(RecordError, match=r"a\.mcap: tip_mass_kg = 0\.0001 kg.*take it off"):
        touch_analysis.analyse_session(path)


def test_model_is_required_without_a_profile(touch_file, touch_analysis, tmp_path):
    path = touch_file.write(tmp_path / "a.mcap", profile="")
    with pytest.raises(SessionError, match=r"give --model FILE"):
        touch_analysis.analyse_session(path)


def test_a_wrong_model_is_named(touch_file, tmp_path):
    (tmp_path / "model.json").write_text("{}")
    with pytest.raises(IdentifiedBeamError, match="has no headlines"):
        TouchAnalysis(tmp_path / "model.json").analyse_session(touch_file.path)
