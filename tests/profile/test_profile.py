"""Profiles: the shipped one, and all kinds of mistakes."""

import dataclasses
import os
import pickle
import re
from functools import partial
from pathlib import Path

import pytest

from rigd.beam import Beam, Damping
from rigd.control import check_stability, close_loop
from rigd.profile import ProfileError, load_profile


@pytest.fixture
def refuse(complaints_of, sim_toml):
    """Change the shipped profile, load it, and return the lines of the complaint."""
    return partial(complaints_of, sim_toml)


INERTIA = 'inertia_kg_m2 = { value = 2.0e-3, source = "assumed" }'


def test_shipped_profile_is_the_papers_antenna(profile):
    assert profile.rig.beam == Beam(0.98, 4.7e-3, 0.090275)
    assert profile.rig.damping == Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)
    assert profile.rig.rate_hz == 1000.0
    assert profile.rig.encoder.resolution_rad == 7e-5
    assert profile.rig.simulation is not None


def test_shipped_profile_is_stable(profile):
    assert check_stability(close_loop(profile.loop_model())) is None


def test_the_loop_has_the_values_of_the_rig(profile):
    rig = profile.rig
    rig = dataclasses.replace(
        rig,
        actuation=dataclasses.replace(rig.actuation, delay_s=1e-4),
        encoder=dataclasses.replace(rig.encoder, delay_s=2e-4),
        sensor=dataclasses.replace(rig.sensor, delay_s=3e-4, tool_inertia_kg_m2=1e-5),
    )
    model = dataclasses.replace(profile, rig=rig).loop_model()
    assert (model.actuation_delay_s, model.angle_delay_s, model.torque_delay_s) == (
        1e-4,
        2e-4,
        3e-4,
    )
    assert model.plant.tool_inertia_kg_m2 == 1e-5
    assert (model.motor_inertia_kg_m2, model.viscous_nm_s_per_rad) == (
        rig.motor.inertia_kg_m2,
        rig.motor.viscous_nm_s_per_rad,
    )
    assert model.rate_hz == rig.rate_hz
    assert (model.plant.beam, model.plant.damping) == (rig.beam, rig.damping)
    assert model.plant.delay_s == 3e-4 - 2e-4
    assert model.settings is profile.control


def test_every_number_has_a_source(profile):
    sources = profile.sources
    assert sources["beam.length_m"] == "paper"
    assert sources["motor.inertia_kg_m2"] == "assumed"
    assert set(sources.values()) <= {"paper", "datasheet", "measured", "assumed"}
    numbers = re.findall(r"^\w+ = \{", profile.text, re.MULTILINE)
    assert len(sources) == len(numbers) > 40


def test_profile_is_frozen_and_picklable(profile):
    assert pickle.loads(pickle.dumps(profile)) == profile
    with pytest.raises(dataclasses.FrozenInstanceError):
        profile.name = "other"


def test_path_and_name_find_the_same_profile():
    profile = load_profile("sim")
    assert load_profile(profile.path) == profile
    assert load_profile(str(profile.path)).rig == profile.rig


def test_a_profile_of_the_working_directory_is_found(tmp_path, monkeypatch, sim_toml):
    (tmp_path / "hw_profiles").mkdir()
    (tmp_path / "hw_profiles/mine.toml").write_text(
        sim_toml.replace('name = "sim"', 'name = "mine"'), encoding="utf-8"
    )
    monkeypatch.chdir(tmp_path)
    assert load_profile("mine").name == "mine"


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_profile_may_begin_with_a_byte_order_mark(tmp_path, sim_toml, encoding):
    path = tmp_path / "marked.toml"
    path.write_text(sim_toml, encoding)
    assert load_profile(path).text == sim_toml


def test_an_unknown_name_lists_the_known_ones():
    how = r"no profile 'simm'; known profiles are .*sim.*by 'rigd profiles copy sim simm'"
    with pytest.raises(ProfileError, match=how):
        load_profile("simm")


def test_a_missing_file_is_named():
    with pytest.raises(ProfileError, match=r"nowhere/rig\.toml: there is no such file"):
        load_profile("nowhere/rig.toml")


