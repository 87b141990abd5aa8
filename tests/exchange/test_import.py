"""Imported records: numbers, flags, gaps, provenance, and warnings."""

import hashlib
import os
import time
from dataclasses import fields, replace

import numpy as np
import pytest
from cases import further

from analysis.exchange import (
    ExchangeError,
    ImportPlan,
    import_record,
    parse_choice,
    read_specimen,
    write_session,
)
from analysis.record import load_record
from rigd.beam import Beam, Damping, transfer
from rigd.profile import SECTIONS
from rigd.session import SessionError, SessionExistsError, read_session
from rigd.session.layout import Status

BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
N = 4000
TIME_S = np.arange(N) / 1000
ANGLE = 0.02 * np.sin(2 * np.pi * 1.3 * TIME_S**2)
TORQUE = np.random.default_rng(0).normal(size=N)


def test_units_are_applied_and_documented(csv_of, make_plan, tmp_path):
    source = csv_of(
        t=1e3 * TIME_S + 250, angle=np.degrees(ANGLE), torque=1e3 * TORQUE, fx=TORQUE, tz=TORQUE
    )
    plan = make_plan(
        angle="angle:deg",
        torque="torque:mN.m",
        time="t:ms",
        others={"fx_n": parse_choice("fx:kN", "force"), "tz_nm": parse_choice("#5:N.cm", "torque")},
        segments_s={"rest": (0, 0.5), "sweep": (0.5, 3.5), "ring_down": (3.5, 4)},
        angle_delay_s=1e-4,
        torque_delay_s=-2e-4,
        note="bench 3",
    )
    done = import_record(source, tmp_path / "bench.mcap", plan)
    session = read_session(done.path)
    samples = session.samples
    assert (done.samples, done.rate_hz, done.warnings) == (N, 1000.0, ())
    np.testing.assert_allclose(samples["angle_rad"], ANGLE, rtol=1e-15)
    np.testing.assert_allclose(samples["coupling_torque_nm"], TORQUE, rtol=1e-15)
    np.testing.assert_allclose(samples["fx_n"], 1e3 * TORQUE, rtol=1e-15)
    np.testing.assert_allclose(samples["tz_nm"], 1e-2 * TORQUE, rtol=1e-15)
    for absent in ("angle_reference_rad", "torque_command_nm", "fy_n", "status", "work_ns"):
        assert not samples[absent].any()
    np.testing.assert_array_equal(samples["tick"], np.arange(N))
    np.testing.assert_array_equal(samples["t_ns"], 1_000_000 * np.arange(N))
    assert session.segments == {"rest": (0, 500), "sweep": (500, 3500), "ring_down": (3500, 4000)}
    assert session.start_utc_ns == source.stat().st_mtime_ns
    assert session.outcome == {
        "scheduled": str(N), "recorded": str(N), "missed": "0", "lost": "0"
    }  # fmt: skip
    assert (
        session.metadata
        | {
            "id": "bench",
            "imported_from": "record.csv",
            "import_format": "CSV",
            "import_sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
            "import_time": "t:ms",
            "import_angle_rad": "angle:deg",
            "import_coupling_torque_nm": "torque:mN.m",
            "import_fx_n": "fx:kN",
            "import_tz_nm": "#5:N.cm",
            "angle_delay_s": "0.0001",
            "torque_delay_s": "-0.0002",
            "note": "bench 3",
            "beam_length_m": "0.98",
        }
        == session.metadata
    )
    record = load_record(done.path)
    assert (record.beam, record.sweep) == (BEAM, slice(500, 3500))
    assert record.warnings == ()


def test_stated_rate_replaces_times(csv_of, make_plan, tmp_path):
    source = csv_of(angle=ANGLE, torque=TORQUE)
    done = import_record(source, tmp_path / "a.mcap", make_plan(rate_hz=819.2))
    session = read_session(done.path)
    assert session.metadata["rate_hz"] == "819.2"
    assert session.metadata["import_time"] == "rate stated"
    np.testing.assert_array_equal(
        session.samples["t_ns"], [round(tick * 10**9 / 819.2) for tick in range(N)]
    )


