"""Enabling and disabling with a scripted drive, in every order and with every fault."""

from dataclasses import replace

import pytest

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import Acquisition

PERIOD_NS = 1_000_000


def tick(drive, n=1, first=0):
    for k in range(first, first + n):
        drive.latch(k * PERIOD_NS)
        drive.read_angle()


def rpdos(scripted):
    return [data.hex() for data in scripted.frames(0x205)]


def test_the_steps_up_carry_no_torque(drive, scripted):
    drive.connect()
    tick(drive)
    scripted.seen.clear()
    drive.enable()
    assert scripted.state == "enabled"
    assert scripted.torque == 0
    assert list(dict.fromkeys(rpdos(scripted))) == ["06000000", "07000000", "0f000000"]
    assert len(scripted.frames(0x080)) == len(rpdos(scripted)) == 5


def test_the_number_of_syncs_is_the_same_every_time(make_drive, rig, scripted):
    counts = []
    drive = make_drive(rig)
    for _ in range(3):
        scripted.syncs = 0
        drive.connect()
        drive.enable()
        drive.disable()
        counts.append(scripted.syncs)
    assert len(set(counts)) == 1


def test_heartbeats_go_on_while_enabling(drive, scripted):
    drive.connect()
    scripted.stays_in = "switched on"
    with pytest.raises(DeviceError):
        drive.enable()
    # 52 periods of 1 ms at 20 ms each, and the first at once.
    assert len(scripted.frames(0x764)) == 3


def test_enabling_before_a_tick_sends_the_first_heartbeat(drive, scripted):
    drive.connect()
    assert not scripted.frames(0x764)
    drive.enable()
    first = [i for i, _ in scripted.seen].index(0x764)
    enabling = scripted.seen.index((0x205, bytes.fromhex("0F000000")))
    assert first < enabling


def test_delivery_on_arrival(make_drive, rig, settings, scripted):
    drive = make_drive(replace(rig, cia402=replace(settings, torque_delivery="on_arrival")))
    drive.connect()
    assert scripted.objects[0x1400, 2] == 255
    drive.enable()
    tick(drive)
    drive.command(0.1)
    drive.latch(PERIOD_NS)
    drive.read_angle()
    assert scripted.torque == 200
    drive.disable()
    assert scripted.state == "switch-on disabled"


def test_enabling_twice_sends_nothing(drive, scripted):
    drive.connect()
    drive.enable()
    before = len(scripted.seen)
    drive.enable()
    assert len(scripted.seen) == before


@pytest.mark.parametrize(
    ("stays", "wanted"),
    [
        ("switch-on disabled", "ready to switch on"),
        ("ready", "switched on"),
        ("switched on", "operation enabled"),
    ],
)
def test_the_state_of_a_stuck_drive_is_named(drive, scripted, stays, wanted):
    drive.connect()
    scripted.stays_in = stays
    with pytest.raises(DeviceError, match=f'does not get to "{wanted}"') as caught:
        drive.enable()
    phrase = {"ready": "ready to switch on"}.get(stays, stays)
    assert f'stays in "{phrase}"' in str(caught.value)
    assert "enable_timeout_s = 0.05 s" in str(caught.value)
    assert scripted.state == "switch-on disabled"
    assert rpdos(scripted)[-1] == "00000000"


def test_a_drive_ignoring_torque_is_disabled(drive, scripted):
    drive.connect()
    scripted.follows = False
    with pytest.raises(DeviceError, match="bit 12"):
        drive.enable()
    assert scripted.state == "switch-on disabled"


def test_a_mode_shown_only_when_enabled_is_accepted(drive, scripted):
    scripted.mode_follows = "enabled"
    drive.connect()
    drive.enable()
    assert scripted.state == "enabled"


def test_a_mode_never_shown_is_refused(drive, scripted):
    scripted.mode_follows = False
    drive.connect()
    with pytest.raises(DeviceError, match=r"object 6061\) is 0, not 10"):
        drive.enable()
    assert scripted.state == "switch-on disabled"


def test_a_fault_while_enabling_is_reported(drive, scripted):
    drive.connect()

    def fail(it):
        if it.state == "switched on":
            it.state = "fault"
            it.emergency(0x2310)

    scripted.on_sync = fail
    with pytest.raises(DeviceError, match=r"current at the output \(error code 0x2310.*rigd reset"):
        drive.enable()