def test_a_folder_is_no_profile(tmp_path):
    folder = tmp_path / "x.toml"
    folder.mkdir()
    with pytest.raises(ProfileError, match=r"x\.toml: there is no such file"):
        load_profile(folder)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every file")
def test_an_unreadable_file_is_named(tmp_path):
    path = tmp_path / "rig.toml"
    path.touch(mode=0)
    with pytest.raises(ProfileError, match="cannot be read"):
        load_profile(path)


def test_a_binary_file_is_named(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(ProfileError, match=r"rig\.toml: is not a text file"):
        load_profile(path)


def test_a_syntax_error_has_its_line(refuse):
    [line] = refuse(("[motor]", "[motor"))
    assert re.search(r"not valid TOML: .*line \d+", line)


def test_an_unknown_key_names_the_closest_one_and_its_unit(refuse):
    lines = refuse((INERTIA, INERTIA.replace("inertia", "inertai")))
    assert "motor.inertai_kg_m2 is unknown; did you mean motor.inertia_kg_m2, in kg·m²?" in lines
    assert len(lines) == 2  # and the right one is missing


def test_a_wrong_unit_is_reported_with_the_right_one(refuse):
    lines = refuse((INERTIA, 'inertia_g_cm2 = { value = 2.0e4, source = "assumed" }'))
    assert (
        "motor.inertia_g_cm2 = 20000 has the wrong unit ('g_cm2'); "
        "write motor.inertia_kg_m2, the value in kg·m²." in lines
    )


def test_a_loop_too_slow_to_be_watched_is_refused(refuse):
    [line] = refuse(("rate_hz = { value = 1000.0", "rate_hz = { value = 20.0"))
    assert "rig.rate_hz" in line
    assert "100" in line


def test_a_missing_key_is_named_with_its_unit(refuse):
    [line] = refuse((INERTIA, ""))
    assert line.startswith("motor.inertia_kg_m2 is missing")
    assert "kg·m²" in line


def test_a_missing_section_is_named_once(refuse, sim_toml):
    section = sim_toml[sim_toml.index("[encoder]") : sim_toml.index("[sensor]")]
    assert refuse((section, "")) == ["section [encoder] is missing."]


def test_defaults_of_the_code_are_required_in_a_profile(refuse, sim_toml):
    section = sim_toml[sim_toml.index("[beam.damping]") : sim_toml.index("[motor]")]
    assert refuse((section, "")) == ["section [beam.damping] is missing."]
    [line] = refuse(("tool_inertia_kg_m2 = { value = 0.0, source", "# { value = 0.0, source"))
    assert line.startswith("sensor.tool_inertia_kg_m2 is missing")


def test_a_section_must_be_a_table(refuse, sim_toml):
    section = sim_toml[sim_toml.index("[encoder]") : sim_toml.index("[sensor]")]
    lines = refuse((section, ""), ("[rig]", "encoder = 3\n[rig]"))
    assert "encoder = 3 must be a section; write [encoder] and its keys below." in lines


def test_an_unknown_section_names_the_closest(refuse):
    lines = refuse(("[encoder]", "[enkoder]"))
    assert "section [encoder] is missing." in lines
    assert any("enkoder.resolution_rad" in line and "[encoder]" in line for line in lines)


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        ("nan", "= nan kg·m² must be a finite number"),
        ("inf", "= inf kg·m² must be a finite number"),
        ("-1.0", "= -1 kg·m² must be more than 0"),
        ("0.0", "= 0 kg·m² must be more than 0"),
        ('"2e-3"', '= "2e-3" kg·m² must be a number'),
        ("true", "= true kg·m² must be a number"),
        ("[1.0]", "= [1] kg·m² must be a number"),
    ],
)
def test_bad_values_are_named_with_their_unit(refuse, value, complaint):
    [line] = refuse((INERTIA, INERTIA.replace("2.0e-3", value)))
    assert line.startswith(f"motor.inertia_kg_m2 {complaint}")


