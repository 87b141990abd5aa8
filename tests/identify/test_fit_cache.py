"""Cache of fits: the same results without a fit, never of other data, settings or programs."""

import os
import shutil
from dataclasses import replace
from importlib import metadata

import numpy as np
import pytest

import analysis.identify
from analysis import quick_look
from analysis.identify import Measurement, fit_cache, select
from analysis.identify.fit_cache import FitCache
from analysis.models import WelchSettings
from analysis.online import OnlineEstimator
from analysis.quick_look import make_quick_look
from analysis.record import load_record
from analysis.results import AnalysisOptions, record_result, whole_record
from rigd.session import read_session
from rigd.testing import chirp_signals

pytestmark = [
    pytest.mark.fit,
    pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no cache on this system"),
]

BAND_HZ = (0.0, 50.0)


@pytest.fixture(scope="module")
def session(write_session, tmp_path_factory):
    return write_session(tmp_path_factory.mktemp("session") / "a.mcap", chirp_signals(sweep_s=20.0))


@pytest.fixture(scope="module")
def measurement(session):
    return Measurement.from_record(load_record(session))


@pytest.fixture(scope="module")
def selection(measurement):
    return select(measurement, band_hz=BAND_HZ)


@pytest.fixture
def user_cache(monkeypatch, tmp_path):
    """Switch the cache on, in an empty folder; return its folder of fits."""
    monkeypatch.delenv("RIGD_NO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rigd" / "fits"


@pytest.fixture
def cache(tmp_path):
    return FitCache(tmp_path / "fits")


@pytest.fixture
def stored(cache, measurement, selection, tmp_path):
    """Path of the only entry of the cache."""
    cache.store(selection, measurement, (), BAND_HZ)
    (path,) = (tmp_path / "fits").iterdir()
    return path


@pytest.fixture
def no_fits(monkeypatch):
    """Refuse to fit a record in this process or in a copy of it."""

    def refuse(*_, **__):
        raise AssertionError("the record was fitted again")

    monkeypatch.setattr(analysis.identify, "select", refuse)


def headline_json(whole):
    return {**whole.headline_json(), "file": ""}


def test_second_analysis_of_a_moved_file_equals_the_first(
    user_cache, session, monkeypatch, tmp_path
):
    first = whole_record(load_record(session))
    moved = shutil.copy(session, tmp_path / "moved.mcap")
    monkeypatch.setattr(analysis.identify, "select", None)
    again = whole_record(load_record(moved))
    assert headline_json(again) == headline_json(first)
    assert again.verdict == replace(first.verdict, name=str(moved))
    np.testing.assert_array_equal(again.fit.residual, first.fit.residual)
    (entry,) = user_cache.iterdir()
    assert entry.stat().st_mode & 0o077 == 0
    assert b"a.mcap" not in entry.read_bytes()


def test_report_of_stored_fits_equals_the_first(user_cache, session, no_fits, monkeypatch):
    options = AnalysisOptions(WelchSettings(types=("III",)), True, True, ())
    with monkeypatch.context() as patch:
        patch.setattr(analysis.identify, "select", select)
        first = record_result(session, options)
    known = []
    again = record_result(session, options, on_whole=known.append)
    assert [each.verdict for each in known] == [again.whole.verdict] == [first.whole.verdict]
    assert again.whole.headline_json() == first.whole.headline_json()
    assert again.whole.record is again.record is again.welch.record
    for found, expected in zip(again.welch.models, first.welch.models, strict=True):
        assert found.fit == expected.fit


def test_entry_refers_to_the_samples_instead_of_holding_them(cache, stored, measurement):
    found = cache.find(measurement, (), BAND_HZ)
    assert found.analysis.comparison.measurement is measurement
    assert measurement.torque_nm.tobytes() not in stored.read_bytes()


def changed_sample(measurement):
    torque_nm = measurement.torque_nm.copy()
    torque_nm[len(torque_nm) // 2] = np.nextafter(torque_nm[len(torque_nm) // 2], 1.0)
    return replace(measurement, torque_nm=torque_nm)


@pytest.mark.parametrize(
    "change",
    [
        changed_sample,
        lambda given: replace(given, uniformity=2e-3),
        lambda given: replace(given, delay_s=given.delay_s + 1e-9),
        lambda given: replace(given, beam=replace(given.beam, length_m=given.beam.length_m + 1e-6)),
        lambda given: replace(given, angle_known=np.arange(given.angle_rad.size) > 0),
    ],
    ids=["sample", "uniformity", "delay", "beam", "gap"],
)
def test_other_data_are_not_found(cache, stored, measurement, change):
    assert cache.find(replace(measurement), (), BAND_HZ) is not None
    assert cache.find(change(measurement), (), BAND_HZ) is None


def test_other_settings_are_not_found(cache, stored, measurement):
    assert cache.find(measurement, ("delay_s",), BAND_HZ) is None
    assert cache.find(measurement, (), (0.0, 40.0)) is None


@pytest.mark.parametrize("library", ["numpy", "scipy"])
def test_fits_of_other_programs_are_not_found(cache, stored, measurement, library, monkeypatch):
    def version(name):
        return "0.0" if name == library else metadata.version(name)

    monkeypatch.setattr(fit_cache, "installed_version", version)
    assert cache.find(measurement, (), BAND_HZ) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:10],
        lambda content: content[:-1],
        lambda content: content[:5000] + bytes([content[5000] ^ 1]) + content[5001:],
    ],
    ids=["empty", "start", "cut", "flipped bit"],
)
def test_damaged_entry_is_not_used(cache, stored, measurement, damage):
    stored.write_bytes(damage(stored.read_bytes()))
    assert cache.find(measurement, (), BAND_HZ) is None