def test_gaps_become_missing_ticks(csv_of, make_plan, tmp_path):
    present = np.delete(np.arange(N), [100, 101, 102, 2000])
    source = csv_of(t=TIME_S[present], angle=ANGLE[present], torque=TORQUE[present])
    done = import_record(source, tmp_path / "a.mcap", make_plan(time="t:s"))
    session = read_session(done.path)
    np.testing.assert_array_equal(session.samples["tick"], present)
    after_gap = np.flatnonzero(session.samples["status"])
    assert session.samples["tick"][after_gap].tolist() == [103, 2001]
    assert (session.samples["status"][after_gap] == Status.AFTER_LOST).all()
    assert session.outcome["lost"] == "4"
    assert any("4 samples are missing in 2 gaps" in warning for warning in done.warnings)
    assert load_record(done.path).gaps.missing_ticks == 4


def test_invalid_values_are_held_and_flagged(csv_of, make_plan, tmp_path):
    angle, torque = ANGLE.copy(), TORQUE.copy()
    angle[[0, 1, 500]] = np.nan, np.inf, -np.inf
    torque[[500, 600, 601]] = np.nan
    done = import_record(
        csv_of(angle=angle, torque=torque), tmp_path / "a.mcap", make_plan()
    )  # fmt: skip
    session = read_session(done.path)
    samples = session.samples
    assert samples["tick"][0] == 2
    assert np.isfinite(samples["angle_rad"]).all()
    assert np.isfinite(samples["coupling_torque_nm"]).all()
    stale = {int(s["tick"]): Status(int(s["status"])) for s in samples if s["status"]}
    assert stale == {
        2: Status.AFTER_LOST,
        500: Status.ANGLE_STALE | Status.WRENCH_STALE,
        600: Status.WRENCH_STALE,
        601: Status.WRENCH_STALE,
    }
    by_tick = dict(
        zip(samples["tick"].tolist(), samples["coupling_torque_nm"].tolist(), strict=True)
    )
    assert by_tick[600] == by_tick[601] == TORQUE[599]
    words = " ".join(done.warnings)
    assert "first 2 samples were left out" in words
    assert "1 samples of 'angle'" in words
    assert "3 samples of 'torque'" in words
    record = load_record(done.path)
    assert (record.gaps.sweep_stale_angles, record.gaps.sweep_stale_torques) == (1, 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"torque": np.where(np.arange(N) % 5 == 0, np.nan, TORQUE)}, ("'torque'", "800 of 4000")),
        ({"angle": np.full(N, np.nan)}, ("'angle'", "4000 of 4000")),
        ({"ref": np.where(np.arange(N) == 7, np.nan, 0.0)}, ("'ref'", "sample 8", "leave this")),
        ({"ref": np.full(N, 1e308)}, ("'ref'", "not finite in 4000")),
    ],
)
def test_too_many_missing_values_are_refused(csv_of, make_plan, tmp_path, change, words):
    columns = {"angle": ANGLE, "torque": TORQUE, "ref": np.zeros(N)} | change
    plan = make_plan(others={"angle_reference_rad": parse_choice("ref:rev", "angle")})
    with pytest.raises(ExchangeError) as refusal:
        import_record(csv_of(**columns), tmp_path / "a.mcap", plan)
    for word in ("record.csv", *words):
        assert word in str(refusal.value)
    assert [path.name for path in tmp_path.iterdir()] == ["record.csv"]


@pytest.mark.parametrize("segment", [(0, 4.01), (-1, 2), (2, 2), (3, 2)])
def test_a_segment_outside_the_record_is_refused(csv_of, make_plan, tmp_path, segment):
    source = csv_of(angle=ANGLE, torque=TORQUE)
    with pytest.raises(ExchangeError, match="which lasts 4 s"):
        import_record(source, tmp_path / "a.mcap", make_plan(segments_s={"sweep": segment}))


