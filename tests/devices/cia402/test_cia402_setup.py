"""Set-up against a scripted drive: order, read-back, refusals; and the reset of a fault."""

import struct
import threading
import time
from dataclasses import replace
from math import tau

import can
import canopen
import pytest
from cases import further

from rigd.devices.cia402 import Cia402Drive
from rigd.devices.cia402.requirements import (
    interpolation_time,
    sync_period_us,
    torque_limit_per_mille,
)
from rigd.devices.contracts import DeviceError

TPDO1, RPDO1 = 0x40000185, 0x205


def writes_to(scripted, *indices):
    return [(i, s, v) for i, s, v in scripted.writes if i in indices]


def test_values_written_to_the_drive(drive, scripted):
    scripted.objects |= {(0x60C2, 2): 0, (0x1029, 1): 1}
    drive.connect()
    written = {(index, sub): value for index, sub, value in scripted.writes}
    assert written[0x1006, 0] == 1000
    assert (written[0x60C2, 1], written[0x60C2, 2]) == (1, -3)
    assert written[0x1016, 1] == 0x00640032
    assert written[0x1017, 0] == 20
    assert written[0x6007, 0] == 2
    assert written[0x1029, 1] == 0
    assert written[0x6072, 0] == 1800
    assert written[0x6060, 0] == 10
    assert (0x1005, 0) not in written


def limited(rig, speed_rad_s):
    return replace(rig, cia402=replace(rig.cia402, max_speed_rad_s=speed_rad_s))


def test_the_speed_limit_is_written_in_units_of_the_drive(make_drive, rig, scripted):
    scripted.objects[0x6080, 0] = 20_000
    make_drive(limited(rig, 5.0)).connect()
    # 5 rad/s behind a gear of 100 are 4774.6 turns a minute.
    assert writes_to(scripted, 0x6080) == [(0x6080, 0, 4775)]


def test_a_speed_limit_of_0_writes_none(make_drive, rig, scripted):
    scripted.objects[0x6080, 0] = 20_000
    make_drive(limited(rig, 0.0)).connect()
    assert writes_to(scripted, 0x6080) == []


def test_a_drive_without_a_required_speed_limit_is_refused(make_drive, rig):
    with pytest.raises(DeviceError, match=r"object 6080.*cia402\.max_speed_rad_s = 0"):
        make_drive(limited(rig, 5.0)).connect()


def test_order_of_mapping_a_pdo(drive, scripted):
    drive.connect()
    assert writes_to(scripted, 0x1800, 0x1A00) == [
        (0x1800, 1, 0xC0000185),
        (0x1A00, 0, 0),
        (0x1A00, 1, 0x60410010),
        (0x1A00, 2, 0x60640020),
        (0x1A00, 3, 0x60770010),
        (0x1A00, 0, 3),
        (0x1800, 2, 1),
        (0x1800, 1, 0x40000185),
    ]
    assert writes_to(scripted, 0x1400, 0x1600) == [
        (0x1400, 1, 0x80000205),
        (0x1600, 0, 0),
        (0x1600, 1, 0x60400010),
        (0x1600, 2, 0x60710010),
        (0x1600, 0, 2),
        (0x1400, 2, 1),
        (0x1400, 1, 0x205),
    ]


def test_other_existing_pdos_are_disabled(drive, scripted):
    drive.connect()
    assert scripted.objects[0x1801, 1] == 0xC0000285
    assert scripted.objects[0x1401, 1] == 0x80000305
    assert not writes_to(scripted, 0x1802, 0x1803, 0x1402, 0x1403)


def test_disabled_pdos_are_not_written(drive, scripted):
    scripted.objects[0x1801, 1] |= 0x80000000
    drive.connect()
    assert not writes_to(scripted, 0x1801)


def test_everything_written_is_read_back(drive, scripted):
    drive.connect()
    requests = scripted.frames(0x605)
    for position, request in enumerate(requests):
        if request[0] & 0xE0 == 0x20 and request[1:3] != b"\x40\x60":
            following = requests[position + 1]
            assert following[0] == 0x40
            assert following[1:4] == request[1:4]


