"""The drive under the master of the canopen library, which is independent of ours."""

import queue
import threading
import time

import can
import canopen
import pytest
from canopen.objectdictionary import (
    INTEGER8,
    INTEGER16,
    INTEGER32,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    VISIBLE_STRING,
    ODRecord,
    ODVariable,
)
from canopen.profiles.p402 import BaseNode402
from processes import eventually

NODE = 5

VARIABLES = {
    0x1000: UNSIGNED32,
    0x1001: UNSIGNED8,
    0x1005: UNSIGNED32,
    0x1006: UNSIGNED32,
    0x1008: VISIBLE_STRING,
    0x1017: UNSIGNED16,
    0x6007: INTEGER16,
    0x603F: UNSIGNED16,
    0x6040: UNSIGNED16,
    0x6041: UNSIGNED16,
    0x605A: INTEGER16,
    0x6060: INTEGER8,
    0x6061: INTEGER8,
    0x6064: INTEGER32,
    0x6071: INTEGER16,
    0x6072: UNSIGNED16,
    0x6077: INTEGER16,
    0x6502: UNSIGNED32,
}
COMMUNICATION = {1: UNSIGNED32, 2: UNSIGNED8, 3: UNSIGNED16, 5: UNSIGNED16}
RECORDS = {
    0x1016: {1: UNSIGNED32, 2: UNSIGNED32},
    0x1018: {1: UNSIGNED32, 2: UNSIGNED32},
    0x1029: {1: UNSIGNED8},
    **{0x1400 + k: COMMUNICATION for k in range(4)},
    **{0x1800 + k: COMMUNICATION for k in range(4)},
    **{base + k: dict.fromkeys(range(1, 9), UNSIGNED32) for base in (0x1600, 0x1A00)
       for k in range(4)},
}  # fmt: skip


def master_dictionary():
    dictionary = canopen.ObjectDictionary()

    def variable(index, sub, data_type):
        made = ODVariable(f"{index:04X}sub{sub}", index, sub)
        made.data_type = data_type
        return made

    for index, data_type in VARIABLES.items():
        dictionary.add_object(variable(index, 0, data_type))
    for index, members in RECORDS.items():
        record = ODRecord(f"{index:04X}", index)
        for sub, data_type in {0: UNSIGNED8, **members}.items():
            record.add_member(variable(index, sub, data_type))
        dictionary.add_object(record)
    return dictionary


class DriveBus(can.BusABC):
    """What the master sends goes straight into the node; a thread lets its time pass."""

    def __init__(self, bench):
        self.channel_info = "drive on the bench"
        self.bench = bench
        self.lock = threading.Lock()
        self.frames = queue.Queue()
        bench.node._send = lambda can_id, data: self.frames.put((can_id, data))
        self.syncing = self.beating = False
        self._stop = threading.Event()
        self._pump = threading.Thread(target=self._let_time_pass)
        self._pump.start()
        super().__init__(channel=None)

    def send(self, msg, timeout=None):
        with self.lock:
            self.bench.node.receive(msg.arbitration_id, bytes(msg.data))

    def _recv_internal(self, timeout):
        try:
            can_id, data = self.frames.get(timeout=timeout)
        except queue.Empty:
            return None, False
        message = can.Message(
            timestamp=time.time(), arbitration_id=can_id, is_extended_id=False, data=data
        )
        return message, False

    def _let_time_pass(self):
        while not self._stop.wait(2e-3):
            with self.lock:
                self.bench.wait(2, sync=self.syncing, beat=self.beating)

    def shutdown(self):
        self._stop.set()
        self._pump.join()
        super().shutdown()


@pytest.fixture
def bus(bench):
    bus = DriveBus(bench)
    yield bus
    bus.shutdown()


@pytest.fixture
def node(bus):
    network = canopen.Network(bus=bus)
    node = BaseNode402(NODE, master_dictionary())
    for name in ("SWITCH_OP_MODE", "SWITCH_STATE_FINAL", "SWITCH_STATE_SINGLE", "CHECK_TPDO"):
        setattr(node, f"TIMEOUT_{name}", 30.0)
    node.sdo.RESPONSE_TIMEOUT = 30.0
    network.add_node(node)
    network.NOTIFIER_CYCLE = 0.05
    network.connect()
    yield node
    network.notifier.stop()
    network.bus = None


def configure(node, delivery):
    """PDOs by the library's own order of writes."""
    node.nmt.state = "PRE-OPERATIONAL"
    node.pdo.read()
    rpdo, tpdo = node.rpdo[1], node.tpdo[1]
    rpdo.clear()
    rpdo.add_variable(0x6040)
    rpdo.add_variable(0x6071)
    rpdo.trans_type = delivery
    tpdo.clear()
    tpdo.add_variable(0x6041)
    tpdo.add_variable(0x6064)
    tpdo.add_variable(0x6077)
    tpdo.trans_type = 1
    rpdo.enabled = tpdo.enabled = True
    node.pdo.save()


