"""Ticks with a scripted drive: frames sent, and reactions to frames received."""

import struct
from dataclasses import replace

import pytest

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import Acquisition

PERIOD_NS = 1_000_000
STEP_RAD = 7.0e-5


class Ticks:
    """Calls a drive as the engine does."""

    def __init__(self, drive):
        self.drive, self.tick = drive, 0

    def __call__(self, n=1, torque_nm=None):
        angles = []
        for _ in range(n):
            self.drive.latch(self.tick * PERIOD_NS)
            angles.append(self.drive.read_angle())
            if torque_nm is not None:
                self.drive.command(torque_nm)
            self.tick += 1
        return angles


@pytest.fixture
def ticks(drive):
    drive.connect()
    return Ticks(drive)


def test_the_angle_is_zero_at_connection(ticks, drive):
    assert ticks() == [0.0]
    assert not drive.angle_stale
    assert drive.angle_time_ns > 0


def test_the_angle_follows_the_count(ticks, scripted):
    scripted.position = 1000 + 250
    assert ticks() == [pytest.approx(250 * STEP_RAD)]
    scripted.position = -40
    assert ticks() == [pytest.approx(-1040 * STEP_RAD)]


def test_reversed_count_of_a_drive(make_drive, rig, settings, scripted):
    drive = make_drive(replace(rig, cia402=replace(settings, direction=-1)))
    drive.connect()
    scripted.position += 10
    assert Ticks(drive)() == [pytest.approx(-10 * STEP_RAD)]
    drive.enable()
    drive.command(0.25)
    drive.latch(PERIOD_NS)
    drive.read_angle()
    assert scripted.torque == -500


@pytest.mark.parametrize("direction", [1, -1])
def test_the_counter_wraps_around(scripted, drive, direction):
    scripted.position = direction * (2**31 - 5)
    drive.connect()
    ticks = Ticks(drive)
    angles = []
    for step in range(1, 5):
        raw = direction * (2**31 - 5 + 3 * step)
        scripted.position = (raw + 2**31) % 2**32 - 2**31
        angles += ticks()
    assert angles == pytest.approx([direction * 3 * k * STEP_RAD for k in range(1, 5)])


def test_frames_of_a_tick(ticks, drive, scripted):
    drive.enable()
    scripted.seen.clear()
    ticks(1, torque_nm=0.25)
    ticks(1)
    assert [frame for frame in scripted.seen if frame[0] != 0x764] == [
        (0x080, b""),
        (0x205, bytes.fromhex("0F00F401")),
        (0x080, b""),
    ]


def test_torque_is_clipped_to_the_peak_and_rounded(ticks, drive, scripted):
    drive.enable()
    for torque_nm, per_mille in (
        (0.1, 200), (-0.1, -200), (5.0, 1800), (-5.0, -1800), (float("inf"), 1800),
        (0.00074, 1), (0.00076, 2), (0.0, 0),
    ):  # fmt: skip
        ticks(1, torque_nm)
        ticks(1)
        assert scripted.torque == per_mille


def test_a_nan_torque_is_refused(ticks, drive):
    drive.enable()
    with pytest.raises(DeviceError, match="not a number"):
        ticks(1, float("nan"))


def test_no_torque_and_no_enabling_before_enable(ticks, scripted):
    ticks(20, torque_nm=0.3)
    sent = scripted.frames(0x205)
    assert len(sent) >= 19
    assert set(sent) == {bytes(4)}
    assert scripted.state == "switch-on disabled"


def test_heartbeats_are_timed_by_the_ticks(ticks, scripted):
    assert not scripted.frames(0x764)
    ticks(1)
    ticks(1)
    assert scripted.frames(0x764) == [b"\x05"]
    ticks(200)
    assert len(scripted.frames(0x764)) == 11


def test_ticks_are_stale_while_a_lost_reply_may_be_late(make_drive, rig, scripted):
    quick = replace(rig, acquisition=Acquisition("same_tick", 1e5))
    drive = make_drive(quick)
    drive.connect()
    ticks = Ticks(drive)
    ticks(3)
    scripted.drop = 1
    stale = []
    for step in range(1, 7):
        scripted.position = 1000 + step
        angle = ticks()[0]
        stale.append((drive.angle_stale, round(angle / STEP_RAD)))
    # The next reply may be the late one to the first SYNC.
    assert stale == [(True, 0), (True, 0), (True, 0), (True, 0), (False, 5), (False, 6)]