def test_unit_contradicted_by_the_file_is_refused(csv_of, make_plan, tmp_path):
    source = csv_of(**{"Angle [deg]": ANGLE, "torque": TORQUE})
    with pytest.raises(ExchangeError, match=r"is in deg, and rad was stated"):
        import_record(source, tmp_path / "a.mcap", make_plan(angle="Angle [deg]:rad"))
    with pytest.raises(ExchangeError, match=r"is in deg, and rad was stated.*'#1:deg'"):
        import_record(source, tmp_path / "a.mcap", make_plan(angle="#1:rad"))
    import_record(source, tmp_path / "a.mcap", make_plan(angle="Angle [deg]:deg"))
    plan = make_plan(angle="Angle [deg]:rad", ignore_file_metadata=True)
    done = import_record(source, tmp_path / "b.mcap", plan)
    assert "Ignored as requested: the file says that 'Angle [deg]' is in deg" in done.warnings[0]
    session = read_session(done.path)
    assert "is in deg, and rad was stated" in session.metadata["import_ignored"]
    np.testing.assert_array_equal(session.samples["angle_rad"], ANGLE)


@pytest.mark.parametrize(
    ("title", "unit"),
    [
        ("Tz (N·mm) ", "N.mm"),
        ("Tz [mNm]", "mN.m"),
        ("Tz [N.mm] (raw)", "N.mm"),
        ("Tz (kgf·cm) CH2", "kgf·cm"),
        ("Tz (raw)", None),
        ("Tz [Nm] CH2", None),
    ],
)
def test_unit_in_brackets_is_a_statement_of_the_file(csv_of, make_plan, tmp_path, title, unit):
    source = csv_of(**{"angle": ANGLE, title: TORQUE})
    plan = make_plan(torque=f"{title}:N.m")
    if unit is None:
        assert import_record(source, tmp_path / "a.mcap", plan).warnings == ()
    else:
        with pytest.raises(ExchangeError, match=f"is in {unit}, and N.m was stated"):
            import_record(source, tmp_path / "a.mcap", plan)


@pytest.mark.parametrize(
    ("angle", "torque", "suggestions"),
    [
        ("angle_deg:rad", "torque:N.m", ["suggests deg"]),
        ("angle_rad:rad", "coupling_torque_nm:mN.m", ["suggests N.m"]),
        ("motor_angle:rad", "coupling_torque_nm:N.m", []),
    ],
)
def test_name_that_suggests_another_unit_is_reported(
    csv_of, make_plan, tmp_path, angle, torque, suggestions
):
    names = (choice.rpartition(":")[0] for choice in (angle, torque))
    source = csv_of(**dict(zip(names, (ANGLE, TORQUE), strict=True)))
    done = import_record(source, tmp_path / "a.mcap", make_plan(angle=angle, torque=torque))
    assert len(done.warnings) == len(suggestions)
    for suggestion, warning in zip(suggestions, done.warnings, strict=True):
        assert suggestion in warning


def test_titles_state_units_of_columns_given_by_number(csv_of, make_plan, tmp_path):
    source = csv_of(t_s=TIME_S, Angle_deg=ANGLE, torque_nmm=TORQUE)
    done = import_record(source, tmp_path / "a.mcap", make_plan("#2:rad", "#3:N.m"))
    assert "'Angle_deg' suggests deg" in done.warnings[0]
    assert "'torque_nmm' suggests N.mm" in done.warnings[1]
    blanks = tmp_path / "blanks.txt"
    titles = "Time [s]  Motor angle [deg]  Torque [N.m]"
    blanks.write_text(
        source.read_text().replace(",", " ").replace("t_s Angle_deg torque_nmm", titles)
    )
    with pytest.raises(ExchangeError, match="'#2' is in deg, and rad was stated"):
        import_record(blanks, tmp_path / "b.mcap", make_plan("#2:rad", "#3:N.m"))