def test_configuration_in_pre_operational_only(drive, scripted):
    drive.connect()
    before_start = scripted.seen[: scripted.seen.index((0x000, b"\x01\x05"))]
    off = (0x605, bytes.fromhex("2B40600000000000"))
    # Off first, and again in pre-operational, because not every drive accepts it before.
    assert before_start[:2] == [off, (0x000, b"\x80\x05")]
    assert off in before_start[2:]
    assert {can_id for can_id, _ in before_start} == {0x000, 0x605}
    after = scripted.seen[len(before_start) + 1 :]
    assert {can_id for can_id, _ in after} == {0x080}


def test_sync_production_of_the_drive_is_switched_off(drive, scripted):
    scripted.objects[0x1005, 0] = 0x40000080
    drive.connect()
    assert writes_to(scripted, 0x1005) == [(0x1005, 0, 0x80)]


def test_bits_set_by_the_drive_itself_are_no_difference(drive, scripted):
    """Bit 30 of a TPDO's identifier: no remote requests."""
    write = dict.__setitem__

    class Sets(dict):
        def __setitem__(self, address, value):
            write(self, address, value | 0x40000000 if address == (0x1800, 1) else value)

    scripted.objects = Sets(scripted.objects)
    drive.connect()


def test_no_thread_outlives_the_set_up(drive, scripted):
    drive.connect()
    assert {thread for thread in threading.enumerate() if "Notifier" in thread.name} == set()


def test_identity_of_the_drive(drive):
    drive.connect()
    assert drive.identity() == {
        "vendor_id": 0x1234,
        "product_code": 0xABCD,
        "revision": 0x10002,
        "serial_number": 77,
        "device_name": "SCRIPTED DRIVE",
        "software_version": "V2.10 beta",
        "supported_modes": 0x3ED,
        "rated_torque_counts": 5,
        "rated_torque_nm": pytest.approx(0.5),
        "gear_ratio": None,
        "encoder_step_rad": None,
    }


def test_a_drive_without_name_and_serial_number(drive, scripted):
    scripted.refuse[0x1008, 0] = 0x06020000
    scripted.refuse[0x100A, 0] = 0x06020000
    scripted.refuse[0x1018, 4] = 0x06090011
    drive.connect()
    assert drive.identity()["device_name"] == ""
    assert drive.identity()["software_version"] == ""
    assert drive.identity()["serial_number"] is None


@pytest.mark.parametrize(
    ("address", "value", "words"),
    [
        ((0x1018, 1), 0x99, ["vendor_id is 0x00001234", "0x00000099"]),
        ((0x1018, 2), 0x1, ["product_code is 0x0000ABCD", "0x00000001"]),
        ((0x6502, 0), 0x1ED, ["no cyclic synchronous torque", "6502 = 493"]),
        ((0x6076, 0), 6, ["6076 = 6", "0.6 N·m", "0.5 N·m"]),
    ],
)
def test_a_drive_other_than_the_profile_s(drive, scripted, address, value, words):
    scripted.objects[address] = value
    with pytest.raises(DeviceError) as caught:
        drive.connect()
    for word in words:
        assert word in str(caught.value)
    assert not [address for address in scripted.writes if address[0] != 0x6040]