def test_a_whole_number_must_be_whole(refuse):
    [line] = refuse(("priority = { value = 80", "priority = { value = 80.5"))
    assert line.startswith("realtime.priority = 80.5 must be a whole number")


def test_six_numbers_must_be_six(refuse):
    [line] = refuse(("[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]", "[0.0, 1.0]"))
    assert line.startswith("sensor.projection")
    assert "six numbers" in line


def test_one_bad_number_of_six_is_named(refuse):
    [line] = refuse(("[20.0, 20.0, 60.0,", "[20.0, -20.0, 60.0,"))
    assert line.startswith("sensor.range[1] = -20 ")


def test_a_number_without_a_source_is_refused(refuse):
    [line] = refuse((INERTIA, "inertia_kg_m2 = { value = 2.0e-3 }"))
    assert line.startswith("motor.inertia_kg_m2 has no source")
    [line] = refuse((INERTIA, "inertia_kg_m2 = 2.0e-3"))
    assert line.startswith("motor.inertia_kg_m2 = 0.002 kg·m² does not state its source")


def test_a_made_up_source_is_refused(refuse):
    [line] = refuse((INERTIA, INERTIA.replace("assumed", "guess")))
    assert 'source = "guess"' in line
    assert '"datasheet"' in line


def test_only_value_and_source_are_allowed(refuse):
    [line] = refuse((INERTIA, INERTIA.replace(" }", ", error = 0.1 }")))
    assert "unknown part 'error'" in line


@pytest.mark.parametrize(
    ("old", "new"),
    [("value = 7.1e-5", "value = -7.1e-5"), ("value = 0.594", "value = 2.0")],
)
def test_damping_that_is_unstable_by_nature_is_refused(refuse, old, new):
    [line] = refuse((old, new))
    assert line.startswith("beam.damping.")
    assert "unstable beam" in line


def test_a_peak_below_the_rated_torque_is_refused(refuse):
    [line] = refuse(("peak_torque_nm = { value = 0.9", "peak_torque_nm = { value = 0.4"))
    assert "motor.peak_torque_nm = 0.4 N·m is below motor.rated_torque_nm = 0.5 N·m" in line


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            "continuous_torque_nm = { value = 0.9",
            "continuous_torque_nm = { value = 1.0",
            "motor.continuous_torque_nm = 1 N·m is above motor.peak_torque_nm = 0.9 N·m",
        ),
        (
            "torque_command_nm = { value = 60.0",
            "torque_command_nm = { value = 0.8",
            "limits.torque_command_nm = 0.8 N·m is below motor.peak_torque_nm = 0.9 N·m",
        ),
        (
            "stop_angle_rad = { value = 3.14",
            "stop_angle_rad = { value = 1.5",
            "limits.stop_angle_rad = 1.5 rad is not above limits.angle_rad = 1.57 rad",
        ),
        (
            "tare_drift_nm = { value = 1.0e-2",
            "tare_drift_nm = { value = 1.0e-3",
            "limits.tare_drift_nm = 0.001 N·m, which ends a session, is below",
        ),
        (
            "acceleration_rad_s2 = { value = 2000.0",
            "acceleration_rad_s2 = { value = 0.0",
            "limits.acceleration_rad_s2 = 0 rad/s² must be more than 0",
        ),
        (
            "acceleration_rad_s2 = { value = 2000.0",
            "acceleration_rad_s2 = { value = 1.0e12",
            "limits.acceleration_rad_s2 = 1e+12 rad/s² cannot detect a jump of the encoder: it is "
            "more than 100 times the 450 rad/s² that the peak torque gives",
        ),
        (
            "tracking_error_rad = { value = 0.5",
            "tracking_error_rad = { value = 1000.0",
            "limits.tracking_error_rad = 1000 rad can never be exceeded: reference and angle are "
            "within limits.angle_rad = 1.57 rad to either side; choose less than 3.14 rad",
        ),
        (
            "velocity_rad_s = { value = 15.0",
            "velocity_rad_s = { value = 54.0",
            "limits.velocity_rad_s = 54 rad/s can never be exceeded: the peak torque accelerates "
            "the motor alone to 53.16 rad/s between",
        ),
        (
            "recorder_lag_s = { value = 12.0",
            "recorder_lag_s = { value = 20.0",
            "limits.recorder_lag_s = 20 s can never be exceeded: shared memory holds 16 s",
        ),
        (
            "missed_percent = { value = 10.0",
            "missed_percent = { value = 100.0",
            "limits.missed_percent = 100 % must be less than 100",
        ),
        (
            "stale_percent = { value = 1.0",
            "stale_percent = { value = 100.0",
            "limits.stale_percent = 100 % must be less than 100",
        ),
        (
            "disk_free_mb = { value = 50.0",
            "disk_free_mb = { value = -1.0",
            "limits.disk_free_mb = -1 MB must be more than 0",
        ),
    ],
)
def test_limits_that_contradict_each_other_are_refused(refuse, old, new, complaint):
    [line] = refuse((old, new))
    assert line.startswith(complaint)


