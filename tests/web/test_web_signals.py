"""Strips and the growing response, which the page receives for blocks of signals."""

import base64
import json

import numpy as np
import pytest

from rigd.beam import Beam, Damping, transfer
from rigd.web._signals import PageSignalBlock, SessionResponse, SignalEnvelopes, nominal_document

RATE_HZ = 1000.0
BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)


def block(first, angle, reference=None, torque=None):
    angle = np.asarray(angle, dtype=float)
    reference = angle if reference is None else np.asarray(reference, dtype=float)
    torque = -angle if torque is None else np.asarray(torque, dtype=float)
    return PageSignalBlock(first, RATE_HZ, np.stack((angle, reference, torque)))


def test_block_from_an_event():
    encoded = {
        name: base64.b64encode(np.array([k, np.nan], dtype="<f4").tobytes()).decode()
        for k, name in enumerate(("angle_rad", "angle_reference_rad", "coupling_torque_nm"))
    }
    decoded = PageSignalBlock.from_event(encoded | {"first_tick": 7, "rate_hz": RATE_HZ})
    assert (decoded.first_tick, decoded.signal_values[:, 0].tolist()) == (7, [0.0, 1.0, 2.0])
    assert np.isnan(decoded.signal_values[0, 1])


@pytest.mark.parametrize("block_size", [1, 7, 51, 400])
def test_strips_are_extremes_whatever_the_block_size(block_size):
    angle = np.sin(np.arange(400) / 30.0)
    strips = SignalEnvelopes()
    firsts = range(0, 400, block_size)
    documents = [strips.feed(block(first, angle[first : first + block_size])) for first in firsts]
    documents = [each for each in documents if each]
    assert [documents[0]["t0_s"], documents[0]["dt_s"]] == [0.0, 0.05]
    least = np.concatenate([each["angle_min"] for each in documents])
    greatest = np.concatenate([each["torque_max"] for each in documents])
    np.testing.assert_allclose(least, angle.reshape(8, 50).min(axis=1), atol=1e-6)
    np.testing.assert_allclose(greatest, (-angle).reshape(8, 50).max(axis=1), atol=1e-6)
    assert strips.stored_message()["angle_min"] == [
        value for each in documents for value in each["angle_min"]
    ]


def test_missed_ticks_are_no_points_and_times_stay_right():
    strips = SignalEnvelopes()
    strips.feed(block(0, np.ones(50)))
    document = strips.feed(block(200, np.r_[np.full(50, np.nan), np.full(50, 2.0)]))
    assert document["t0_s"] == 0.05
    assert document["angle_min"] == [None, None, None, None, 2.0]
    assert document["reference_min"][-1] == document["reference_max"][-1] == 2.0


def test_strips_restart_with_a_session_and_last_10_s():
    strips = SignalEnvelopes()
    for first in range(0, 15_000, 500):
        strips.feed(block(first, np.ones(500)))
    last = strips.stored_message()
    assert len(last["angle_min"]) == 200
    assert last["t0_s"] == pytest.approx(5.0)
    document = strips.feed(block(0, np.zeros(50)))
    assert document["t0_s"] == 0.0
    assert strips.stored_message() == document


@pytest.fixture(scope="module")
def sweep():
    """A chirp of a beam that is exactly known, with some missed ticks."""
    ticks = np.arange(30_000)
    t = ticks / RATE_HZ
    angle = 0.02 * np.sin(2 * np.pi * (0.5 * t + 20.0 / 30.0 * t**2 / 2))
    spectrum = np.fft.rfft(angle, 1 << 17)
    s = 2j * np.pi * np.fft.rfftfreq(1 << 17, 1 / RATE_HZ)
    s[0] = 1e-6
    damping = Damping(zeta=2e-3)
    torque = np.fft.irfft(spectrum * transfer(s, BEAM, damping), 1 << 17)[: ticks.size]
    known = np.ones(ticks.size, dtype=bool)
    known[[5000, 5001, 12_345]] = False
    return angle, torque, known


def make_response(ticks):
    return SessionResponse((1000, 1000 + ticks), RATE_HZ)


def test_response_is_that_of_the_record(sweep):
    angle, torque, known = sweep
    growing = make_response(angle.size)
    assert growing.response_message() is None
    growing.feed(block(0, np.zeros(1000)))
    reached = []
    document = None
    for first in range(0, angle.size, 5000):
        part = slice(first, first + 5000)
        shown = np.where(known[part], angle[part], np.nan)
        growing.feed(block(1000 + first, shown, angle[part], torque[part]))
        document = growing.response_message() or document
        reached.append(document and document["reached_hz"])
        assert growing.response_message() is None  # nothing new
    reached = [each for each in reached if each is not None]
    assert reached == sorted(reached)
    assert reached[-1] > 15.0  # of 20.5 Hz: the last whole segment and the newest samples
    assert 100 < len(document["frequency_hz"]) <= 400
    grid = np.array(document["frequency_hz"])
    expected = np.abs(transfer(2j * np.pi * grid, BEAM, Damping(zeta=2e-3)))
    assert np.median(np.abs(np.array(document["magnitude"]) / expected - 1.0)) < 0.02


def test_no_line_across_frequencies_without_excitation():
    """Two narrow sweeps, as of a search: 2 to 4 Hz, then 12 to 16 Hz."""
    t = np.arange(20_000) / RATE_HZ
    angle = 0.01 * np.concatenate(
        [
            np.sin(2 * np.pi * (first * t + (last - first) * t**2 / 40.0))
            for first, last in ((2.0, 4.0), (12.0, 16.0))
        ]
    )
    growing = make_response(angle.size)
    growing.feed(block(0, np.zeros(1000)))
    growing.feed(block(1000, angle, torque=3 * angle))
    document = growing.response_message()
    grid = np.array(document["frequency_hz"])
    nothing = np.array([each is None for each in document["magnitude"]])
    assert nothing[(grid > 5.0) & (grid < 11.0)].all()
    assert 2 <= nothing.sum() <= 6
    assert [each is None for each in document["phase_rad"]] == nothing.tolist()
    json.dumps(document, allow_nan=False)


def test_the_nominal_model_shows_its_resonances():
    document = nominal_document(BEAM, Damping(zeta=1e-3), 1e-5)
    grid = np.array(document["frequency_hz"])
    s = 2j * np.pi * grid
    expected = transfer(s, BEAM, Damping(zeta=1e-3)) + 1e-5 * s * s
    np.testing.assert_allclose(document["magnitude"], np.abs(expected), rtol=1e-3)
    np.testing.assert_allclose(document["phase_rad"], np.angle(expected), atol=1e-4)
    fine = 2j * np.pi * np.arange(0.5, 60.0, 0.01)
    most = np.abs(transfer(fine, BEAM, Damping(zeta=1e-3)) + 1e-5 * fine**2).max()
    assert max(document["magnitude"]) == pytest.approx(most, rel=1e-3)
    assert len(grid) <= 400