STEPS = round(tau / 7e-5)
"""Encoder steps in a turn of the output shaft, as the profile has it."""


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({0x6091: (50, 1)}, ["object 6091", "50 turns", "cia402.gear_ratio is 100"]),
        ({0x608F: (STEPS // 4, 100)}, ["608F", "resolution_rad is 7e-05", "the ratio 4"]),
        ({0x608F: (STEPS, 50), 0x6091: (100, 1)}, ["608F and 6091", "the ratio 0.5"]),
        ({0x6092: (4 * STEPS, 1)}, ["object 6092", "the ratio 0.25"]),
    ],
)
def test_scales_unlike_the_profile_are_refused(drive, scripted, stated, words):
    for index, ratio in stated.items():
        scripted.objects |= {(index, 1): ratio[0], (index, 2): ratio[1]}
    with pytest.raises(DeviceError, match="node 5") as caught:
        drive.connect()
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("stated", "gear", "step"),
    [
        ({0x608F: (STEPS, 100), 0x6091: (100, 1)}, 100.0, 7e-5),
        # As in a drive that was never set up for its gear.
        ({0x608F: (STEPS, 100), 0x6091: (1, 1), 0x6092: (1, 1)}, None, 7e-5),
        # A feed constant in the units that the position has.
        ({0x608F: (10, 1), 0x6091: (100, 1), 0x6092: (STEPS, 1)}, 100.0, 7e-5),
        ({0x608F: (0, 0), 0x6091: (100, 0)}, None, None),
    ],
)
def test_scales_stated_by_the_drive(drive, scripted, stated, gear, step):
    for index, ratio in stated.items():
        scripted.objects |= {(index, 1): ratio[0], (index, 2): ratio[1]}
    drive.connect()
    identity = drive.identity()
    assert identity["gear_ratio"] == gear
    assert identity["encoder_step_rad"] == (step and pytest.approx(step, rel=1e-3))


def test_zero_in_the_profile_accepts_any_drive(make_drive, rig, settings, scripted):
    scripted.objects[0x1018, 1] = 1
    scripted.objects[0x1018, 2] = 2
    scripted.refuse[0x6076, 0] = 0x06020000
    any_drive = replace(settings, vendor_id=0, product_code=0, rated_torque_unit_nm=0.0)
    drive = make_drive(replace(rig, cia402=any_drive))
    drive.connect()
    assert drive.identity()["rated_torque_counts"] is None


ADDRESSES = [
    (0x1006, 0), (0x1A00, 0), (0x60C2, 1), (0x1016, 1), (0x1017, 0), (0x6007, 0), (0x1029, 1),
    (0x6072, 0), (0x6060, 0), (0x1400, 1), (0x1800, 2), (0x1801, 1),
]  # fmt: skip


@pytest.mark.parametrize(
    ("address", "how"),
    [
        *((address, "keeps") for address in ADDRESSES),
        *((address, "refuses") for address in ADDRESSES[:2]),
        *(further(address, "refuses") for address in ADDRESSES[2:]),
    ],
)
def test_an_object_that_ignores_its_value(drive, scripted, address, how):
    scripted.objects |= {(0x1029, 1): 2, (0x60C2, 2): 0, (0x1006, 0): 4000}
    index, sub = address
    if how == "refuses":
        scripted.refuse[address] = 0x08000022
        words = ["refuses", "present device state"]
    else:
        scripted.fixed.add(address)
        words = ["was set to", "and reads"]
    with pytest.raises(DeviceError, match="node 5") as caught:
        drive.connect()
    for word in (*words, f"{index:04X}" + (f":{sub}" if sub else "")):
        assert word in str(caught.value)


def test_wanted_and_actual_value_in_the_message(drive, scripted):
    scripted.fixed.add((0x6072, 0))
    with pytest.raises(DeviceError, match=r"6072 \(Max torque\) was set to 1800 and reads 1000"):
        drive.connect()


def test_a_drive_left_enabled_is_switched_off_first(drive, scripted):
    scripted.nmt, scripted.state = 5, "enabled"
    drive.connect()
    assert scripted.state == "switch-on disabled"
    assert scripted.writes[0] == (0x6040, 0, 0)


def test_failure_to_switch_off(drive, scripted):
    scripted.state, scripted.obeys = "enabled", False
    with pytest.raises(DeviceError, match='"switch-on disabled", it is in "operation enabled"'):
        drive.connect()
    scripted.obeys = True


def test_a_drive_in_fault_is_left_to_the_operator(drive, scripted):
    scripted.state = "fault"
    scripted.objects[0x603F, 0] = 0x4310
    with pytest.raises(DeviceError, match=r"0x4310.*rigd reset --profile scripted"):
        drive.connect()
    assert scripted.state == "fault"


