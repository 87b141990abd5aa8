"""The page on the control socket is normative: it names what a plan tells."""

from pathlib import Path

import pytest

from rigd.daemon._states import plan_document
from rigd.excitation import chirp
from rigd.profile import load_profile
from rigd.runner._planning import plan_session

PAGE = (Path(__file__).parents[2] / "docs" / "control_socket.md").read_text("utf-8")


@pytest.fixture(scope="module")
def plan():
    return plan_document(plan_session(load_profile("sim"), chirp(rate_hz=1000.0)), 136.0)


def test_all_that_a_plan_tells_is_on_the_page(plan):
    section = PAGE[PAGE.index("### The plan") : PAGE.index("## Control\n")]
    named = {name for name in [*plan, *plan["tip"]] if f"`{name}`" in section}
    assert named == {*plan, *plan["tip"]}