@pytest.mark.parametrize("unit", ["Grad", "DEG"])
def test_unit_of_unclear_spelling_is_compared(csv_of, make_plan, tmp_path, unit):
    source = csv_of(**{f"angle [{unit}]": ANGLE, "torque": TORQUE})
    done = import_record(source, tmp_path / "a.mcap", make_plan(f"angle [{unit}]:deg"))
    assert f"states '{unit}' for" in done.warnings[0]
    with pytest.raises(ExchangeError, match=f"is in {unit}, and rad was stated"):
        import_record(source, tmp_path / "b.mcap", make_plan(f"angle [{unit}]:rad"))


def test_stated_rate_and_unit_are_compared(make_plan, tmp_path):
    tdms = pytest.importorskip("nptdms", reason="TDMS needs npTDMS")
    source = tmp_path / "a.tdms"

    def channels(**properties):
        with tdms.TdmsWriter(str(source)) as writer:
            writer.write_segment(
                [
                    tdms.ChannelObject("g", "angle", ANGLE, properties),
                    tdms.ChannelObject("g", "torque", TORQUE, {"wf_increment": 1e-3}),
                ]
            )

    options = {"angle": "g/angle:deg", "torque": "g/torque:N.m"}
    channels(unit_string="rad")
    with pytest.raises(ExchangeError, match="is in rad, and deg was stated"):
        import_record(source, tmp_path / "a.mcap", make_plan(**options))
    channels(unit_string="V")
    with pytest.raises(ExchangeError, match="is in V, and deg was stated; state the value of one"):
        import_record(source, tmp_path / "a.mcap", make_plan(**options))
    options["angle"] = "g/angle:1 deg"
    done = import_record(source, tmp_path / "a.mcap", make_plan(**options))
    assert "states 'V' for 'g/angle'" in done.warnings[0]
    with pytest.raises(ExchangeError, match="'g/torque' was sampled at 1000 Hz, and 500 Hz was"):
        import_record(source, tmp_path / "b.mcap", make_plan(**options, rate_hz=500.0))


@pytest.fixture(scope="module")
def motion():
    """A sweep from 0.5 to 20 Hz and the torque of the damped beam for it, with noise of 5 mN·m."""
    time_s = np.arange(30_000) / 1000
    angle = 0.025 * np.sin(2 * np.pi * (0.5 + 19.5 / 60 * time_s) * time_s)
    angle *= np.minimum(1, np.minimum(time_s, time_s[::-1]))
    s = 1 / 30 + 2j * np.pi * np.fft.rfftfreq(1 << 17, 1e-3)
    decay = np.exp(-time_s / 30)
    g = transfer(s, BEAM, Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594))
    torque = np.fft.irfft(g * np.fft.rfft(angle * decay, 1 << 17), 1 << 17)[: len(angle)] / decay
    return angle, torque + 5e-3 * np.random.default_rng(1).normal(size=len(angle))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, ()),
        ({"angle": "angle:deg"}, ("57", "check the units")),
        further({"torque": "torque:mN.m"}, ("0.00", "check the units")),
        further({"torque": "torque:lbf.in"}, ("0.11", "check the units")),
        ({"reverse_torque": True}, ("opposite sign", "--reverse-torque")),
    ],
)
def test_wrong_units_and_sign_are_found_by_the_beam(
    csv_of, make_plan, tmp_path, motion, options, words
):
    source = csv_of(angle=motion[0], torque=motion[1])
    done = import_record(source, tmp_path / "a.mcap", make_plan(**options))
    assert len(done.warnings) == bool(words)
    for word in words:
        assert word in done.warnings[0]
    assert [event.message for event in read_session(done.path).events] == list(done.warnings)


