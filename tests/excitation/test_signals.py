"""Excitations: shape, length to the tick, and refusals."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.excitation import (
    ExcitationError,
    chirp,
    from_csv,
    hold,
    multisine,
    present_frequency_hz,
    step,
    until,
)


def test_chirp_of_the_paper_to_the_last_bit():
    excitation = chirp(rate_hz=1000.0)
    reference = excitation.reference_rad
    assert reference.shape == (136_000,)
    assert excitation.segments == {
        "rest": (0, 1000),
        "sweep": (1000, 121_000),
        "ring_down": (121_000, 136_000),
    }
    assert not reference[:1001].any()
    for tick in (1, 777, 60_000, 119_999):
        t = tick / 1000.0
        phase = 2 * math.pi * (0.05 * t + (50.0 - 0.05) * t**2 / (2 * 120.0))
        assert reference[1000 + tick] == pytest.approx(0.025 * math.sin(phase), abs=1e-12)
    assert (reference[121_000:] == reference[120_999]).all()
    assert excitation.parameters["amplitude_rad"] == 0.025
    with pytest.raises(ValueError, match="read-only"):
        reference[0] = 1.0


def test_chirp_has_its_stated_frequencies():
    reference = chirp(
        rate_hz=1000.0, start_hz=2.0, stop_hz=20.0, duration_s=30.0, rest_s=0.0, ring_down_s=0.0
    ).reference_rad
    crossings = np.flatnonzero(np.diff(np.signbit(reference)))
    frequency_hz = 500.0 / np.diff(crossings)
    at_s = (crossings[1:] + crossings[:-1]) / 2000.0
    np.testing.assert_allclose(frequency_hz, 2.0 + 18.0 * at_s / 30.0, rtol=0.05)


def test_double_chirp_returns_through_its_frequencies():
    options = {"rate_hz": 1000.0, "start_hz": 2.0, "stop_hz": 20.0, "duration_s": 30.0}
    plain, both = chirp(**options), chirp(**options, there_and_back=1)
    assert plain.parameters | {"there_and_back": 1} == both.parameters
    assert both.segments == {
        "rest": (0, 1000), "sweep": (1000, 61_000), "there": (1000, 31_000),
        "back": (31_000, 61_000), "ring_down": (61_000, 76_000),
    }  # fmt: skip
    np.testing.assert_array_equal(both.reference_rad[:31_000], plain.reference_rad[:31_000])
    sweep = both.reference_rad[1000:61_000]
    crossings = np.flatnonzero(np.diff(np.signbit(sweep)))
    at_s = (crossings[1:] + crossings[:-1]) / 2000.0
    expected_hz = 20.0 - 18.0 * np.abs(at_s - 30.0) / 30.0
    np.testing.assert_allclose(500.0 / np.diff(crossings), expected_hz, rtol=0.05)
    for tick, frequency_hz in ((16_000, 11.0), (31_000, 20.0), (46_000, 11.0), (61_000, None)):
        assert present_frequency_hz(both, tick) == frequency_hz


@pytest.mark.parametrize("duration_s", [10.0, 9.9871, 3.33333])
def test_angle_and_speed_are_continuous_where_the_sweep_turns(duration_s):
    """For any phase there: differences of ticks stay those of a sine of the stop frequency."""
    excitation = chirp(rate_hz=1000.0, duration_s=duration_s, there_and_back=1)
    turn = excitation.segments["back"][0]
    around = excitation.reference_rad[turn - 100 : turn + 100]
    most = 2 * math.sin(math.pi * 50.0 / 1000.0)
    assert np.abs(np.diff(around)).max() <= 0.025 * most * (1 + 1e-9)
    assert np.abs(np.diff(around, 2)).max() <= 0.025 * most**2 * (1 + 1e-3)
    assert np.abs(np.diff(around, 3)).max() <= 0.025 * most**3 * 1.02


@pytest.mark.parametrize(
    ("options", "words"),
    [({"there_and_back": 2}, "there_and_back = 2 must be 0"),
     ({"there_and_back": 1, "duration_s": 2000.0}, "4016 s; 4000 s is the most"),
     ({"there_and_back": 1, "duration_s": 10.0, "taper_s": 11.0}, "duration_s = 20 s")],
)  # fmt: skip
def test_unsupported_double_sweep_is_refused(options, words):
    with pytest.raises(ExcitationError, match=words):
        chirp(rate_hz=1000.0, **options)


def test_taper_fades_both_ends_and_leaves_the_middle():
    plain = chirp(rate_hz=1000.0, duration_s=20.0).reference_rad
    faded = chirp(rate_hz=1000.0, duration_s=20.0, taper_s=2.0).reference_rad
    assert (faded[3000:19_000] == plain[3000:19_000]).all()
    assert abs(faded[20_999]) < 1e-7
    np.testing.assert_allclose(faded[2000], 0.5 * plain[2000])


@settings(max_examples=30)
@given(
    rest=st.integers(0, 3000),
    duration=st.integers(2, 5000),
    ring_down=st.integers(0, 3000),
    rate_hz=st.sampled_from([250.0, 1000.0, 997.0]),
)
def test_ticks_are_rate_times_time(rest, duration, ring_down, rate_hz):
    excitation = hold(
        rate_hz=rate_hz,
        rest_s=rest / rate_hz,
        duration_s=duration / rate_hz,
        ring_down_s=ring_down / rate_hz,
    )
    assert excitation.reference_rad.size == rest + duration + ring_down
    assert excitation.segments["sweep"] == (rest, rest + duration)


def test_step_steps_at_the_sweeps_first_tick_and_holds():
    excitation = step(rate_hz=1000.0, amplitude_rad=-0.01)
    reference = excitation.reference_rad
    assert reference[999] == 0.0
    assert (reference[1000:] == -0.01).all()


def test_multisine_is_flat_periodic_and_seeded():
    options = {"rate_hz": 1000.0, "period_s": 10.0, "duration_s": 30.0, "taper_s": 0.0}
    excitation = multisine(**options, start_hz=1.0, stop_hz=30.0, seed=7)
    sweep = excitation.reference_rad[slice(*excitation.segments["sweep"])]
    period = sweep[:10_000]
    assert (sweep.reshape(3, -1) == period).all()
    assert np.max(np.abs(period)) == pytest.approx(0.025)
    spectrum = np.abs(np.fft.rfft(period))
    inside = spectrum[10:301]
    np.testing.assert_allclose(inside, inside[0], rtol=1e-9)
    assert np.max(np.delete(spectrum, np.arange(10, 301))) < 1e-9 * inside[0]
    assert abs(period[0]) == np.min(np.abs(period))
    crest = 0.025 / np.sqrt(np.mean(period**2))
    assert excitation.parameters["crest_factor"] == pytest.approx(crest)
    again = multisine(**options, start_hz=1.0, stop_hz=30.0, seed=7)
    other = multisine(**options, start_hz=1.0, stop_hz=30.0, seed=8)
    assert (again.reference_rad == excitation.reference_rad).all()
    assert (other.reference_rad != excitation.reference_rad).any()


def test_csv_with_times_is_interpolated(tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("angle_rad,time_s,note\n0.0,5.0,a\n0.2,5.1,b\n\n-0.1,5.4,c\n")
    excitation = from_csv(path, rate_hz=100.0, rest_s=0.1, ring_down_s=0.2)
    first, end = excitation.segments["sweep"]
    sweep = excitation.reference_rad[first:end]
    assert sweep.size == 41
    np.testing.assert_allclose(sweep[[0, 5, 10, 25, 40]], [0.0, 0.1, 0.2, 0.05, -0.1], atol=1e-12)
    assert (excitation.reference_rad[end:] == sweep[-1]).all()
    assert excitation.parameters["file"] == "path.csv"


@pytest.mark.parametrize(
    "heading",
    [
        "",
        "angle_rad\n",
        "\ufeffangle_rad\r\n",
        "Angle [rad]\n",
        "# chirp of rig 4, to 50 Hz\n# Sampling rate: 1 kHz\n",
    ],
)
def test_csv_of_one_column_is_one_angle_per_tick(tmp_path, heading):
    path = tmp_path / "angles.csv"
    path.write_text(heading + "0.0\n0.1\n0.3\n", encoding="utf-8")
    excitation = from_csv(path, rate_hz=1000.0, rest_s=0.0, ring_down_s=0.0)
    assert excitation.reference_rad.tolist() == [0.0, 0.1, 0.3]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "must name the columns time_s (s) and angle_rad (rad)"),
        ("1,2\n3,4\n", "must name the columns time_s (s) and angle_rad (rad)"),
        ("x\n1\n2\n", "must name the columns time_s (s) and angle_rad (rad)"),
        ("t,angle_rad\n1,2\n", "no time_s"),
        ("time_s,angle_rad\n0,0\n1,x\n", "line 3: 'angle_rad' is not a number;"),
        ("time_s,angle_rad\n0,0\n\n1,\n2,3\n", "line 4: angle_rad is not a finite number"),
        ("time_s,angle_rad\n0,0\n1,nan\n", "line 3: angle_rad is not a finite number"),
        ("time_s,angle_rad\n0,0\n1\n", "line 3 has 1 cell"),
        ("angle_rad\n0,000\n0,010\n", "line 2 has 2 cells between commas, and line 1 has 1 title"),
        ("0,000\n0,010\n", "line 1: every second cell between commas looks like the decimals"),
        ("angle_rad\n0\n0.1\n0,2\n", "line 4 has 2 cells"),
        ("time_s,angle_rad\n0,0,0000\n2,0,0200\n", "line 2 has 3 cells"),
        ("time_s;angle_rad\n0;0.5\n1;0,5\n", "line 2: 'angle_rad' has a decimal point,"),
        ("time_s;angle_rad\ns;deg\n0;0.5\n1;0.5\n", "states another unit than rad"),
        ("time_s;angle_rad\nms;rad\n0;0.5\n1;0.5\n", "states another unit than s"),
        ("angle [deg]\n0.5\n0.7\n", "states another unit than rad"),
        ("# unit: mrad\n# Sampling rate: 1000 Hz\n0.5\n0.7\n", "states another unit than rad"),
        ("Motor torque\n0.5\n0.7\n", "must name the columns time_s (s) and angle_rad (rad)"),
        ("Sampling rate: 500 Hz\nangle_rad\n0.5\n0.7\n", "states 500 Hz above its angles"),
        ("# dt = 2 ms\n0.5\n0.7\n", "states 500 Hz above its angles"),
        ("angle_rad\n0.5\n\n0.7\n", "line 3 is empty"),
        ("time_s,angle_rad\n1,0\n1,1\n", "line 3: time_s does not come after"),
        ("time_s,angle_rad\n0,0\n1e9,1\n", "4000 s is the most"),
        ("time_s,angle_rad\n-1e308,0\n1e308,1\n", "4000 s is the most"),
        ("angle_rad\n1.0\n", "has 1 angles"),
    ],
)
def test_bad_csv_files_are_refused_with_their_line(tmp_path, text, complaint):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ExcitationError) as caught:
        from_csv(path, rate_hz=1000.0)
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("time_s;angle_rad\n0;0\n0,1;0,5\n", "utf-8"),
        ("Winkel über Zeit\n\ntime_s\tangle_rad\ns\trad\n0\t0\n0,1\t0,5\n", "cp1252"),
        ("sep=;\r\ntime_s;angle_rad;\r\n0;0;\r\n0.1;0.5\r\n", "utf-16"),
        ("# time_s angle_rad\n0 0\n0.1 0.5\n", "utf-8-sig"),
    ],
)
def test_other_separators_headers_and_encodings_are_read(tmp_path, text, encoding):
    path = tmp_path / "path.csv"
    path.write_bytes(text.encode(encoding))
    excitation = from_csv(path, rate_hz=100.0, rest_s=0.0, ring_down_s=0.0)
    np.testing.assert_allclose(excitation.reference_rad[[0, 5, 10]], [0, 0.25, 0.5], atol=1e-12)


def test_text_of_a_file_is_not_quoted(tmp_path):
    path = tmp_path / "bad.csv"
    for text in (
        "hush:x,angle_rad\n",
        "hush:x\n",
        "time_s,angle_rad\n0,1\nhush:x,2\n",
        "1\nhush:x\n",
    ):
        path.write_text(text)
        with pytest.raises(ExcitationError) as caught:
            from_csv(path, rate_hz=1000.0)
        assert "hush" not in str(caught.value)


def test_only_plain_files_are_read(tmp_path):
    pipe = tmp_path / "pipe.csv"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path, Path("/dev/zero")):
        with pytest.raises(ExcitationError, match="not a file"):  # and nobody waits
            from_csv(path, rate_hz=1000.0)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", None])
def test_unreadable_files_are_named(tmp_path, content):
    path = tmp_path / "bad.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ExcitationError, match=r"bad\.csv"):
        from_csv(path, rate_hz=1000.0)


@pytest.mark.parametrize(
    ("make", "options", "complaint"),
    [
        (chirp, {"amplitude_rad": math.nan}, "amplitude_rad = nan rad is not a finite number"),
        (chirp, {"amplitude_rad": 0.0}, "amplitude_rad = 0 rad must be more than 0 rad"),
        (chirp, {"stop_hz": 400.0}, "stop_hz = 400 Hz leaves fewer than 4 samples"),
        (chirp, {"start_hz": -1.0}, "start_hz = -1 Hz must not be negative"),
        (chirp, {"stop_hz": 0.0}, "stop_hz = 0 Hz must be more than 0 Hz"),
        (chirp, {"duration_s": -120.0}, "duration_s = -120 s must be more than 0 s"),
        (chirp, {"duration_s": math.inf}, "duration_s = inf s is not a finite number"),
        (chirp, {"duration_s": 1e7}, "4000 s is the most"),
        (chirp, {"duration_s": 1e300}, "is not plausible for a rig"),
        (chirp, {"duration_s": 3984.5}, "3984 s between rest and ring-down"),
        (chirp, {"duration_s": 9.0, "ring_down_s": 5000.0}, "4000 s is the most at 1000 Hz,"),
        (until, {"targets": "damping 1%", "at_most_s": 4001.0}, "4000 s is the most"),
        (until, {"targets": "damping 1%", "at_most_s": 1e300}, "is not plausible for a rig"),
        (chirp, {"duration_s": 1e-4}, "less than two ticks"),
        (chirp, {"rest_s": -1.0}, "rest_s = -1 s must not be negative"),
        (chirp, {"ring_down_s": math.nan}, "ring_down_s = nan s is not a finite number"),
        (chirp, {"taper_s": 61.0}, "taper_s = 61 s at both ends does not fit"),
        (step, {"amplitude_rad": 0.0}, "is not a step"),
        (step, {"amplitude_rad": math.inf}, "amplitude_rad = inf rad"),
        (hold, {"duration_s": 0.0}, "duration_s = 0 s must be more than 0 s"),
        (multisine, {"period_s": 7.0}, "is not a whole number of periods"),
        (multisine, {"period_s": 0.01234567}, "is not a whole number of ticks"),
        (multisine, {"seed": -1}, "seed = -1 is negative"),
        (multisine, {"start_hz": 20.01, "stop_hz": 20.02}, "No harmonic"),
        (multisine, {"start_hz": 20.0, "stop_hz": 10.0}, "No harmonic"),
        (multisine, {"period_s": 0.0}, "period_s = 0 s must be more than 0 s"),
    ],
)
def test_absurd_options_are_refused(make, options, complaint):
    with pytest.raises(ExcitationError) as caught:
        make(rate_hz=1000.0, **options)
    assert complaint in str(caught.value)


def test_multisine_lasts_longer_than_one_fit_takes(rate_hz=100.0):
    """Its blocks are analysed one by one. Its periods are equal, also where blocks are computed."""
    long = multisine(rate_hz=rate_hz, stop_hz=20, period_s=20, duration_s=50_000, rest_s=0)
    periods_rad = long.reference_rad[: 100 * 50_000].reshape(-1, 2000)
    assert np.ptp(periods_rad, axis=0).max() == 0
    with pytest.raises(ExcitationError, match="no more than 4000000 samples"):
        chirp(rate_hz=rate_hz, stop_hz=20, duration_s=50_000)
    with pytest.raises(ExcitationError, match="no more than 40000000 samples"):
        multisine(rate_hz=rate_hz, stop_hz=20, period_s=20, duration_s=500_000)