def test_the_emergency_message_names_a_fault_without_code(drive, scripted):
    scripted.state = "fault"

    def alarm_on_read(can_id, data, take=scripted._take):
        if can_id == 0x605 and data[1:3] == b"\x18\x10":
            scripted.emergency(0x7300)
        take(can_id, data)

    scripted._take = alarm_on_read
    with pytest.raises(DeviceError, match="encoder"):
        drive.connect()


def test_resetting_a_fault(drive, scripted):
    scripted.state = "fault"
    scripted.objects[0x603F, 0] = 0x3210
    assert drive.reset_fault() == "over-voltage in the DC link (error code 0x3210)"
    assert scripted.state == "switch-on disabled"
    words = [value for _, _, value in writes_to(scripted, 0x6040)]
    assert words == [0x00, 0x00, 0x80, 0x00, 0x06, 0x00]
    assert not scripted.frames(0x205)
    drive.connect()


def test_resetting_after_a_session_that_ended_in_a_fault(drive, scripted):
    drive.connect()
    drive.enable()
    scripted.state = "fault"
    scripted.objects[0x603F, 0] = 0x8610
    drive.latch(0)
    with pytest.raises(DeviceError, match="fault"):
        drive.read_angle()
    assert "0x8610" in drive.reset_fault()
    drive.connect()
    drive.enable()
    assert scripted.state == "enabled"


def test_no_reset_without_a_fault(drive, scripted):
    assert drive.reset_fault() is None
    assert scripted.writes == [(0x6040, 0, 0), (0x1016, 1, 0), (0x6040, 0, 6), (0x6040, 0, 0)]
    assert scripted.state == "switch-on disabled"


class TestResetOfTurningDrive:
    """Operation enabled, with torque; NMT pre-operational changes nothing for it."""

    @pytest.fixture
    def turning(self, scripted):
        scripted.state, scripted.torque, scripted.nmt = "enabled", 200, 5
        scripted.objects[0x1016, 1] = 100 << 16 | 50
        scripted.ignores_nmt = True
        return scripted

    def test_it_is_switched_off_first(self, drive, turning):
        assert drive.reset_fault() is None
        assert turning.seen[0] == (0x605, bytes.fromhex("2B40600000000000"))
        assert (turning.state, turning.torque, turning.nmt) == ("switch-on disabled", 0, 5)

    def test_its_watchdog_is_removed_only_once_it_is_off(self, drive, turning):
        turning.off_delay_s = 0.08
        drive.reset_fault()
        frames = [data for can_id, data in turning.seen if can_id == 0x605]
        watch = frames.index(struct.pack("<BHBI", 0x23, 0x1016, 1, 0))
        seen_off = turning.off_read_after
        assert 0 < seen_off <= watch

    def test_a_drive_that_stays_on_retains_its_watchdog(self, drive, turning):
        turning.obeys = False
        began = time.monotonic()
        with pytest.raises(DeviceError) as caught:
            drive.reset_fault()
        assert time.monotonic() - began < 5
        message = str(caught.value)
        for words in ("within 0.2 s", '"operation enabled"', "0x1237", "may still turn", "STO"):
            assert words in message
        assert turning.objects[0x1016, 1] == 100 << 16 | 50
        assert (0x1016, 1, 0) not in turning.writes

    def test_a_stopped_node_answers_again(self, drive, turning):
        """It answers no SDO before a command to leave that state."""
        turning.ignores_nmt, turning.nmt = False, 4
        answers, sdo = turning._sdo, []
        turning._sdo = lambda data: sdo.append(data) if turning.nmt == 4 else answers(data)
        assert drive.reset_fault() is None
        assert sdo
        assert turning.state == "switch-on disabled"

    def test_no_answer(self, impatient, drive, turning):
        turning.silent = True
        with pytest.raises(DeviceError, match=r"no answer on CAN bus can0 .* not shown that .*STO"):
            drive.reset_fault()

    def test_commands_are_repeated_after_any_error_of_the_adapter(
        self, drive, turning, failing_bus
    ):
        """A full queue, or a library with its own errors."""
        failing_bus({
            0x605: [RuntimeError("a library's own"), OSError(5, "Input/output error")],
            0x000: [can.CanOperationError("the queue is full")],
        })  # fmt: skip
        assert drive.reset_fault() is None
        assert (turning.state, turning.torque) == ("switch-on disabled", 0)

    def test_lasting_failure_of_the_adapter_is_reported(
        self, impatient, drive, turning, failing_bus
    ):
        failing_bus({can_id: [RuntimeError("a library's own")] * 1000 for can_id in (0x605, 0x000)})
        with pytest.raises(DeviceError, match=r"a library's own.*not shown that .*STO"):
            drive.reset_fault()


