"""Frequency response of a sweep: the running estimate is the analyser's; nominal damping."""

from dataclasses import replace

import numpy as np
import pytest

from analysis.models import PAPER_BAND_HZ, WelchSettings
from analysis.paper import estimate
from analysis.record import load_record
from rigd.session import read_session
from rigd.session.layout import Status
from rigd.spectral import segmentation_of
from rigd.sweep_response import SweepResponse, nominal_damping


@pytest.fixture(scope="module")
def path(short_chirps):
    return short_chirps[0]


@pytest.fixture(scope="module")
def record(path):
    return load_record(path)


@pytest.fixture(scope="module")
def settings(record):
    """Segments into which the running estimate divides a sweep of this length."""
    chosen = segmentation_of(record.sweep.stop - record.sweep.start, record.rate_hz)
    return WelchSettings(
        segment_length=chosen.segment_length, overlap=chosen.overlap, nfft=chosen.nfft
    )


def final_response(record, samples):
    sweep = (record.sweep.start, record.sweep.stop)
    response = SweepResponse(sweep, record.rate_hz, last_hz=60.0)
    for first in range(0, len(samples), 50):
        response.feed(samples[first : first + 50])
    found = response.estimate()
    assert found.is_final
    return found.response.band(*PAPER_BAND_HZ)


@pytest.mark.process
def test_final_response_is_that_of_the_analyser(path, record, settings):
    found = final_response(record, read_session(path).samples)
    expected, _ = estimate(record, settings)
    assert found.frequency_hz == pytest.approx(expected.frequency_hz)
    assert np.all(abs(found.response - expected.response) < 1e-6 * abs(expected.response))
    assert found.coherence == pytest.approx(expected.coherence, abs=1e-6)


@pytest.mark.process
def test_missing_and_held_values_are_treated_as_in_the_analyser(path, record, settings):
    samples = read_session(path).samples.copy()
    faulty = np.random.default_rng(1).choice(np.arange(1500, 20_000), 60, replace=False)
    held, missing = faulty[:40], faulty[40:]
    samples["status"][held] |= np.uint32(Status.WRENCH_STALE)
    samples["coupling_torque_nm"][held] = 0.3
    every = np.arange(len(samples))
    known, present = np.setdiff1d(every, faulty), np.setdiff1d(every, missing)
    # The angle of a tick whose torque was held is not used either, which the analyser would use.
    record = replace(
        record,
        torque_nm=np.interp(every, known, samples["coupling_torque_nm"][known]),
        angle_rad=np.interp(every, known, samples["angle_rad"][known]),
    )
    found = final_response(record, samples[present])
    expected, _ = estimate(record, settings)
    assert np.all(abs(found.response - expected.response) < 1e-6 * abs(expected.response))


@pytest.mark.parametrize(
    ("profile", "known"),
    [
        (b"[beam.damping]\n" + b"".join(
            b"%s = { value = %s, source = 'paper' }\n" % pair for pair in
            ((b"zeta", b"7.1e-5"), (b"alpha", b"0.996"), (b"gamma", b"5.5e-2"), (b"lambda", b"0.6"))
        ), True),
        (b"", False),
        (b"[beam.damping]\nzeta = { value = 1e-5, source = 'paper' }\n", False),
        (b"[beam.damping]\nzeta = 3\nalpha = 1\ngamma = 0\nlambda = 1\n", False),
        (b"\xff\xfe", False),
        (b"beam = 3", False),
        (b"= no toml", False),
        (b"[beam.damping]\n" + b"".join(
            b"%s = { value = %s }\n" % pair for pair in
            ((b"zeta", b"nan"), (b"alpha", b"1"), (b"gamma", b"0"), (b"lambda", b"1"))
        ), False),
        (b"[beam.damping]\n" + b"".join(
            b"%s = { value = %s }\n" % pair for pair in
            ((b"zeta", b"1e-5"), (b"alpha", b"1"), (b"gamma", b"inf"), (b"lambda", b"1"))
        ), False),
        (b"[beam.damping]\n" + b"".join(
            b"%s = { value = %s }\n" % pair for pair in
            ((b"zeta", b"1e-5"), (b"alpha", b"1"), (b"gamma", b"0"), (b"lambda", b"2"))
        ), False),
    ],
)  # fmt: skip
def test_nominal_damping_comes_from_a_valid_profile(profile, known):
    damping = nominal_damping(profile)
    assert (damping is not None) == known
    if known:
        assert (damping.zeta, damping.alpha) == (7.1e-5, 0.996)
        assert (damping.gamma, damping.lambda_) == (5.5e-2, 0.6)