@pytest.mark.parametrize("tool_inertia_kg_m2", [further(3e-4), 1e-3, further(4e-3)])
def test_tool_inertia_that_is_not_stated_is_no_wrong_sign(
    csv_of, make_plan, tmp_path, motion, tool_inertia_kg_m2
):
    angle_rad, torque_nm = motion
    acceleration = np.gradient(np.gradient(angle_rad, 1e-3), 1e-3)
    torque_nm = torque_nm + tool_inertia_kg_m2 * acceleration
    source = csv_of(angle=angle_rad, torque=torque_nm)
    done = import_record(source, tmp_path / "a.mcap", make_plan())
    assert done.warnings == ()
    done = import_record(source, tmp_path / "b.mcap", make_plan(angle="angle:deg"))
    assert "check the units" in done.warnings[0]
    done = import_record(source, tmp_path / "c.mcap", make_plan(reverse_torque=True))
    assert "opposite sign" in done.warnings[0]


def test_a_reaction_is_reversed(csv_of, make_plan, tmp_path, motion):
    source = csv_of(angle=motion[0], torque=-motion[1])
    done = import_record(source, tmp_path / "a.mcap", make_plan(reverse_torque=True))
    assert done.warnings == ()
    session = read_session(done.path)
    np.testing.assert_array_equal(session.samples["coupling_torque_nm"], motion[1])
    assert session.metadata["import_coupling_torque_nm"] == "torque:N.m, reversed"


def test_nothing_is_overwritten_or_left_behind(csv_of, make_plan, tmp_path, monkeypatch):
    source = csv_of(angle=ANGLE, torque=TORQUE)
    import_record(source, tmp_path / "a.mcap", make_plan())
    before = (tmp_path / "a.mcap").read_bytes()
    with pytest.raises(SessionExistsError):
        import_record(source, tmp_path / "a.mcap", make_plan())
    assert (tmp_path / "a.mcap").read_bytes() == before
    with pytest.raises(SessionError, match="cannot be written"):
        import_record(source, tmp_path / "absent" / "a.mcap", make_plan())
    monkeypatch.setattr("rigd.session.SessionWriter.close", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        import_record(source, tmp_path / "b.mcap", make_plan())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "record.csv"]


def test_incomplete_plan_is_refused(profile):
    specimen = read_specimen(profile)
    choice = parse_choice("a:rad", "angle")
    both = {"angle_rad": choice, "coupling_torque_nm": choice}
    with pytest.raises(ValueError, match="coupling_torque_nm"):
        ImportPlan({"angle_rad": choice}, specimen, rate_hz=1.0)
    for times in ({}, {"rate_hz": 1.0, "time": choice}):
        with pytest.raises(ValueError, match="either"):
            ImportPlan(both, specimen, **times)


def test_specimen_from_a_profile_or_three_lines(profile, tmp_path):
    specimen = read_specimen(profile)
    assert (specimen.beam, specimen.tool_inertia_kg_m2) == (BEAM, 0.0)
    path = tmp_path / "beam.toml"
    path.write_text(
        "[beam]\nlength_m = 1\ndensity_kg_per_m = 5e-3\nbending_stiffness_n_m2 = 0.1\n"
        "[sensor]\ntool_inertia_kg_m2 = { value = 1e-5, source = 'measured' }\n"
        "[uncertainty]\nlength_percent = 0.1\nuniformity_percent = 0\n"
    )
    specimen = read_specimen(path)
    assert (specimen.beam.length_m, specimen.tool_inertia_kg_m2) == (1.0, 1e-5)
    assert (specimen.uncertainty_percent, specimen.uniformity_percent) == ({"length": 0.1}, 0.0)


def test_a_profile_may_have_sections_of_installed_packages(profile, tmp_path):
    path = tmp_path / "rig.toml"
    for shipped in profile.parent.glob("*.toml"):
        text = shipped.read_text(encoding="utf-8")
        path.write_text(f"{text}\n[netft]\nhost = 'box'\n", encoding="utf-8")
        assert read_specimen(path).beam.length_m > 0.0


def test_an_import_knows_every_section_and_key_of_a_profile(tmp_path):
    path = tmp_path / "rig.toml"
    beam = {"length_m": 1.0, "density_kg_per_m": 5e-3, "bending_stiffness_n_m2": 0.1}
    for section, settings in SECTIONS.items():
        for key in fields(settings):
            document = {"beam": beam.copy()}
            document.setdefault(section, {}).setdefault(key.name, 0.01)
            path.write_text(
                "".join(
                    f"[{name}]\n" + "".join(f"{k} = {value}\n" for k, value in values.items())
                    for name, values in document.items()
                )
            )
            assert read_specimen(path).beam.length_m == 1.0, f"{section}.{key.name}"


