"""Detection of a drive that does not follow its torque command, by its actual torque."""

from functools import cache
from math import exp

import numpy as np
import pytest

from rigd.control import close_loop
from rigd.devices.cia402._transitions import TorqueFollowingCheck
from rigd.devices.contracts import DeviceError
from rigd.excitation import chirp
from rigd.profile import load_profile


@pytest.fixture
def following():
    return TorqueFollowingCheck("Drive", 10.0)  # 100 per mille


def run(following, commands, actuals):
    for command, actual in zip(commands, actuals, strict=True):
        following.check_torque(actual)
        following.register_command(command)


@pytest.mark.parametrize("lag", [1, 2])
def test_a_lag_of_one_or_two_ticks_is_accepted(following, lag):
    commands = [300 * (-1) ** (k // 3) for k in range(60)]
    run(following, commands, [0] * lag + commands[:-lag])


def test_lost_commands_are_detected_after_ten_ticks(following):
    commands = [500 + 10 * k for k in range(9)]
    run(following, [*commands, 0], [0] * 10)
    with pytest.raises(DeviceError, match=r"exerts 0 % .* 60 % were commanded, for 10 ticks"):
        run(following, [500 + 10 * k for k in range(12)], [0] * 12)


def test_no_report_within_the_tolerance(following):
    run(following, [200] * 50, [299] * 50)


def test_no_comparison_at_zero():
    run(TorqueFollowingCheck("Drive", 0.0), [900] * 50, [0] * 50)


def test_enabling_resets_the_comparison(following):
    run(following, [500] * 9, [0] * 9)
    following.reset()
    run(following, [0] * 9, [0] * 9)


@cache
def chirp_commands():
    """Torques of the shipped chirp in per mille, with the noise of the sensor."""
    profile = load_profile("antenna_can")
    loop = close_loop(profile.loop_model())
    reference_rad = chirp(rate_hz=profile.rig.rate_hz, ring_down_s=1.0).reference_rad
    torque_nm = loop.simulate(reference_rad).torque_nm
    noise_nm = np.random.default_rng(1).normal(0, 5e-3, torque_nm.size)
    per_mille = 1000 * (torque_nm + noise_nm) / profile.rig.motor.rated_torque_nm
    assert np.abs(per_mille).max() > 700
    return np.rint(per_mille).astype(int).tolist()


class TestMeasuredTorque:
    """Object 6077 follows the command with a lag of first order, here of 50 Hz."""

    LAG_S = 3.2e-3

    @pytest.fixture
    def commands(self):
        return chirp_commands()

    def drive(self, commands, response_s, lost_from=None):
        """Return the number of ticks until detection, or None."""
        following = TorqueFollowingCheck("Drive", 10.0, response_s, 1e-3)
        fraction = 1 - exp(-1e-3 / self.LAG_S)
        held = pending = 0
        actual = 0.0
        for tick, command in enumerate(commands):
            try:
                following.check_torque(round(actual))
            except DeviceError:
                return tick
            held = pending  # at SYNC
            actual += fraction * (held - actual)
            following.register_command(command)
            if lost_from is None or tick < lost_from:
                pending = command
        return None

    def test_the_chirp_ends_if_no_lag_is_stated(self, commands):
        assert self.drive(commands, 0.0) is not None

    @pytest.mark.parametrize("stated_s", [3.2e-3, 2.6e-3, 4e-3])
    def test_the_chirp_completes_with_the_stated_lag(self, commands, stated_s):
        assert self.drive(commands, stated_s) is None

    @pytest.mark.parametrize("lost_from", [20_000, 40_000, 80_000, 115_000])
    def test_lost_commands_are_found_with_a_stated_lag(self, commands, lost_from):
        found = self.drive(commands, self.LAG_S, lost_from)
        assert found is not None
        assert found - lost_from < 300
