"""Specimens in their own files: found by name, validated like profiles, mounted on a rig."""

import re
from dataclasses import replace

import pytest

from rigd.beam import Beam, Damping
from rigd.profile import ProfileError, load_profile, load_specimen, specimen_files, with_specimen
from rigd.testing import write_profile

BEAM = """
note = "steel"

[beam]
length_m = { value = 0.95, source = "measured" }
density_kg_per_m = { value = 4.7e-3, source = "datasheet" }
bending_stiffness_n_m2 = { value = 0.0903, source = "assumed" }
"""
DAMPING = """
[beam.damping]
alpha = { value = 1.0, source = "assumed" }
zeta = { value = 8.0e-5, source = "assumed" }
lambda = { value = 0.6, source = "assumed" }
gamma = { value = 5.0e-2, source = "assumed" }
"""


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write the file of a specimen into a folder of the working folder."""
    monkeypatch.chdir(tmp_path)

    def write(text, name="antenna 4", folder="specimens"):
        path = tmp_path / folder / f"{name}.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_a_specimen_has_a_beam_and_may_have_damping(write):
    specimen = load_specimen(write(BEAM))
    assert (specimen.name, specimen.note) == ("antenna 4", "steel")
    assert specimen.beam == Beam(0.95, 4.7e-3, 0.0903)
    assert specimen.damping is None
    assert load_specimen(write(BEAM + DAMPING)).damping == Damping(8e-5, 1.0, 5e-2, 0.6)


def test_its_beam_replaces_that_of_the_profile(write):
    path = write(BEAM)
    profile = load_profile("sim")
    mounted = with_specimen(profile, " antenna 4 ")
    assert mounted.rig.beam == mounted.loop_model().plant.beam == Beam(0.95, 4.7e-3, 0.0903)
    assert mounted.rig.damping == profile.rig.damping
    assert mounted.specimen.text == path.read_text()
    words = mounted.specimen_in_words
    assert "length 0.95 m (profile: 0.98)" in words
    assert "bending stiffness 0.0903 N·m² (profile: 0.090275)" in words
    assert "density" not in words
    assert "The simulated rig keeps the beam of the profile." in words
    assert profile.specimen is None
    write(BEAM + DAMPING)
    mounted = with_specimen(profile, "antenna 4")
    assert mounted.loop_model().plant.damping == Damping(8e-5, 1.0, 5e-2, 0.6)
    assert "nominal damping of its own" in mounted.specimen_in_words


def test_uncertainty_of_its_beam_replaces_that_of_the_profile(write, tmp_path):
    path = write_profile(tmp_path)
    stated = "torque_scale_percent = 2.0, length_percent = 0.3, density_percent = 4.0"
    numbers = re.sub(r"= ([\d.]+),?", r'= { value = \1, source = "measured" }\n', stated)
    path.write_text(f"{path.read_text()}\n[uncertainty]\n{numbers}\n")
    profile = load_profile(path)
    assert profile.uncertainty.nonzero_percent_by_field == {
        "torque_scale_percent": 2.0, "length_percent": 0.3, "density_percent": 4.0
    }  # fmt: skip
    write(BEAM + '[uncertainty]\nlength_percent = { value = 0.1, source = "measured" }\n')
    assert with_specimen(profile, "antenna 4").uncertainty.nonzero_percent_by_field == {
        "torque_scale_percent": 2.0, "length_percent": 0.1
    }  # fmt: skip
    write(BEAM + '[uncertainty]\nuniformity_percent = { value = 0.5, source = "measured" }\n')
    uncertainty = with_specimen(profile, "antenna 4").uncertainty
    assert uncertainty.uniformity_percent == 0.5
    assert uncertainty.nonzero_percent_by_field == {"torque_scale_percent": 2.0}


def test_tip_mass_of_a_specimen(write):
    profile = replace(load_profile("sim"), tip_mass_kg=3e-4, axis_tilt_deg=1.0)
    write(BEAM)
    mounted = with_specimen(profile, "antenna 4")
    assert (mounted.tip_mass_kg, mounted.axis_tilt_deg) == (None, 1.0)
    write(f'{BEAM}tip_mass_kg = {{ value = 5.0e-4, source = "measured" }}\n')
    mounted = with_specimen(profile, "antenna 4")
    assert (mounted.tip_mass_kg, mounted.axis_tilt_deg) == (5e-4, 1.0)
    assert mounted.rig.beam == Beam(0.95, 4.7e-3, 0.0903)
    assert "tip mass 0.5 g" in mounted.specimen_in_words


def test_an_equal_beam_is_reported_as_equal(write):
    write(BEAM.replace("0.95", "0.98").replace("0.0903", "0.090275"))
    words = with_specimen(load_profile("sim"), "antenna 4").specimen_in_words
    assert words.endswith("beam as in the profile.")


@pytest.mark.parametrize("name", ["", "antenna 5", "../specimens/antenna 4", "antenna 4.toml", "."])
def test_an_unknown_name_is_a_label(write, name):
    write(BEAM)
    profile = load_profile("sim")
    mounted = with_specimen(profile, name)
    assert (mounted.rig, mounted.specimen) == (profile.rig, None)


def test_a_similar_name_is_mentioned(write):
    write(BEAM)
    profile = load_profile("sim")
    assert "similar name: 'antenna 4'" in with_specimen(profile, "antena 4").specimen_in_words
    assert with_specimen(profile, "steel rod").specimen_in_words == ""


def test_the_working_folder_comes_before_the_user_s(write, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    assert specimen_files() == {}
    write(BEAM, folder="config/rigd/specimens")
    other = write(BEAM, "another", folder="config/rigd/specimens")
    write(BEAM.replace("0.95", "0.9"))
    files = specimen_files()
    assert list(files) == ["another", "antenna 4"]
    assert files["another"] == other
    assert load_specimen(files["antenna 4"]).beam.length_m == 0.9


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("0.95", "-0.95", "beam.length_m = -0.95 m must be more than 0"),
        ("0.95", '"long"', 'beam.length_m = "long" m must be a number'),
        ("length_m", "length_mm", "write beam.length_m, the value in m"),
        (', source = "measured"', "", "beam.length_m has no source"),
        ("length_m = ", "# ", "beam.length_m is missing"),
        ("0.0903", "903.0", "outside 0.1 to 100 Hz; check their units"),
        ('"steel"', "7", "note = 7 must be text"),
        ("note", "notes", "notes does not belong to a specimen"),
        ("[beam]",
         "[uncertainty]\ntorque_scale_percent = { value = 1.0, source = 'paper' }\n[beam]",
         "uncertainty.torque_scale_percent does not belong"),
        ("[beam]", "[motor]\ncoulomb_nm = 1.0\n[beam]", "motor.coulomb_nm does not belong"),
        ("[beam]", "[beam.damping]\nzeta = { value = 0.1, source = 'paper' }\n[beam]",
         "beam.damping.alpha is missing"),
        ("[beam]", "[beam", "is not valid TOML"),
        ("steel", "x" * 17_000, "is longer than 16384 bytes"),
    ],
)  # fmt: skip
def test_mistakes_are_named(write, old, new, complaint):
    assert old in BEAM
    path = write(BEAM.replace(old, new, 1))
    with pytest.raises(ProfileError) as caught:
        with_specimen(load_profile("sim"), "antenna 4")
    assert complaint in str(caught.value)
    assert all(
        line.startswith(f"specimens/{path.name}: ") for line in str(caught.value).splitlines()
    )