def test_tip_mass_and_tilt_of_a_profile_go_into_the_session(csv_of, make_plan, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(
        "[rig]\naxis_tilt_deg = -0.3\n[beam]\nlength_m = 0.98\ndensity_kg_per_m = 4.7e-3\n"
        "bending_stiffness_n_m2 = 0.090275\n"
        "tip_mass_kg = { value = 1e-4, source = 'measured' }\n"
    )
    plan = replace(make_plan(rate_hz=1e3), specimen=read_specimen(path))
    done = import_record(csv_of(angle=ANGLE, torque=TORQUE), tmp_path / "a.mcap", plan)
    record = load_record(done.path)
    assert (record.beam, record.tip_mass_kg, record.axis_tilt_deg) == (BEAM, 1e-4, -0.3)


@pytest.mark.parametrize(("percent", "uniformity"), [(None, 1e-3), (0.0, 0.0), (0.5, 5e-3)])
def test_the_uniformity_of_the_specimen_goes_into_the_session(
    csv_of, make_plan, tmp_path, percent, uniformity
):
    plan = make_plan(rate_hz=1e3)
    plan = replace(plan, specimen=replace(plan.specimen, uniformity_percent=percent))
    done = import_record(csv_of(angle=ANGLE, torque=TORQUE), tmp_path / "a.mcap", plan)
    assert load_record(done.path).uniformity == uniformity


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("no beam.length_m", "in m", "[beam]")),
        ("beam = 3", ("beam is not a section",)),
        ("[beam]\nlength_m = 'long'", ("beam.length_m is 'long'", "number in m")),
        ("[beam]\nlength_m = true", ("beam.length_m is True",)),
        ("[beam]\nlength_m = 0", ("beam.length_m is 0 m", "positive")),
        ("[beam]\nlength_m = nan", ("beam.length_m is nan",)),
        ("[beam]\nlength_m = 1e300", ("beam.length_m is 1e+300 m", "between 1e-09 and 1e+09")),
        ("[beam]\nlength_m = 1e-300", ("beam.length_m is 1e-300 m", "between")),
        ("[beam]\nlength_m = {value = 1}\ndensity_kg_per_m = {}", ("beam.density_kg_per_m",)),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[uncertainty]\nlength_percent = 51",
            ("uncertainty.length_percent is 51 %", "50"),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[uncertainty]\nuniformity_percent = 11",
            ("uncertainty.uniformity_percent is 11 %", "10"),
        ),
        (
            "[rig]\naxis_tilt_deg = 91\n"
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n",
            ("rig.axis_tilt_deg is 91 °", "between -90 and 90"),
        ),
        ("[sensor]\ntool_inertia_kg_m2 = -1.0", ("sensor.tool_inertia_kg_m2", "negative")),
        ("[beam", ("not valid TOML",)),
        ("a = " + "[\n" * 100_000, ("nested too deeply",)),
        ("#" * 250_001, ("at most 0.25 MB",)),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "tip_mass_g = 5",
            ("beam.tip_mass_g is unknown; write tip_mass_kg, in kg",),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "axis_tilt_deg = 1",
            ("write it in section [rig]",),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[sensor]\ntool_inertia = 1e-4",
            ("sensor.tool_inertia is unknown; write tool_inertia_kg_m2",),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[rig]\naxis_tilt = 2",
            ("rig.axis_tilt is unknown",),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[Sensor]\ntool_inertia_kg_m2 = 1e-4",
            ("[Sensor] is unknown; write [sensor].",),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[uncertaintty]\nlength_percent = 1\n[devices]\ndrive = 'x'",
            ("write [uncertainty].",),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[clamp]\ninertia = 1",
            ("the section [clamp] is unknown; remove it",),
        ),
        (
            "[beam]\nlength_m = 1\ndensity_kg_per_m = 1\nbending_stiffness_n_m2 = 1\n"
            "[rig]\naxis_tilt_deg = { value = 5, unit = 'mrad' }",
            ("the unknown part 'unit'; state the value in °",),
        ),
        ("tip_mass_kg = 1\n[beam]\nlength_m = 1", ("tip_mass_kg is in no section",)),
    ],
)
def test_invalid_specimen_is_refused(tmp_path, text, words):
    path = tmp_path / "beam.toml"
    path.write_text(text)
    with pytest.raises(ExchangeError) as refusal:
        read_specimen(path)
    for word in ("beam.toml", *words):
        assert word in str(refusal.value)


