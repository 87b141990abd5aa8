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
    assert (sections, keys) == (1, 3)
    return text


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_profiles_state_none_and_show_how(name):
    assert load_profile(name).uncertainty.stated == {}
    assert profile_of(with_examples(name), Path("a.toml")).uncertainty.stated == {
        "torque_scale_percent": 0.5, "length_percent": 0.05, "density_percent": 0.3,
    }  # fmt: skip


def test_a_session_carries_what_its_profile_states():
    excitation = SimpleNamespace(kind="chirp", parameters={}, segments={})
    connected = Connected(simulated=True, calibration={}, realtime={}, drive={})

    def metadata(text):
        profile = profile_of(text.replace("length_percent", "# length_percent"), Path("a.toml"))
        header = file_header(Order(profile, excitation, Path("a.mcap")), connected, {})
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
