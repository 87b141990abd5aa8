"""Random frames at the drive."""

import importlib.util
from pathlib import Path

import pytest


def load_fuzzer():
    path = Path(__file__).with_name("fuzz_drive_node.py")
    spec = importlib.util.spec_from_file_location("fuzz_drive_node", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("seed", [1, 2])
def test_no_frame_raises_or_brings_torque_beyond_the_limits(seed):
    seen = load_fuzzer().fuzz(10_000, seed)
    assert seen["frames"] == 10_000
    # The run was meaningful: the drive was in every state, and exerted torque.
    for state in (
        "operation enabled",
        "quick stop active",
        "fault",
        "switch on disabled",
        "ready to switch on",
        "switched on",
    ):
        assert seen[state] > 10, seen
    assert seen["torques"] > 200
