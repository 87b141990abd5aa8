"""Uncertainty of the scales: from the profile's examples into the metadata of a session."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from rigd.engine._messages import Connected
from rigd.profile import load_profile
from rigd.profile._load import profile_of
from rigd.runner._request import Order, file_header

SHIPPED = ("sim", "antenna_can", "antenna_serial")


def with_examples(name):
    """Text of a shipped profile, its commented examples made settings."""
    text = load_profile(name).text
    text, sections = re.subn(r"^# (\[uncertainty\])$", r"\1", text, flags=re.MULTILINE)
    text, keys = re.subn(r"^# (\w+_percent = \{)", r"\1", text, flags=re.MULTILINE)
    assert (sections, keys) == (1, 4)
    return text


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_profiles_state_none_and_show_how(name):
    assert load_profile(name).uncertainty.stated == {}
    assert profile_of(with_examples(name), Path("a.toml")).uncertainty.stated == {
        "torque_scale_percent": 0.5, "length_percent": 0.05, "density_percent": 0.3,
    }  # fmt: skip


def header_of(text, **parameters):
    """Header of the file of a session on a rig with this profile."""
    excitation = SimpleNamespace(kind="chirp", parameters=parameters, segments={})
    connected = Connected(simulated=True, calibration={}, realtime={}, drive={})
    order = Order(profile_of(text, Path("a.toml")), excitation, Path("a.mcap"))
    return file_header(order, connected, {})


def test_a_session_carries_what_its_profile_states():
    def metadata(text):
        header = header_of(text.replace("length_percent", "# length_percent"))
        return {k: v for k, v in header.metadata.items() if k.startswith("uncertainty")}

    assert metadata(load_profile("sim").text) == {}
    assert metadata(with_examples("sim")) == {
        "uncertainty_torque_scale_percent": "0.5", "uncertainty_density_percent": "0.3",
    }  # fmt: skip


def test_a_share_of_more_than_half_is_refused(complaints_of):
    text = with_examples("sim")
    [line] = complaints_of(
        text, ("length_percent = { value = 0.05", "length_percent = { value = 60")
    )
    assert line.startswith("uncertainty.length_percent = 60 % must be at most 50")


@pytest.mark.parametrize(("percent", "stated"), [(None, "0.1"), (0.3, "0.3"), (0, "0.0")])
def test_a_session_states_the_uniformity_of_the_beam(percent, stated):
    text = load_profile("sim").text
    if percent is not None:
        value = f'uniformity_percent = {{ value = {percent}, source = "assumed" }}'
        text += f"\n[uncertainty]\n{value}\n"
    assert header_of(text).metadata["uniformity_percent"] == stated


def test_a_session_may_state_a_uniformity_of_its_own():
    text = load_profile("sim").text
    assert header_of(text, uniformity_percent=0.0).metadata["uniformity_percent"] == "0.0"


def test_a_beam_that_is_far_from_uniform_is_refused(complaints_of):
    text = with_examples("sim")
    [line] = complaints_of(
        text, ("uniformity_percent = { value = 0.1", "uniformity_percent = { value = 12")
    )
    assert line.startswith("uncertainty.uniformity_percent = 12 % must be at most 10")
