"""The page on the control socket is normative: it documents every key of a plan."""

from pathlib import Path

import pytest

from rigd.excitation import chirp
from rigd.profile import load_profile
from rigd.runner import Series

PAGE = (Path(__file__).parents[2] / "docs" / "control_socket.md").read_text("utf-8")


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sessions")
    return Series(load_profile("sim"), chirp(rate_hz=1000.0), folder).plan_document()


def test_every_key_of_a_plan_is_documented(plan):
    section = PAGE[PAGE.index("### The plan") : PAGE.index("## Control\n")]
    keys = {*plan, *plan["tip"], *plan["limits"]}
    assert {name for name in keys if f"`{name}`" in section} == keys
