"""A drive that does not exert what it is told is noticed, by what it says it exerts."""

import pytest

from rigd.devices.cia402.following import TorqueFollowing
from rigd.devices.contracts import DeviceError


@pytest.fixture
def following():
    return TorqueFollowing("Drive", 10.0)  # 100 per mille


def run(following, commands, actuals):
    for command, actual in zip(commands, actuals, strict=True):
        following.compare(actual)
        following.command(command)


@pytest.mark.parametrize("lag", [1, 2])
def test_a_drive_that_follows_by_one_or_two_ticks_is_left_alone(following, lag):
    commands = [300 * (-1) ** (k // 3) for k in range(60)]
    run(following, commands, [0] * lag + commands[:-lag])


def test_lost_commands_are_noticed_after_ten_ticks(following):
    commands = [500 + 10 * k for k in range(9)]
    run(following, [*commands, 0], [0] * 10)
    with pytest.raises(DeviceError, match=r"exerts 0 % .* 60 % were commanded, for 10 ticks"):
        run(following, [500 + 10 * k for k in range(12)], [0] * 12)


def test_within_the_tolerance_nothing_is_said(following):
    run(following, [200] * 50, [299] * 50)


def test_zero_compares_nothing():
    run(TorqueFollowing("Drive", 0.0), [900] * 50, [0] * 50)


def test_enabling_begins_anew(following):
    run(following, [500] * 9, [0] * 9)
    following.start()
    run(following, [0] * 9, [0] * 9)