@pytest.fixture
def failing_bus(monkeypatch):
    """Let the library's network raise errors before it sends, by the frame's identifier."""
    really_send = canopen.Network.send_message

    def fail(troubles):
        def send(network, can_id, data, remote=False):
            if troubles.get(can_id):
                raise troubles[can_id].pop(0)
            return really_send(network, can_id, data, remote)

        monkeypatch.setattr(canopen.Network, "send_message", send)

    return fail


@pytest.mark.parametrize("late", [1, further(2)])
def test_late_replies_do_not_answer_the_next_request(drive, scripted, late):
    """The first command is given up after 50 ms; its reply comes when another one is awaited."""
    answer, delayed = scripted._sdo, []

    def answer_late(data):
        if data[0] != 0x80:  # given up
            delayed.append(data)
        if len(delayed) > late:
            scripted._sdo = answer
            for request in delayed:
                answer(request)

    scripted._sdo = answer_late
    drive.connect()
    assert len(delayed) == late + 1
    assert scripted.objects[0x6072, 0] == 1800


def test_slow_answers_after_a_late_reply(drive, scripted):
    """Each reply would answer the next request while that waits for one."""
    answer, requests = scripted._sdo, []

    def slow(data):
        requests.append(data)
        time.sleep(0.12 if len(requests) == 1 else 0.004)  # the first is given up after 50 ms
        answer(data)

    scripted._sdo = slow
    drive.connect()
    assert scripted.objects[0x6072, 0] == 1800


def test_a_drive_with_open_sto_is_not_reported_ready(drive, scripted):
    scripted.state = "switch-on disabled, no supply"
    with pytest.raises(DeviceError) as caught:
        drive.reset_fault()
    message = str(caught.value)
    for words in ("not in fault", "it is disabled", "does not get ready", "0x0240", "STO"):
        assert words in message
    assert "supply is not there" in message


def test_a_fault_that_recurs_on_the_shutdown_command(drive, scripted):
    scripted.on_ready = "fault"
    scripted.objects[0x603F, 0] = 0x3220
    with pytest.raises(
        DeviceError, match=r"commanded to get ready it went to fault: under-voltage"
    ):
        drive.reset_fault()


def test_a_turning_wrong_drive_is_switched_off_and_refused(drive, scripted):
    scripted.state, scripted.torque = "enabled", 200
    scripted.objects[0x1018, 2] = 0x1
    with pytest.raises(DeviceError, match="another drive") as caught:
        drive.connect()
    assert (scripted.state, scripted.torque) == ("switch-on disabled", 0)
    assert "may still turn" not in str(caught.value)


def test_a_wrong_drive_that_stays_on_is_reported_as_turning(drive, scripted):
    scripted.state, scripted.obeys = "enabled", False
    scripted.objects[0x6502, 0] = 0x1ED
    with pytest.raises(DeviceError, match=r"no cyclic synchronous torque.*may still turn.*STO"):
        drive.connect()


def test_a_fault_with_a_lasting_cause(drive, scripted):
    scripted.state = "fault"
    scripted.objects[0x603F, 0] = 0x8611
    with pytest.raises(DeviceError, match=r"cannot be reset: following error.*remove the cause"):
        drive.reset_fault()