def test_a_pole_too_slow_for_the_motor_is_refused(refuse):
    [line] = refuse(("pole_rad_s = { value = 80.0", "pole_rad_s = { value = 2.0"))
    assert line.startswith("control.pole_rad_s = 2 rad/s is too slow")


def test_simulated_devices_need_their_section(refuse, sim_toml):
    [line] = refuse((sim_toml[sim_toml.index("[simulation]") :], ""))
    assert "[simulation] is missing" in line


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("clamp_compliance_rad_per_nm", 0.02),
        ("tip_mass_kg", 1e-4),
        ("torque_filter_hz", 100.0),
        ("stiffness_drift_per_s", -1e-5),
    ],
)
def test_unsupported_settings_with_air_drag_are_refused(loaded, refuse, sim_toml, name, value):
    def with_extras(**extras):
        more = [f'{key} = {{ value = {extras[key]}, source = "assumed" }}' for key in extras]
        return sim_toml, "\n".join([sim_toml, *more, ""])

    [line] = refuse(with_extras(air_drag_m=2.3e-3, **{name: value}))
    assert line.startswith(f"simulation.{name} and simulation.air_drag_m cannot be simulated")
    for one in ({name: value, "air_drag_m": 0.0}, {name: 0.0, "air_drag_m": 2.3e-3}):
        loaded(with_extras(**one)[1])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"hum_nm": -1e-3}, "simulation.hum_nm = -0.001 N·m must be at least 0."),
        ({"hum_hz": 0.0}, "simulation.hum_hz = 0 Hz must be more than 0."),
        (
            {"hum_nm": 5e-3, "hum_hz": 500.0},
            "simulation.hum_hz = 500 Hz is not below half of the 1000 readings that the simulated "
            "sensor takes each second; choose less than 500 Hz",
        ),
        (
            {"stiffness_drift_per_s": 0.01},
            "simulation.stiffness_drift_per_s = 0.01 1/s must be at most 0.001.",
        ),
        (
            {"stiffness_drift_per_s": -0.01},
            "simulation.stiffness_drift_per_s = -0.01 1/s must be at least -0.001.",
        ),
    ],
)
def test_unsupported_disturbances_are_refused(refuse, sim_toml, more, message):
    lines = [f'{key} = {{ value = {more[key]}, source = "assumed" }}' for key in more]
    [line] = refuse((sim_toml, "\n".join([sim_toml, *lines, ""])))
    assert line.startswith(message)


def test_a_hum_of_a_stream_may_exceed_the_tick_rate(loaded):
    path = Path(__file__).resolve().parents[2] / "hw_profiles" / "antenna_serial.toml"
    lines = [
        f'{key} = {{ value = {value}, source = "assumed" }}'
        for key, value in (("hum_nm", 1e-3), ("hum_hz", 700.0))
    ]
    text = path.read_text(encoding="utf-8")
    assert text.count("[simulation]\n") == 1
    text = text.replace("[simulation]\n", "\n".join(["[simulation]", *lines, ""]))
    assert loaded(text).rig.simulation.hum_hz == 700.0