def test_unreadable_specimen_is_refused(tmp_path):
    with pytest.raises(ExchangeError, match="cannot be read"):
        read_specimen(tmp_path / "absent.toml")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_specimen_may_begin_with_a_byte_order_mark(profile, tmp_path, encoding):
    path = tmp_path / "beam.toml"
    path.write_text(profile.read_text("utf-8"), encoding)
    assert read_specimen(path) == read_specimen(profile)


@pytest.mark.parametrize("year", [2300, 1960])
def test_impossible_time_stamp_is_ignored(csv_of, make_plan, tmp_path, year):
    source = csv_of(angle=ANGLE, torque=TORQUE)
    seconds = (year - 1970) * 365.2425 * 86_400
    os.utime(source, (seconds, seconds))
    begun_ns = time.time_ns()
    done = import_record(source, tmp_path / "a.mcap", make_plan())
    assert f"about the year {year}" in done.warnings[-1]
    assert begun_ns <= read_session(done.path).start_utc_ns <= time.time_ns()


def test_immediate_write_error_leaves_nothing(tmp_path):
    samples = {"tick": np.arange(3), "angle_rad": np.zeros(3)}
    with pytest.raises(Exception, match=r"."):
        write_session(tmp_path / "a.mcap", samples, 1000.0, 2**64, {}, {}, ("a warning",))
    assert list(tmp_path.iterdir()) == []


def tdms_of(path, *channels):
    tdms = pytest.importorskip("nptdms", reason="TDMS needs npTDMS")
    with tdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([tdms.ChannelObject("g", *each) for each in channels])
    return path


START = np.datetime64("2026-11-25T12:00:00.000000")


@pytest.mark.parametrize(("micros", "skip", "delay_s"), [(8000, 8, 0.0), (8300, 8, -3e-4)])
def test_late_channels_are_cut_with_a_residual_delay(make_plan, tmp_path, micros, skip, delay_s):
    later = START + np.timedelta64(micros, "us")
    source = tdms_of(
        tmp_path / "a.tdms",
        ("angle", ANGLE[:-8], {"wf_increment": 1e-3, "wf_start_time": START}),
        ("torque", TORQUE[8:], {"wf_increment": 1e-3, "wf_start_time": later}),
    )
    plan = make_plan("g/angle:rad", "g/torque:N.m", torque_delay_s=1e-3)
    done = import_record(source, tmp_path / "a.mcap", plan)
    session = read_session(done.path)
    np.testing.assert_array_equal(session.samples["angle_rad"], ANGLE[skip:-8])
    np.testing.assert_array_equal(session.samples["coupling_torque_nm"], TORQUE[8 : N - skip])
    assert float(session.metadata["torque_delay_s"]) == pytest.approx(1e-3 + delay_s, abs=1e-9)
    assert float(session.metadata["angle_delay_s"]) == 0.0
    for word in ("12:00:00 and", f"12:00:00.{micros // 100:04d}".rstrip("0"), "8 of 'g/angle'"):
        assert word in done.warnings[0]