def test_no_drive_on_the_bus(impatient, drive, scripted):
    scripted.silent = True
    with pytest.raises(DeviceError, match=r"no answer on CAN bus can0.*cia402\.node_id"):
        drive.connect()


def test_other_nodes_on_the_bus_are_named(impatient, make_drive, rig, settings, scripted):
    drive = make_drive(replace(rig, cia402=replace(settings, node_id=6)))
    with pytest.raises(DeviceError, match=r"node 6.*frames came from node 5"):
        threading.Timer(0.05, scripted.heartbeat).start()
        drive.connect()


def test_a_bus_cut_in_mid_setup(impatient, drive, scripted):
    def cut(can_id, data, take=scripted._take):
        if can_id == 0x605 and data[1:3] == b"\x06\x10":
            scripted.cut()
        else:
            take(can_id, data)

    scripted._take = cut
    with pytest.raises(DeviceError, match="CAN bus can0"):
        drive.connect()
    drive.close()


def test_failure_to_become_operational(drive, scripted):
    def stay(can_id, data, take=scripted._take):
        if (can_id, data[:1]) == (0x000, b"\x01"):
            scripted.heartbeat(0x7F)
        else:
            take(can_id, data)

    scripted._take = stay
    with pytest.raises(DeviceError, match=r"does not become operational \(its heartbeat says 127"):
        drive.connect()


def test_no_bus(link_to, rig):
    drive = Cia402Drive(rig, link_to("nothing"))
    with pytest.raises(DeviceError, match="start rigd simulate again"):
        drive.connect()
    drive.close()


def test_an_angle_without_resolution_cannot_be_counted(make_drive, rig):
    drive = make_drive(replace(rig, encoder=replace(rig.encoder, resolution_rad=0.0)))
    with pytest.raises(DeviceError, match="resolution_rad"):
        drive.connect()


def test_connecting_again_after_closing(drive, scripted, make_drive, rig):
    drive.connect()
    drive.connect()
    drive.enable()
    assert scripted.state == "enabled"


@pytest.mark.parametrize(
    ("rate_hz", "period_us", "value", "exponent"),
    [
        (1000.0, 1000, 1, -3),
        (500.0, 2000, 2, -3),
        (100.0, 10000, 10, -3),
        (4.0, 250000, 250, -3),
        (2.0, 500000, 50, -2),
        (2000.0, 500, 5, -4),
        (800.0, 1250, 125, -5),
        (8000.0, 125, 125, -6),
    ],
)
def test_the_period_in_units_of_the_drive(rate_hz, period_us, value, exponent):
    assert sync_period_us(rate_hz) == period_us
    assert interpolation_time(rate_hz) == (value, exponent)
    assert value * 10.0**exponent == pytest.approx(1 / rate_hz)


@pytest.mark.parametrize("rate_hz", [300.0, 7000.0])
def test_a_period_beyond_the_units_of_the_drive(make_drive, rig, rate_hz, scripted):
    with pytest.raises(DeviceError, match="choose another rate"):
        sync_period_us(rate_hz)
    drive = make_drive(replace(rig, rate_hz=rate_hz))
    with pytest.raises(DeviceError, match="rate_hz"):
        drive.connect()
    assert not scripted.seen


def test_a_period_beyond_60c2():
    assert sync_period_us(1e6 / 1001) == 1001
    with pytest.raises(DeviceError, match="60C2"):
        interpolation_time(1e6 / 1001)


@pytest.mark.parametrize(
    ("peak_nm", "rated_nm", "per_mille"),
    [(0.9, 0.5, 1800), (0.9, 0.7, 1285), (0.3, 0.1, 3000), (33.0, 1.0, 32767)],
)
def test_the_limit_never_exceeds_the_peak_torque(rig, peak_nm, rated_nm, per_mille):
    motor = replace(rig.motor, peak_torque_nm=peak_nm, rated_torque_nm=rated_nm)
    assert torque_limit_per_mille(replace(rig, motor=motor)) == per_mille