def test_a_late_reply_does_not_count_for_the_next_tick(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 1e5)))
    drive.connect()
    ticks = Ticks(drive)
    scripted.hold = 1
    angles = []
    for step in range(1, 5):
        scripted.position = 1000 + step
        angle = ticks()[0]
        angles.append((drive.angle_stale, round(angle / STEP_RAD)))
    assert angles == [(True, 0), (True, 0), (False, 3), (False, 4)]


def test_a_reply_of_another_length_is_a_bus_error(make_drive, rig):
    drive = make_drive(rig)
    drive.connect()
    drive._inbox.store_tpdo(b"\x27\x16")
    assert drive.health().errors == 1


def test_a_tolerant_drive_gets_no_sync_after_a_lost_reply(make_drive, rig, settings, scripted):
    """The gap shows which SYNC a reply belongs to."""
    slow = replace(
        rig,
        rate_hz=10.0,
        acquisition=Acquisition("same_tick", 5e4),
        cia402=replace(settings, sync_gaps=True),
    )
    drive = make_drive(slow)
    drive.connect()
    ticks = Ticks(drive)
    ticks(3)
    scripted.drop, syncs = 1, scripted.syncs
    stale = []
    for _ in range(5):
        ticks()
        stale.append(drive.angle_stale)
    assert stale == [True, True, True, False, False]
    assert scripted.syncs == syncs + 4
    assert drive.health().errors == 1
    assert drive.health().doubt == ""


def test_no_sync_is_omitted_after_a_lost_reply(make_drive, rig, scripted):
    slow = replace(rig, rate_hz=10.0, acquisition=Acquisition("same_tick", 5e4))
    drive = make_drive(slow)
    drive.connect()
    ticks = Ticks(drive)
    ticks(3)
    scripted.drop, syncs = 1, scripted.syncs
    stale = []
    for _ in range(6):
        ticks()
        stale.append(drive.angle_stale)
    # After three periods with one reply each, the missing one counts as lost.
    assert stale == [True, True, True, True, False, False]
    assert scripted.wait_for(lambda it: it.syncs == syncs + 6)  # one per tick
    doubt = drive.health().doubt
    assert "unknown while cia402.sync_gaps = false" in doubt
    assert drive.health().doubt_count.endswith("since it was connected: 1.")
    scripted.drop = 1
    ticks(6)
    assert drive.health().doubt == doubt
    assert drive.health().doubt_count.endswith("since it was connected: 2.")


def test_a_late_reply_does_not_count_without_sync_gaps(make_drive, rig, scripted):
    slow = replace(rig, rate_hz=10.0, acquisition=Acquisition("same_tick", 5e4))
    drive = make_drive(slow)
    drive.connect()
    ticks = Ticks(drive)
    scripted.hold = 1
    angles = []
    for step in range(1, 5):
        scripted.position = 1000 + step
        angle = ticks()[0]
        angles.append((drive.angle_stale, round(angle / STEP_RAD)))
    assert angles == [(True, 0), (True, 0), (False, 3), (False, 4)]
    assert drive.health().doubt == ""


def test_a_lost_reply_leaves_a_doubt_in_lock_step(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 2e4)))
    drive.connect()
    ticks = Ticks(drive)
    ticks(3)
    assert drive.health().doubt == ""
    scripted.drop = 1
    ticks(6)
    assert not drive.angle_stale
    assert "a TPDO did not arrive, or all have been delayed by a period" in drive.health().doubt


def test_a_reply_between_the_ticks_does_not_count(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 1e5)))
    drive.connect()
    ticks = Ticks(drive)
    scripted.hold = 1
    ticks()
    assert drive.angle_stale
    scripted.send(0x185, scripted.held.pop())
    scripted.position = 1007
    assert ticks() == [pytest.approx(7 * STEP_RAD)]
    assert not drive.angle_stale


