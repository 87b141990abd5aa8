"""Strips and the growing response: what the page is told of blocks of signals."""

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


def test_a_block_is_what_the_event_tells():
    told = {
        name: base64.b64encode(np.array([k, np.nan], dtype="<f4").tobytes()).decode()
        for k, name in enumerate(("angle_rad", "angle_reference_rad", "coupling_torque_nm"))
    }
    found = PageSignalBlock.from_event(told | {"first_tick": 7, "rate_hz": RATE_HZ})
    assert (found.first_tick, found.values[:, 0].tolist()) == (7, [0.0, 1.0, 2.0])
    assert np.isnan(found.values[0, 1])


@pytest.mark.parametrize("pieces", [1, 7, 51, 400])
def test_strips_are_the_extremes_of_each_point_in_whatever_pieces_they_come(pieces):
    angle = np.sin(np.arange(400) / 30.0)
    strips = SignalEnvelopes()
    firsts = range(0, 400, pieces)
    told = [strips.feed(block(first, angle[first : first + pieces])) for first in firsts]
    told = [each for each in told if each]
    assert [told[0]["t0_s"], told[0]["dt_s"]] == [0.0, 0.05]
    least = np.concatenate([each["angle_min"] for each in told])
    greatest = np.concatenate([each["torque_max"] for each in told])
    np.testing.assert_allclose(least, angle.reshape(8, 50).min(axis=1), atol=1e-6)
    np.testing.assert_allclose(greatest, (-angle).reshape(8, 50).max(axis=1), atol=1e-6)
    assert strips.stored_message()["angle_min"] == [
        value for each in told for value in each["angle_min"]
    ]


def test_what_is_missed_is_no_point_and_what_comes_after_has_its_own_time():
    strips = SignalEnvelopes()
    strips.feed(block(0, np.ones(50)))
    told = strips.feed(block(200, np.r_[np.full(50, np.nan), np.full(50, 2.0)]))
    assert told["t0_s"] == 0.05
    assert told["angle_min"] == [None, None, None, None, 2.0]
    assert told["reference_min"][-1] == told["reference_max"][-1] == 2.0


def test_a_new_session_begins_anew_and_only_10_s_are_kept():
    strips = SignalEnvelopes()
    for first in range(0, 15_000, 500):
        strips.feed(block(first, np.ones(500)))
    last = strips.stored_message()
    assert len(last["angle_min"]) == 200
    assert last["t0_s"] == pytest.approx(5.0)
    told = strips.feed(block(0, np.zeros(50)))
    assert told["t0_s"] == 0.0
    assert strips.stored_message() == told


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


def of_sweep(ticks):
    return SessionResponse((1000, 1000 + ticks), RATE_HZ)


def test_the_response_is_that_of_the_record(sweep):
    angle, torque, known = sweep
    growing = of_sweep(angle.size)
    assert growing.document() is None
    growing.feed(block(0, np.zeros(1000)))
    reached = []
    told = None
    for first in range(0, angle.size, 5000):
        part = slice(first, first + 5000)
        shown = np.where(known[part], angle[part], np.nan)
        growing.feed(block(1000 + first, shown, angle[part], torque[part]))
        told = growing.document() or told
        reached.append(told and told["reached_hz"])
        assert growing.document() is None  # nothing new
    reached = [each for each in reached if each is not None]
    assert reached == sorted(reached)
    assert reached[-1] > 15.0  # of 20.5 Hz: the last whole segment and the newest samples
    assert 100 < len(told["frequency_hz"]) <= 400
    grid = np.array(told["frequency_hz"])
    expected = np.abs(transfer(2j * np.pi * grid, BEAM, Damping(zeta=2e-3)))
    assert np.median(np.abs(np.array(told["magnitude"]) / expected - 1.0)) < 0.02


def test_no_line_is_drawn_across_what_was_not_excited():
    """Two narrow sweeps, as of a search: 2 to 4 Hz, then 12 to 16 Hz."""
    t = np.arange(20_000) / RATE_HZ
    angle = 0.01 * np.concatenate(
        [
            np.sin(2 * np.pi * (first * t + (last - first) * t**2 / 40.0))
            for first, last in ((2.0, 4.0), (12.0, 16.0))
        ]
    )
    growing = of_sweep(angle.size)
    growing.feed(block(0, np.zeros(1000)))
    growing.feed(block(1000, angle, torque=3 * angle))
    told = growing.document()
    grid = np.array(told["frequency_hz"])
    nothing = np.array([each is None for each in told["magnitude"]])
    assert nothing[(grid > 5.0) & (grid < 11.0)].all()
    assert 2 <= nothing.sum() <= 6
    assert [each is None for each in told["phase_rad"]] == nothing.tolist()
    json.dumps(told, allow_nan=False)


def test_the_nominal_model_shows_its_resonances():
    told = nominal_document(BEAM, Damping(zeta=1e-3), 1e-5)
    grid = np.array(told["frequency_hz"])
    s = 2j * np.pi * grid
    expected = transfer(s, BEAM, Damping(zeta=1e-3)) + 1e-5 * s * s
    np.testing.assert_allclose(told["magnitude"], np.abs(expected), rtol=1e-3)
    np.testing.assert_allclose(told["phase_rad"], np.angle(expected), atol=1e-4)
    fine = 2j * np.pi * np.arange(0.5, 60.0, 0.01)
    most = np.abs(transfer(fine, BEAM, Damping(zeta=1e-3)) + 1e-5 * fine**2).max()
    assert max(told["magnitude"]) == pytest.approx(most, rel=1e-3)
    assert len(grid) <= 400