def test_entry_with_the_name_of_another_is_not_used(cache, stored, measurement, selection):
    cache.store(selection, measurement, (), (1.0, 50.0))
    (other,) = set(stored.parent.iterdir()) - {stored}
    shutil.copy(other, stored)
    assert cache.find(measurement, (), BAND_HZ) is None
    assert cache.find(measurement, (), (1.0, 50.0)) is not None


def test_pipe_in_place_of_an_entry_is_not_read(cache, stored, measurement):
    stored.unlink()
    os.mkfifo(stored)
    assert cache.find(measurement, (), BAND_HZ) is None


def test_least_recently_used_entries_are_removed(tmp_path, measurement, selection):
    folder = tmp_path / "fits"
    FitCache(folder).store(selection, measurement, (), BAND_HZ)
    (entry,) = folder.iterdir()
    cache = FitCache(folder, max_bytes=int(2.5 * entry.stat().st_size))
    cache.store(selection, measurement, (), (1.0, 50.0))
    for seconds, path in enumerate(sorted(folder.iterdir(), key=lambda path: path != entry)):
        os.utime(path, (seconds, seconds))
    assert cache.find(measurement, (), BAND_HZ) is not None  # older, but used now
    cache.store(selection, measurement, (), (2.0, 50.0))
    assert cache.find(measurement, (), BAND_HZ) is not None
    assert cache.find(measurement, (), (2.0, 50.0)) is not None
    assert cache.find(measurement, (), (1.0, 50.0)) is None
    assert len(list(folder.iterdir())) == 2


def test_fits_during_a_session_are_used_for_its_file(session, user_cache, monkeypatch):
    recorded = read_session(session)
    estimator = OnlineEstimator(recorded.metadata, recorded.segments)
    estimator.feed(recorded.samples)
    estimator.estimate(len(recorded.samples) // 2)  # of the freest structure alone
    assert not user_cache.exists()
    estimate = estimator.estimate(whole=True)
    monkeypatch.setattr(analysis.identify, "select", None)
    assert whole_record(load_record(session)).headline.parameters == estimate.headline.parameters
    monkeypatch.setattr(quick_look, "_LONGEST_FULL_ANALYSIS_S", 10.0)  # of the longer record
    content = make_quick_look(session)
    assert [mode["damping_ratio"]["value"] for mode in content["modes"]] == [
        mode.damping_ratio.value for mode in estimate.headline.modes
    ]
    assert not any("alone was fitted" in flag for flag in content["flags"])


def test_cache_that_cannot_be_written_is_no_error(tmp_path, measurement, selection):
    (tmp_path / "fits").write_text("a file in place of the folder")
    cache = FitCache(tmp_path / "fits")
    cache.store(selection, measurement, (), BAND_HZ)
    assert cache.find(measurement, (), BAND_HZ) is None


def test_folder_that_others_can_write_to_is_not_used(user_cache):
    user_cache.mkdir(parents=True)
    for folder in (user_cache, user_cache.parent):
        assert FitCache.of_user() is not None
        folder.chmod(0o770)
        assert FitCache.of_user() is None
        folder.chmod(0o700)


def test_folders_are_private_whatever_the_umask(user_cache, measurement, selection):
    umask = os.umask(0o002)
    try:
        FitCache.of_user().store(selection, measurement, (), BAND_HZ)
    finally:
        os.umask(umask)
    assert FitCache.of_user().find(measurement, (), BAND_HZ) is not None


def test_no_cache_if_the_programs_cannot_be_read(user_cache, monkeypatch):
    def version(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(fit_cache, "installed_version", version)
    assert FitCache.of_user() is None


def test_cache_can_be_switched_off(user_cache, monkeypatch):
    assert FitCache.of_user() is not None
    monkeypatch.setenv("RIGD_NO_CACHE", "1")
    assert FitCache.of_user() is None