def test_channels_without_a_common_time_or_of_other_lengths_are_refused(make_plan, tmp_path):
    hour = START + np.timedelta64(1, "h")
    plan = make_plan("g/angle:rad", "g/torque:N.m")
    for torque, properties, words in (
        (TORQUE, {"wf_start_time": hour}, "12:00:00 and 'g/torque' at 2026-11-25T13:00:00"),
        (TORQUE[1:], {}, "g/angle 4000, g/torque 3999"),
    ):
        source = tdms_of(
            tmp_path / "a.tdms",
            ("angle", ANGLE, {"wf_start_time": START}),
            ("torque", torque, properties),
        )
        with pytest.raises(ExchangeError, match=words):
            import_record(source, tmp_path / "a.mcap", plan)


def test_unknown_scale_is_refused_by_name(make_plan, tmp_path):
    scale = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Reciprocal"}
    source = tdms_of(tmp_path / "a.tdms", ("angle", ANGLE), ("torque", TORQUE, scale))
    with pytest.raises(ExchangeError, match=r"'g/torque' are raw.*Reciprocal"):
        import_record(source, tmp_path / "a.mcap", make_plan("g/angle:rad", "g/torque:N.m"))
    plan = make_plan("g/angle:rad", "g/torque:2 N.m", ignore_file_metadata=True)
    session = read_session(import_record(source, tmp_path / "a.mcap", plan).path)
    np.testing.assert_array_equal(session.samples["coupling_torque_nm"], 2 * TORQUE)
    assert "Reciprocal" in session.metadata["import_ignored"]


def test_default_rate_of_labview_is_overridden(make_plan, tmp_path):
    waveform = {"wf_increment": 1.0, "wf_start_offset": 0.0}
    source = tdms_of(
        tmp_path / "a.tdms",
        ("when", TIME_S),
        ("angle", ANGLE, waveform),
        ("torque", TORQUE, waveform),
    )
    names = ("g/angle:rad", "g/torque:N.m")
    with pytest.raises(
        ExchangeError, match=r"at 1 Hz, which programs write.*--time.*--ignore-file"
    ):
        import_record(source, tmp_path / "a.mcap", make_plan(*names))
    for name, plan in (
        ("a.mcap", make_plan(*names, time="g/when:s")),
        ("b.mcap", make_plan(*names, ignore_file_metadata=True)),
    ):
        done = import_record(source, tmp_path / name, plan)
        assert done.rate_hz == 1000.0
        assert "at 1 Hz" in done.warnings[0]


def test_times_of_the_file_are_compared_with_the_rate(csv_of, make_plan, tmp_path):
    for times, words in (
        (2 * TIME_S, "'t' show 500 Hz, and 1000 Hz was stated; give --time 't:UNIT'"),
        (np.where(np.arange(N) < 2000, TIME_S, TIME_S + 3e-3), "gaps of 3 samples"),
        (np.concatenate([TIME_S[:2000], TIME_S[:2000]]), "'t' go back at sample 2001"),
        (np.sort(np.append(TIME_S[:-1], TIME_S[70])), "'t' of sample 72 is that of the one before"),
    ):
        source = csv_of(t=times, angle=ANGLE, torque=TORQUE)
        with pytest.raises(ExchangeError, match=words):
            import_record(source, tmp_path / "a.mcap", make_plan())
    source = csv_of(t=1e3 * TIME_S + 5, angle=ANGLE, torque=TORQUE)
    assert import_record(source, tmp_path / "a.mcap", make_plan()).warnings == ()


def test_times_of_too_few_digits_confirm_their_true_rate_only(csv_of, make_plan, tmp_path):
    source = csv_of(t=np.round(np.arange(N) / 999, 3), angle=ANGLE, torque=TORQUE)
    for options, words in (
        ({"time": "t:s"}, "'t' have too few digits.* give --rate-hz 999 instead"),
        ({"rate_hz": 1000.0}, "'t' show 999 Hz, and 1000 Hz was stated"),
    ):
        with pytest.raises(ExchangeError, match=words):
            import_record(source, tmp_path / "a.mcap", make_plan(**options))
    assert import_record(source, tmp_path / "a.mcap", make_plan(rate_hz=999.0)).rate_hz == 999.0