def test_a_stop_is_obeyed_while_a_slow_drive_enables(make_drive, rig, settings, scripted):
    drive = make_drive(replace(rig, cia402=replace(settings, enable_timeout_s=10.0)))
    drive.connect()
    scripted.stays_in = "switched on"
    polls = []
    drive.enable(lambda: polls.append(1) or len(polls) > 20)
    assert len(polls) == 21
    assert scripted.state == "switch-on disabled"
    scripted.stays_in = None
    drive.command(0.3)
    tick(drive, 3)
    assert (scripted.state, scripted.torque) == ("switch-on disabled", 0)
    drive.enable()
    assert scripted.state == "enabled"


def test_silence_of_the_drive_while_enabling(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 5e4)))
    drive.connect()
    scripted.drop = 10**9
    with pytest.raises(DeviceError, match="stopped answering SYNC"):
        drive.enable()


def test_disabling_ends_torque_and_later_commands(drive, scripted):
    drive.connect()
    drive.enable()
    tick(drive)
    drive.command(0.3)
    tick(drive, 2, first=1)
    assert scripted.torque == 600
    scripted.seen.clear()
    drive.disable()
    assert (scripted.state, scripted.torque) == ("switch-on disabled", 0)
    assert set(rpdos(scripted)) == {"00000000"}
    drive.command(0.3)
    tick(drive, 3, first=3)
    assert set(rpdos(scripted)) == {"00000000"}
    assert scripted.torque == 0


def test_disabling_again_only_repeats_the_command(drive, scripted):
    drive.connect()
    drive.enable()
    drive.disable()
    syncs = scripted.syncs
    drive.disable()
    drive.disable()
    tick(drive)
    assert scripted.syncs == syncs + 1


def test_enabling_after_disabling(drive, scripted):
    drive.connect()
    for _ in range(3):
        drive.enable()
        assert scripted.state == "enabled"
        drive.disable()
        assert scripted.state == "switch-on disabled"


def test_a_drive_that_ignores_pdos_is_switched_off_by_sdo(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 5e4)))
    drive.connect()
    drive.enable()
    scripted.nmt = 0x7F  # without a word
    scripted.seen.clear()
    drive.disable()
    assert scripted.state == "switch-on disabled"
    assert scripted.frames(0x605) == [
        bytes.fromhex("2B40600000000000"),  # off,
        bytes.fromhex("4041600000000000"),  # and is it?
    ]
    assert scripted.frames(0x000) == []
    assert drive.off_doubt == ""


def test_an_old_statusword_does_not_count_as_off(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 5e4)))
    drive.connect()
    scripted.seen.clear()

    def fall_silent(it):
        if it.state == "switched on":
            it.drop = 10**9

    scripted.on_sync = fall_silent
    with pytest.raises(DeviceError, match="stopped answering SYNC"):
        drive.enable()
    assert bytes.fromhex("2B40600000000000") in scripted.frames(0x605)


def test_the_last_resort_is_to_stop_the_node(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 5e4)))
    drive.connect()
    drive.enable()
    scripted.obeys = scripted.sdo_works = False
    drive.disable()
    assert scripted.wait_for_frame(0x000, b"\x02\x05")
    drive.close()
    assert scripted.state == "switch-on disabled"


def test_disabling_never_raises(make_drive, rig, scripted):
    drive = make_drive(rig)
    drive.disable()
    drive.connect()
    drive.enable()
    scripted.cut()
    drive.disable()
    drive.disable()
    drive.close()
    drive.disable()
    drive.close()


class TestFailingAdapter:
    """No error of its library prevents switching the torque off."""

    @pytest.fixture
    def drive(self, make_drive, rig, scripted):
        drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 5e4)))
        drive.connect()
        drive.enable()
        scripted.seen.clear()
        return drive

    def test_a_burst_of_damaged_lines(self, drive, scripted):
        exchange = drive._node.exchange
        receive, left = exchange._receive, [60]

        def damaged():
            if left[0]:
                left[0] -= 1
                raise ValueError("could not convert string to int: 'ZZZ'")
            return receive()

        exchange._receive = damaged
        drive.disable()
        assert scripted.state == "switch-on disabled"
        assert drive.off_doubt == ""
        assert scripted.frames(0x605) == []  # by PDO, at once

    def test_a_lasting_error_does_not_prevent_sync(self, drive, scripted):
        drive._node.exchange._bus_error = "CAN bus can0: the controller is error-passive."
        drive.disable()
        assert scripted.state == "switch-on disabled"
        assert drive.off_doubt == ""
        order = [can_id for can_id, _ in scripted.seen]
        assert order[:2] == [0x205, 0x080]
        assert 0x605 not in order

    @pytest.mark.parametrize("error", [ValueError, RuntimeError, MemoryError, KeyError])
    def test_every_call_fails(self, drive, error):
        def fail(*_):
            raise error("anything")

        exchange = drive._node.exchange
        exchange._receive = exchange._send = fail
        exchange.port.receive = exchange.port.wait = fail
        drive.disable()
        assert "does not show that it is off" in drive.off_doubt
        drive.close()