def test_angles_of_the_tick_before(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("previous_tick", 5e5)))
    drive.connect()
    ticks = Ticks(drive)
    scripted.on_sync = lambda it: setattr(it, "position", it.position + 1)
    ticks()
    assert drive.angle_stale  # no tick before it
    angles = []
    times = []
    for _ in range(4):
        angles.append(round(ticks()[0] / STEP_RAD))
        assert not drive.angle_stale
        times.append(drive.angle_time_ns)
    assert angles == [1, 2, 3, 4]
    assert times == sorted(set(times))


def test_a_lost_reply_in_the_mode_of_the_tick_before(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("previous_tick", 2e5)))
    drive.connect()
    ticks = Ticks(drive)
    scripted.drop_at.add(scripted.syncs + 4)
    ticks(3)
    stale = []
    for _ in range(6):
        ticks()
        stale.append(drive.angle_stale)
    assert stale == [False, True, True, True, True, False]


@pytest.mark.parametrize("garbage", ["", "50", "5002E8030000", "5002E80300000000" + "00"])
def test_a_reply_of_the_wrong_length_has_no_angle(make_drive, rig, scripted, garbage):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 1e5)))
    drive.connect()
    ticks = Ticks(drive)
    ticks(2)
    garbage = bytes.fromhex(garbage)
    scripted.garble.append(garbage[:8] if len(garbage) != 9 else garbage[:7])
    ticks()
    assert drive.angle_stale
    ticks()
    assert not drive.angle_stale


def test_reading_twice_in_a_tick_gives_the_same(ticks, drive):
    ticks()
    assert drive.read_angle() == drive.read_angle() == 0.0
    assert not drive.angle_stale


def fault(scripted):
    scripted.state = "fault"


def emergency_and_fault(scripted):
    scripted.state = "fault"
    scripted.emergency(0x8611, b"\x01\x02\x00\x00\x00")


def quick_stop(scripted):
    scripted.state = "quick stop"


def switched_off(scripted):
    scripted.state = "switch-on disabled"


def commanded_to_disable(scripted):
    scripted.state = "ready"


def switched_off_with_a_reason(scripted):
    switched_off(scripted)
    scripted.emergency(0x3220)


def ignores_torque(scripted):
    scripted.follows = False


def restarts(scripted):
    scripted.nmt = 0x7F
    scripted.state = "switch-on disabled"
    scripted.heartbeat(0)


def leaves_operational(scripted):
    scripted.nmt = 0x7F
    scripted.heartbeat()


def falls_silent(scripted):
    scripted.heartbeat_every = 10**9


@pytest.mark.parametrize(
    ("happens", "words"),
    [
        (fault, ['"fault"', "rigd reset --profile scripted"]),
        (
            emergency_and_fault,
            ["following error (error code 0x8611)", "01 02 00 00 00", "rigd reset"],
        ),
        (
            quick_stop,
            ['left "operation enabled"', '"quick stop active"', "0x0217", "STO", "second master"],
        ),
        (
            switched_off,
            [
                "the wired stop (STO) was dropped, or the motor's supply failed, or a command came",
                "this computer did not give (a corrupt frame, a second master)",
                'left "operation enabled"',
                "bit 4 says that the supply is there",
                "if a daemon runs the rig, then reset",
                "If nobody pressed it, check the bus cable",
            ],
        ),
        (
            commanded_to_disable,
            ['for "ready to switch on"', "a corrupt frame, a second master", "the bus cable"],
        ),
        (switched_off_with_a_reason, ["under-voltage in the DC link", "rigd reset"]),
        (ignores_torque, ["ignores the target torque", "bit 12"]),
        (restarts, ["restarted"]),
        (leaves_operational, ["left operational for pre-operational", "another master"]),
        (falls_silent, ["no heartbeat", "drive_heartbeat_timeout_s = 0.05 s"]),
    ],
)
def test_faults_that_end_a_session(make_drive, rig, scripted, happens, words):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 1e5)))
    drive.connect()
    ticks = Ticks(drive)
    ticks(5)
    drive.enable()
    ticks(5, torque_nm=0.1)
    happens(scripted)
    with pytest.raises(DeviceError, match="node 5") as caught:
        ticks(80, torque_nm=0.1)
    for word in words:
        assert word in str(caught.value)
    drive.disable()
    assert scripted.state in ("switch-on disabled", "fault")
    assert scripted.torque == 0