def test_sdo_reads_and_writes(node):
    assert node.sdo[0x1000].raw == 0x20192
    assert node.sdo[0x1018][1].raw == 0x1234
    assert node.sdo[0x1008].raw == "simulated servo drive"
    node.sdo[0x6007].raw = 3
    assert node.sdo[0x6007].raw == 3
    node.sdo.download(0x1006, 0, (1000).to_bytes(4, "little"), force_segment=True)
    assert node.sdo[0x1006].raw == 1000
    for code, access in (
        (0x06020000, lambda: node.sdo.upload(0x3000, 0)),
        (0x06090011, lambda: node.sdo.upload(0x1018, 9)),
        (0x06010002, lambda: node.sdo.download(0x1000, 0, bytes(4))),
        (0x06070010, lambda: node.sdo.download(0x1017, 0, bytes(5))),
        (0x06090030, lambda: node.sdo.download(0x6060, 0, b"\x08")),
        (0x05040001, lambda: node.sdo.open(0x1008, 0, "rb", block_transfer=True)),
    ):
        with pytest.raises(canopen.SdoAbortedError) as refusal:
            access()
        assert refusal.value.code == code


def test_nmt_heartbeat_and_boot_up(node):
    node.sdo[0x1017].raw = 10
    assert node.nmt.wait_for_heartbeat(30) == "PRE-OPERATIONAL"
    for state in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"):
        node.nmt.state = state
        assert node.nmt.wait_for_heartbeat(30) == state
    waiting = threading.Thread(target=node.nmt.wait_for_bootup, args=(30,))
    waiting.start()
    end = time.monotonic() + 25
    while waiting.is_alive() and time.monotonic() < end:
        node.nmt.state = "RESET"  # again, where the library did not wait yet
        waiting.join(0.2)
    assert not waiting.is_alive()


def test_the_mapping_is_read_back_as_saved(node):
    configure(node, 1)
    node.pdo.read()
    assert [(v.index, v.length) for v in node.rpdo[1]] == [(0x6040, 16), (0x6071, 16)]
    assert [(v.index, v.length) for v in node.tpdo[1]] == [(0x6041, 16), (0x6064, 32), (0x6077, 16)]
    assert (node.rpdo[1].cob_id, node.tpdo[1].cob_id) == (0x205, 0x185)
    assert not node.tpdo[2].enabled


@pytest.mark.parametrize("delivery", [1, 255])
def test_the_library_commands_all_states_of_the_drive(bus, node, bench, delivery):
    configure(node, delivery)
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine(read_pdos=False)
    bus.syncing = True
    if delivery == 1:  # the library does not send such a PDO by itself
        node.rpdo[1].start(0.005)
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    assert node.op_mode == "CYCLIC SYNCHRONOUS TORQUE"
    assert eventually(lambda: node.state == "SWITCH ON DISABLED")
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
        assert node.state == state
    assert bench.plant.enabled
    node.rpdo[1][0x6071].raw = 150
    if delivery == 255:
        node.rpdo[1].transmit()
    assert eventually(lambda: node.tpdo[1][0x6077].raw == 150)
    assert eventually(lambda: node.tpdo[1][0x6064].raw > 10)
    assert node.tpdo[1][0x6041].raw == 0x1237
    node.state = "QUICK STOP ACTIVE"
    assert eventually(lambda: node.state == "SWITCH ON DISABLED")
    with bus.lock:
        bench.assert_off()
    node.rpdo[1].stop()


def test_a_lost_heartbeat_reaches_the_library_s_emergency_consumer(bus, node, bench):
    configure(node, 255)
    node.sdo[0x1016][1].raw = 100 << 16 | 50
    node.sdo[0x6007].raw = 1
    node.sdo[0x1029][1].raw = 1
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine(read_pdos=False)
    bus.syncing = bus.beating = True
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    assert eventually(lambda: node.state == "SWITCH ON DISABLED")
    node.state = "OPERATION ENABLED"
    assert node.emcy.active == []
    bus.beating = False
    assert eventually(lambda: node.emcy.active)
    assert (node.emcy.active[0].code, node.emcy.active[0].register) == (0x8130, 0x11)
    assert eventually(lambda: node.state == "FAULT")
    with bus.lock:
        bench.assert_off()
    bus.beating = True
    with bus.lock:
        bench.beat()
    node.controlword = 0x00
    node.controlword = 0x80
    assert eventually(lambda: node.state == "SWITCH ON DISABLED")
    assert eventually(lambda: node.emcy.active == [])
