"""Reaction of the drive to a silent host or invalid frames."""

import pytest

COMMUNICATION = 0x11
HOST = 100


def guard(bench, *, abort=1, reaction=1):
    """Operation enabled at 300 ‰, with a heartbeat of the host expected every 50 ms."""
    assert bench.write(0x1016, 1, 100 << 16 | 50, 4) == 0
    assert bench.write(0x6007, 0, abort, 2) == 0
    assert bench.write(0x1029, 1, reaction, 1) == 0
    bench.beat()
    bench.drive(300)
    bench.take()
    return bench


@pytest.mark.parametrize(
    ("abort", "state"),
    [
        (0, "operation enabled"),
        (1, "fault"),
        (2, "switch on disabled"),
        (3, "quick stop active"),
    ],
)
def test_a_lost_heartbeat(running, abort, state):
    guard(running, abort=abort)
    running.wait(50, sync=True, rpdo=(0x0F, 300))
    assert running.state() == "operation enabled"
    assert running.emergencies() == []
    running.wait(1, sync=True, rpdo=(0x0F, 300))
    assert running.emergencies() == [(0x8130, COMMUNICATION, "6400000000")]
    assert running.state() == state
    if abort:
        running.assert_off()
    else:
        assert running.logged_torque() == (pytest.approx(0.15), True)
    assert ("drive", "heartbeat lost", {"node_id": 100}) in running.events
    running.wait(100, sync=True)
    assert len(running.emergencies()) == 1


@pytest.mark.parametrize(
    ("reaction", "nmt"), [(0, "pre-operational"), (1, "operational"), (2, "stopped")]
)
def test_a_lost_heartbeat_changes_the_nmt_state_as_in_1029(running, reaction, nmt):
    guard(running, abort=2, reaction=reaction)
    running.wait(51, sync=True)
    assert running.nmt_state() == nmt
    assert [code for code, _, _ in running.emergencies()] == [0x8130]
    running.assert_off()


@pytest.mark.parametrize("reaction", [0, 2])
def test_leaving_operational_ends_operation_even_if_6007_is_0(running, reaction):
    guard(running, abort=0, reaction=reaction)
    running.wait(51, sync=True)
    running.assert_off()


def test_the_watch_starts_with_the_first_heartbeat(running):
    running.write(0x1016, 1, 100 << 16 | 50, 4)
    running.wait(200, sync=True)
    assert running.state() == "operation enabled"
    running.node.receive(0x764, b"\x00")  # a boot-up is none
    running.wait(200, sync=True)
    assert running.state() == "operation enabled"
    running.beat()
    running.wait(51, sync=True)
    assert running.state() != "operation enabled"


def test_heartbeats_of_others_do_not_count(running):
    guard(running)
    for _ in range(51):
        running.node.receive(0x763, b"\x05")
        running.wait(1, sync=True)
    assert running.state() == "fault"


def test_a_fault_is_not_reset_while_the_heartbeat_is_missing(running):
    guard(running)
    running.wait(60, sync=True)
    for word in (0x00, 0x80, 0x00, 0x80):
        running.rpdo(word, 0)
        running.sync()
        assert running.state() == "fault"
    assert ("drive", "fault reset", {"accepted": False}) in running.events
    running.beat()
    running.wait(5, sync=True)
    assert running.state() == "fault"  # not by itself
    running.take()
    running.rpdo(0x00, 0)
    running.node.receive(0x80, b"")
    running.rpdo(0x80, 0)
    running.node.receive(0x80, b"")
    assert running.emergencies() == [(0, 0, "0000000000")]
    assert running.state() == "switch on disabled"
    assert running.read(0x603F) == 0
    running.enable()


def test_no_switching_on_while_the_heartbeat_is_missing(running):
    guard(running, abort=2)
    running.wait(60, sync=True)
    assert running.sync()[0] == 0x02D0  # bit 7: warning
    running.rpdo(0x06, 0)
    running.sync()
    assert running.state() == "switch on disabled"
    running.take()
    running.beat()
    assert running.emergencies() == [(0, 0, "0000000000")]
    running.enable()


def test_a_quick_stop_lasts_while_the_heartbeat_is_missing(running):
    running.write(0x605A, 0, 6, 2)
    guard(running, abort=3)
    running.wait(60, sync=True)
    running.rpdo(0x0F, 300)
    running.sync()
    assert running.state() == "quick stop active"
    running.beat()
    running.rpdo(0x0F, 300)
    running.sync()
    assert running.state() == "operation enabled"


def test_reset_of_another_fault_does_not_clear_a_missing_heartbeat(running):
    guard(running, abort=0)
    running.wait(60, sync=True)
    running.node.emergency(0x2310, 0x02, b"")
    running.take()
    running.write(0x6040, 0, 0x80, 2)
    assert running.state() == "switch on disabled"
    assert running.read(0x1001) == COMMUNICATION
    running.take()
    running.beat()
    assert running.emergencies() == [(0, 0, "0000000000")]


def test_a_reset_of_the_node_clears_a_missing_heartbeat(running):
    guard(running)
    running.wait(60, sync=True)
    running.nmt(129)
    running.configure().enable()


def test_writing_1016_restarts_the_watch(running):
    guard(running)
    running.wait(60, sync=True)
    running.write(0x1016, 1, 100 << 16 | 80, 4)
    running.rpdo(0x80, 0)
    running.sync()
    assert running.state() == "switch on disabled"


def test_writing_1016_clears_an_error_without_fault(running):
    guard(running, abort=2)
    running.wait(60, sync=True)
    assert running.read(0x1001) == COMMUNICATION
    running.write(0x1016, 1, 100 << 16 | 80, 4)
    assert running.emergencies() == [(0, 0, "0000000000")]
    assert running.read(0x1001) == 0