def test_disabling_a_frozen_drive_ends(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 1e4)))
    drive.connect()
    drive.enable()
    scripted.silent = True
    drive.disable()
    assert scripted.wait_for_frame(0x000, b"\x02\x05")
    assert 1 < rpdos(scripted).count("00000000") < 200


def test_closing_leaves_a_silent_unwatched_drive(drive, scripted):
    drive.connect()
    drive.enable()
    assert scripted.objects[0x1016, 1] == 100 << 16 | 50
    drive.close()
    assert scripted.state == "switch-on disabled"
    assert scripted.nmt == 0x7F
    assert scripted.objects[0x1016, 1] == 0


def test_the_bus_is_released_once(drive, scripted, monkeypatch):
    drive.connect()
    link = drive._link
    calls = []
    close = link.close
    monkeypatch.setattr(link, "close", lambda: (calls.append(1), close()))
    drive.close()
    drive.close()
    assert calls == [1]


def test_ticks_continue_after_enabling(drive, scripted):
    drive.connect()
    tick(drive, 10)
    drive.enable()
    tick(drive, 200, first=10)
    assert scripted.state == "enabled"
    # One heartbeat in 20 ticks, and one right after enabling.
    assert 11 <= len(scripted.frames(0x764)) <= 14


class TestRealTime:
    """A real drive does not wait: the loop paces itself."""

    @pytest.fixture
    def drive(self, make_drive, rig, settings):
        return make_drive(
            replace(
                rig,
                rate_hz=100.0,
                acquisition=Acquisition("same_tick", 9000.0),
                cia402=replace(settings, enable_timeout_s=0.3, drive_heartbeat_timeout_s=1.0),
            )
        )

    def test_from_connecting_to_closing(self, drive, scripted):
        drive.connect()
        for k in range(5):
            drive.latch(k * 10_000_000)
            drive.read_angle()
        drive.enable()
        assert scripted.state == "enabled"
        drive.latch(50_000_000)
        drive.command(0.1)
        drive.latch(60_000_000)
        drive.read_angle()
        assert scripted.wait_for(lambda it: it.torque == 200)  # its reply may come too late
        drive.disable()
        assert scripted.wait_for(lambda it: it.state == "switch-on disabled")
        drive.close()

    def test_a_stuck_drive(self, drive, scripted):
        drive.connect()
        scripted.stays_in = "ready"
        with pytest.raises(DeviceError, match='stays in "ready to switch on"'):
            drive.enable()
        assert scripted.wait_for(lambda it: it.state == "switch-on disabled")

    def test_a_reply_slower_than_a_period_is_refused(self, drive, scripted):
        scripted.reply_delay_s = 0.02
        with pytest.raises(DeviceError, match="answers SYNC only after"):
            drive.connect()

    def test_without_a_reply_to_sync(self, drive, scripted):
        scripted.drop = 10**9
        with pytest.raises(DeviceError, match="does not answer SYNC"):
            drive.connect()


def test_a_drive_that_stays_on_is_left_to_its_watchdog(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 5e4)))
    drive.connect()
    drive.enable()
    scripted.obeys = scripted.stops = False
    scripted.seen.clear()
    drive.disable()
    assert "does not show that it is off (statusword 0x1" in drive.off_doubt
    assert scripted.wait_for_frame(0x000, bytes([2, 5]))  # NMT stop
    drive.close()
    written = [(index, sub) for index, sub, _ in scripted.writes]
    assert (0x1016, 1) not in written[written.index((0x6060, 0)) :]


def test_no_doubt_about_a_drive_that_is_off(make_drive, rig, scripted):
    drive = make_drive(replace(rig, acquisition=Acquisition("same_tick", 5e4)))
    drive.connect()
    drive.enable()
    drive.disable()
    assert drive.off_doubt == ""


def test_offsets_and_limits_of_the_drive_are_corrected(make_drive, rig, scripted):
    scripted.objects |= {(0x60B2, 0): 40, (0x60E0, 0): 150, (0x60E1, 0): 1800}
    make_drive(rig).connect()
    changed = {index: value for index, _, value in scripted.writes}
    assert changed[0x60B2] == 0
    assert changed[0x60E0] == changed[0x6072]
    assert (0x60E1 in changed) == (changed[0x6072] != 1800)