def test_a_zero_projection_is_refused(refuse):
    [line] = refuse(("0.0, 0.0, 1.0]", "0.0, 0.0, 0.0]"))
    assert line.startswith("sensor.projection is all zero")


def test_a_shear_equal_to_the_torque_is_refused(refuse):
    [line] = refuse(("[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]", "[0.0, 0.0, 0.0, 0.0, 0.0, 2.0]"))
    assert line.startswith("sensor.shear_projection = [0, 0, 0, 0, 0, 2] is a multiple of")


def test_the_base_shear_is_optional(loaded, sim_toml):
    lines = [line for line in sim_toml.splitlines() if not line.startswith("shear_projection")]
    profile = loaded("\n".join(lines))
    assert profile.rig.sensor.shear_projection == (0.0,) * 6


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        ("x=0.5", "simulation.obstacles: Obstacle 'x=0.5': 'angle' is missing"),
        ("x=1.5,angle=1", "simulation.obstacles: Obstacle 'x=1.5,angle=1': x=1.5 m lies beyond"),
    ],
)
def test_obstacles_are_checked(refuse, sim_toml, obstacle, message):
    [line] = refuse((sim_toml, f'{sim_toml}\nobstacles = ["{obstacle}"]\n'))
    assert line.startswith(message)


def test_unsupported_settings_with_an_obstacle_are_refused(refuse, sim_toml):
    more = 'obstacles = ["x=0.5,angle=1"]\ntip_mass_kg = { value = 1e-3, source = "assumed" }\n'
    [line] = refuse((sim_toml, f"{sim_toml}\n{more}"))
    assert line.startswith("simulation.obstacles: simulation.tip_mass_kg and an obstacle")


def test_all_problems_are_reported_at_once(refuse):
    lines = refuse(
        (INERTIA, INERTIA.replace("2.0e-3", "nan")),
        ("tare_s = { value = 1.0", "tare_s = { value = 0.1"),
        ('name = "sim"\n', ""),
        ("rate_hz =", "rate_khz ="),
    )
    assert len(lines) == 5
    assert any(line.startswith("session.tare_s = 0.1 s must be at least 0.5") for line in lines)
    assert any("rig.rate_khz" in line and "rig.rate_hz" in line for line in lines)
    assert any(line.startswith("name is missing") for line in lines)


def test_the_shipped_profile_is_in_hw_profiles(profile):
    assert profile.path == Path(__file__).resolve().parents[2] / "hw_profiles" / "sim.toml"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("acceleration_rad_s2 = { value = 2000.0", "acceleration_rad_s2 = { value = 45000.0"),
        ("tracking_error_rad = { value = 0.5", "tracking_error_rad = { value = 3.1"),
        ("velocity_rad_s = { value = 15.0", "velocity_rad_s = { value = 53.0"),
        ("recorder_lag_s = { value = 12.0", "recorder_lag_s = { value = 15.9"),
    ],
)
def test_barely_exceedable_limits_are_accepted(sim_toml, tmp_path, old, new):
    assert old in sim_toml
    path = tmp_path / "rig.toml"
    path.write_text(sim_toml.replace(old, new), encoding="utf-8")
    load_profile(path)


def test_the_seed_of_the_noise_is_an_optional_integer(sim_toml, tmp_path):
    path = tmp_path / "sim.toml"
    commented = next(line for line in sim_toml.splitlines() if line.startswith("# seed = "))
    for value, refused in (("5", ""), ("-1", "-1"), ("1.5", "1.5"), ('"a"', '"a"')):
        line = commented.removeprefix("# ").replace("value = 1", f"value = {value}")
        path.write_text(sim_toml.replace(commented, line), encoding="utf-8")
        if not refused:
            assert load_profile(path).rig.simulation.seed == int(value)
            continue
        with pytest.raises(ProfileError) as caught:
            load_profile(path)
        assert "simulation.seed" in str(caught.value)
        assert refused in str(caught.value)
        assert len(str(caught.value).splitlines()) == 1, str(caught.value)