def test_a_lost_sync_is_a_fault(running):
    running.drive(300)
    running.take()
    running.wait(30)
    assert running.state() == "operation enabled"
    running.wait(1)
    assert running.emergencies() == [(0x8700, COMMUNICATION, "0000000000")]
    assert running.state() == "fault"
    running.assert_off()


def test_the_sync_timeout_follows_its_period(running):
    running.write(0x1006, 0, 5000, 4)
    running.sync()
    running.wait(150)
    assert running.state() == "operation enabled"
    running.wait(1)
    assert running.state() == "fault"


def test_the_sync_timeout_follows_the_simulator(make_bench):
    bench = make_bench({"sync_timeout_s": 0.2}).configure().enable()
    bench.wait(200)
    assert bench.state() == "operation enabled"
    bench.wait(1)
    assert bench.state() == "fault"


def test_no_sync_fault_out_of_operation(bench):
    bench.configure()
    bench.sync()
    bench.wait(100)
    assert bench.state() == "switch on disabled"
    assert bench.emergencies() == []


@pytest.mark.parametrize("delivery", [1, 255])
def test_missing_rpdos_are_a_fault_with_a_deadline(bench, delivery):
    bench.write(0x1400, 5, 20, 2)
    bench.configure(delivery=delivery).sync()
    bench.enable()
    bench.wait(50, sync=True, rpdo=(0x0F, 300))
    assert bench.logged_torque() == (pytest.approx(0.15), True)
    bench.take()
    bench.wait(19, sync=True)
    assert bench.state() == "operation enabled"
    bench.wait(2, sync=True)
    assert bench.emergencies() == [(0x8250, COMMUNICATION, "0100000000")]
    assert bench.state() == "fault"
    bench.assert_off()


def test_the_torque_is_held_without_a_deadline(running):
    running.drive(300)
    running.wait(500, sync=True)
    assert running.logged_torque() == (pytest.approx(0.15), True)


@pytest.mark.parametrize(("data", "vendor"), [(b"", "0004000000"), (b"\x0f\x00\x64", "0304000000")])
def test_a_short_pdo_is_a_fault_in_operation(running, data, vendor):
    running.drive(300)
    running.take()
    running.node.receive(0x205, data)
    assert running.emergencies() == [(0x8210, COMMUNICATION, vendor)]
    assert running.state() == "fault"
    running.assert_off()


def test_the_first_bytes_of_a_long_pdo_count(running):
    running.drive(300)
    running.take()
    running.node.receive(0x205, b"\x0f\x00\x64\x00\x00")
    assert running.emergencies() == [(0x8220, COMMUNICATION, "0504000000")]
    word, _, per_mille = running.sync()
    assert (per_mille, running.state()) == (100, "operation enabled")
    assert word & 0x0080  # warning
    running.take()
    running.rpdo(0x0F, 100)
    assert running.emergencies() == [(0, 0, "0000000000")]


def test_one_node_is_not_watched_twice(bench):
    assert bench.write(0x1016, 1, HOST << 16 | 50, 4) == 0
    assert bench.write(0x1016, 2, HOST << 16 | 80, 4) == 0x06040043
    assert bench.write(0x1016, 2, HOST << 16, 4) == 0  # no time: not watched
    assert bench.write(0x1016, 2, (HOST + 1) << 16 | 80, 4) == 0
    assert bench.write(0x1016, 1, HOST << 16 | 60, 4) == 0  # again, the same entry


def test_a_short_pdo_is_only_reported_out_of_operation(bench):
    bench.configure()
    bench.take()
    for _ in range(3):
        bench.node.receive(0x205, b"\x06")
        bench.sync()
    assert bench.state() == "switch on disabled"
    bench.take()
    bench.node.receive(0x205, b"\x06")
    assert bench.emergencies() == []  # once is enough
    bench.rpdo(0x06, 0)
    assert bench.emergencies() == [(0, 0, "0000000000")]


def test_a_frozen_drive_is_silent_and_resumes_in_fault(running):
    running.write(0x1017, 0, 20, 2)
    running.drive(300)
    running.take()
    running.node.frozen = True
    moved_before = running.plant.angle_rad
    running.node.receive(0x80, b"")
    assert running.plant.angle_rad != moved_before  # the world continues
    running.wait(100, sync=True, rpdo=(0x0F, 300))
    assert running.take() == []
    running.assert_off()
    unsent = [values for _, what, values in running.events if what == "emcy"]
    assert [(values["code"], values["sent"]) for values in unsent] == [(0x8700, False)]
    running.node.frozen = False
    assert running.sync()[0] == 0x0218


def test_a_frozen_drive_receives_nothing(bench):
    bench.configure(delivery=255)
    bench.take()
    bench.node.frozen = True
    bench.node.receive(0x605, bytes.fromhex("2b 07 60 00 03 00 00 00"))
    bench.rpdo(0x06, 0)
    bench.nmt(2)
    bench.wait(5)
    assert bench.take() == []
    bench.node.frozen = False
    assert bench.read(0x6007) == 1
    assert bench.state() == "switch on disabled"
    assert bench.nmt_state() == "operational"


def test_leaving_nmt_operational_is_a_fault_with_6007(running):
    running.write(0x6007, 0, 1, 2)
    running.take()
    running.nmt(2)
    assert running.emergencies() == [(0x8100, COMMUNICATION, "0000000000")]
    assert running.state() == "fault"
    assert running.nmt_state() == "stopped"


def test_no_fault_after_a_regular_end_of_the_host(running):
    guard(running, abort=1)
    running.rpdo(0x06, 0)
    running.sync()
    running.nmt(128)
    running.wait(100)
    assert running.state() == "switch on disabled"
    assert running.read(0x6041) == 0x02D0