def test_the_code_of_the_wired_stop_is_reported(make_drive, rig, scripted):
    settings = replace(rig.cia402, sto_error_code=0xFF20)
    ticks = Ticks(make_drive(replace(rig, cia402=settings)))
    ticks.drive.connect()
    ticks(5)
    ticks.drive.enable()
    ticks(5, torque_nm=0.1)
    scripted.state = "fault"
    scripted.emergency(0xFF20)
    with pytest.raises(DeviceError) as caught:
        ticks(5, torque_nm=0.1)
    for words in ("the wired stop (STO) was dropped", "0xFF20", "rigd reset --profile scripted"):
        assert words in str(caught.value)


def test_silence_is_reported_once_it_is_too_long(ticks, drive, scripted):
    scripted.heartbeat_every = 1
    ticks(5)
    scripted.heartbeat_every = 10**9
    ticks(50)
    with pytest.raises(DeviceError, match="no heartbeat"):
        ticks(2)


def test_a_lost_supply_is_not_reported_as_a_command(make_drive, rig, scripted):
    ticks = Ticks(make_drive(replace(rig, acquisition=Acquisition("same_tick", 1e5))))
    ticks.drive.connect()
    ticks.drive.enable()
    ticks(5, torque_nm=0.1)
    scripted.state = "switch-on disabled, no supply"
    with pytest.raises(DeviceError, match=r"wired stop \(STO\).*\(statusword 0x0240\)\. Find out"):
        ticks(5, torque_nm=0.1)


def test_an_emergency_message_before_enabling_ends_the_session_too(ticks, scripted):
    scripted.emergency(0x8130)
    with pytest.raises(DeviceError, match="heartbeat of this computer lost") as caught:
        ticks(2)
    # The drive is not in fault then, and a reset would have no effect.
    assert "if drive or daemon are in fault then: rigd reset --profile scripted" in str(
        caught.value
    )


def test_the_first_of_several_alarms_is_reported(ticks, scripted):
    scripted.emergency(0x8130)
    scripted.emergency(0x2310)
    scripted.heartbeat(0x7F)
    with pytest.raises(DeviceError, match="heartbeat of this computer lost"):
        ticks(2)


def test_the_toggle_bit_of_a_heartbeat_is_ignored(ticks, scripted):
    scripted.heartbeat(0x85)
    ticks(3)
    scripted.heartbeat(0x50)
    with pytest.raises(DeviceError, match="state 80"):
        ticks(3)


def test_the_end_of_an_emergency_is_no_fault(ticks, scripted):
    scripted.emergency(0x0000)
    ticks(3)


def test_broken_emergencies_and_heartbeats_are_passed_over(ticks, scripted):
    for data in (b"", b"\x10", b"\x10\x81"):
        scripted.send(0x085, data)
    scripted.send(0x705, b"")
    scripted.send(0x585, b"\x43\x61")
    ticks(3)


def test_a_cut_bus_is_reported(ticks, scripted):
    ticks(2)
    scripted.cut()
    with pytest.raises(DeviceError, match="CAN bus can0"):
        ticks(5)


def test_a_controller_off_the_bus_is_reported(ticks, scripted):
    scripted._link.sendall(struct.pack("=IB3x8s", 0x20000040, 8, bytes(8)))
    with pytest.raises(DeviceError, match="bus-off"):
        ticks(3)


def test_error_of_an_unconnected_drive(make_drive, rig):
    drive = make_drive(rig)
    for call in (lambda: drive.latch(0), drive.read_angle, drive.enable, lambda: drive.command(0)):
        with pytest.raises(DeviceError, match="not connected"):
            call()


def test_a_brief_exit_from_operation_is_detected(ticks, drive, scripted):
    drive.enable()
    ticks(3, torque_nm=0.1)
    # Two TPDOs in one tick: "switched on" in the first, no fault in the second.
    scripted.send(0x185, struct.pack("<Hih", 0x0233, scripted.position, 0))
    with pytest.raises(DeviceError, match=r'left "operation enabled" for "switched on"'):
        ticks(3, torque_nm=0.1)


def test_connecting_clears_an_earlier_fault(ticks, drive, scripted):
    scripted.state = "fault"
    with pytest.raises(DeviceError, match="fault"):
        ticks(2)
    scripted.state = "switch-on disabled"
    drive.connect()
    Ticks(drive)(5)
