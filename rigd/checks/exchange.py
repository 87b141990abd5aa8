"""The exchange of a tick, as a session does it before the drive is enabled: SYNC, poll, replies.

It runs in an ordinary process, which oversleeps now and then; what a device cannot do shows in
most ticks.
"""

import time
from collections.abc import Iterator

import numpy as np

from rigd.checks.rows import Row, Verdict, grade
from rigd.devices.contracts import Devices
from rigd.devices.registry import Reality
from rigd.engine.clocks import RealClock
from rigd.profile import Profile

TICKS = 500
_FEW_MISSING = 0.02
_MANY_MISSING = 0.2
_GROUP = "exchange"


def exchange_rows(profile: Profile, devices: Devices, moves: Reality) -> Iterator[Row]:
    """Run some ticks without a torque, and judge how quickly and how surely the replies come.

    Parameters
    ----------
    profile
        Whose limits count.
    devices
        Connected, not enabled.
    moves
        In lock-step the simulated rig waits for this computer, and times mean nothing.

    Raises
    ------
    DeviceError
        If a device reports an error, or its line is gone.
    """
    drive, sensor = devices.drive, devices.sensor
    period_ns = round(1e9 / profile.rig.rate_hz)
    waited_ms, angles_rad = np.zeros(TICKS), np.zeros(TICKS)
    missing_angles = missing_wrenches = saturated = 0
    clock = RealClock()
    due_ns = clock.now_ns()
    for tick in range(TICKS):
        due_ns = max(due_ns + period_ns, clock.now_ns())
        clock.wait_until(due_ns)
        begin_ns = time.monotonic_ns()
        drive.latch(due_ns)
        sensor.request(due_ns)
        angles_rad[tick] = drive.read_angle()
        sensor.read_wrench()
        waited_ms[tick] = (time.monotonic_ns() - begin_ns) * 1e-6
        missing_angles += drive.angle_stale
        missing_wrenches += sensor.wrench_stale
        saturated += sensor.wrench_saturated

    yield _reply_row(profile, waited_ms, moves)
    for what, missing in (
        ("angles missing", missing_angles),
        ("wrenches missing", missing_wrenches),
    ):
        verdict = grade(fail=missing > _MANY_MISSING * TICKS, warn=missing > _FEW_MISSING * TICKS)
        yield Row(
            _GROUP,
            what,
            f"{missing} of {TICKS} ticks",
            f"at most {100 * _FEW_MISSING:.0f} %",
            verdict,
        )
    yield Row(
        _GROUP, "sensor saturated", f"{saturated} of {TICKS} ticks", "0", grade(fail=saturated > 0)
    )
    moved_rad = float(np.ptp(angles_rad))
    allowed_rad = max(
        profile.session.rest_velocity_rad_s * TICKS / profile.rig.rate_hz,
        2.0 * profile.rig.encoder.resolution_rad,
    )
    yield Row(
        _GROUP,
        "shaft moved",
        f"{moved_rad:.2g} rad",
        f"at most {allowed_rad:.2g} rad",
        grade(fail=False, warn=moved_rad > allowed_rad),
    )


def _reply_row(profile: Profile, waited_ms: np.ndarray, moves: Reality) -> Row:
    acquisition = profile.rig.acquisition
    median, late = np.percentile(waited_ms, [50, 99]).tolist()
    found = f"median {median:.2f} ms, 99 % within {late:.2f} ms"
    what = "both replies after"
    if acquisition is None or acquisition.mode == "previous_tick":
        return Row(_GROUP, what, "a tick takes those of the tick before", "", Verdict.SKIPPED)
    if moves is Reality.LOCK_STEP:
        return Row(_GROUP, what, found, "any time (lock-step)", Verdict.OK)
    limit_ms = acquisition.deadline_us * 1e-3
    verdict = grade(fail=median >= limit_ms, warn=late >= limit_ms)
    return Row(_GROUP, what, found, f"less than {limit_ms:.2f} ms", verdict)
