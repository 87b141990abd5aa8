"""Uncertainty of the scales: from the profile's examples into the metadata of a session."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from rigd.engine.messages import DevicesConnected
from rigd.profile import load_profile
from rigd.runner.request import SessionOrder, file_header

SHIPPED = ("sim", "antenna_can", "antenna_serial")


def with_examples(name):
    """Text of a shipped profile, its commented examples made settings."""
    text = load_profile(name).text
    text, sections = re.subn(r"^# (\[uncertainty\])$", r"\1", text, flags=re.MULTILINE)
    text, keys = re.subn(
        r"^# (\w+_percent|tip_mass_kg|axis_tilt_deg)( = \{)", r"\1\2", text, flags=re.MULTILINE
    )
    assert (sections, keys) == (1, 7)
    return text


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_profiles_have_uncertainty_in_comments(loaded, name):
    profile = load_profile(name)
    assert profile.uncertainty.nonzero_percent_by_field == {}
    assert (profile.tip_mass_kg, profile.axis_tilt_deg) == (None, None)
    profile = loaded(with_examples(name))
    assert profile.uncertainty.nonzero_percent_by_field == {
        "torque_scale_percent": 0.5, "length_percent": 0.05, "density_percent": 0.3,
        "tip_mass_percent": 1.0,
    }  # fmt: skip
    assert (profile.tip_mass_kg, profile.axis_tilt_deg) == (1e-4, 0.1)


@pytest.fixture
def header_of(loaded):
    """Return the header of the file of a session on a rig with this profile."""

    def header_of(text, **parameters):
        excitation = SimpleNamespace(kind="chirp", parameters=parameters, segments={})
        connected = DevicesConnected(simulated=True, calibration={}, realtime={}, drive={})
        order = SessionOrder(loaded(text), excitation, Path("a.mcap"))
        return file_header(order, connected, {})

    return header_of


def test_a_session_has_the_uncertainty_of_its_profile(header_of):
    def metadata(text):
        header = header_of(text.replace("length_percent", "# length_percent"))
        return {k: v for k, v in header.metadata.items() if k.startswith("uncertainty")}

    assert metadata(load_profile("sim").text) == {}
    assert metadata(with_examples("sim")) == {
        "uncertainty_torque_scale_percent": "0.5", "uncertainty_density_percent": "0.3",
        "uncertainty_tip_mass_percent": "1.0",
    }  # fmt: skip


def test_an_uncertainty_above_half_is_refused(complaints_of):
    text = with_examples("sim")
    [line] = complaints_of(
        text, ("length_percent = { value = 0.05", "length_percent = { value = 60")
    )
    assert line.startswith("uncertainty.length_percent = 60 % must be at most 50")


@pytest.mark.parametrize(("percent", "stated"), [(None, "0.1"), (0.3, "0.3"), (0, "0.0")])
def test_a_session_states_the_uniformity_of_the_beam(header_of, percent, stated):
    text = load_profile("sim").text
    if percent is not None:
        value = f'uniformity_percent = {{ value = {percent}, source = "assumed" }}'
        text += f"\n[uncertainty]\n{value}\n"
    assert header_of(text).metadata["uniformity_percent"] == stated


def test_a_session_may_state_another_uniformity(header_of):
    text = load_profile("sim").text
    assert header_of(text, uniformity_percent=0.0).metadata["uniformity_percent"] == "0.0"


def test_stated_tip_mass_and_tilt_are_in_the_file(header_of):
    def stated(text):
        metadata = header_of(text).metadata
        return metadata.get("tip_mass_kg"), metadata.get("axis_tilt_deg")

    assert stated(load_profile("sim").text) == (None, None)
    assert stated(with_examples("sim")) == ("0.0001", "0.1")


def test_the_loop_is_predicted_with_the_tip_mass(loaded):
    """A mass of half the beam's at the tip; the beam stays the uniform one."""
    text = with_examples("sim").replace("value = 1.0e-4", "value = 2.0e-3")
    profile = loaded(text)
    assert profile.rig.beam == load_profile("sim").rig.beam
    assert profile.plant == replace(load_profile("sim").plant, tip_mass_kg=2e-3)


@pytest.mark.parametrize(
    ("line", "wrong", "words"),
    [("tip_mass_kg = { value = 1.0e-4", "tip_mass_kg = { value = -1.0", "tip_mass_kg = -1 kg"),
     ("axis_tilt_deg = { value = 0.1", "axis_tilt_deg = { value = 91.0", "tilt_deg = 91 °"),
     ("axis_tilt_deg = { value = 0.1", "axis_tilt_deg = { value = nan", "axis_tilt_deg")],
)  # fmt: skip
def test_absurd_tip_masses_and_tilts_are_refused(complaints_of, line, wrong, words):
    [complaint] = complaints_of(with_examples("sim"), (line, wrong))
    assert words in complaint


def test_a_beam_far_from_uniform_is_refused(complaints_of):
    text = with_examples("sim")
    [line] = complaints_of(
        text, ("uniformity_percent = { value = 0.1", "uniformity_percent = { value = 12")
    )
    assert line.startswith("uncertainty.uniformity_percent = 12 % must be at most 10")
