"""The CiA 402 state machine: every transition, and no other."""

import pytest

DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE, RESET = 0x00, 0x02, 0x06, 0x07, 0x0F, 0x80
COMMANDS = (DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE, RESET)

SOD, READY, ON, OP, STOP, FAULT = (
    "switch on disabled",
    "ready to switch on",
    "switched on",
    "operation enabled",
    "quick stop active",
    "fault",
)
PATHS = {
    SOD: (),
    READY: (SHUTDOWN,),
    ON: (SHUTDOWN, SWITCH_ON),
    OP: (SHUTDOWN, SWITCH_ON, ENABLE),
    STOP: (SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP),
}
STATUS = {SOD: 0x0250, READY: 0x0231, ON: 0x0233, STOP: 0x0217, FAULT: 0x0218}

# From the table of commands of CiA 402; what is not listed leaves the state as it is.
TRANSITIONS = {
    (SOD, SHUTDOWN): READY,
    (READY, SWITCH_ON): ON,
    (READY, ENABLE): OP,
    (READY, DISABLE_VOLTAGE): SOD,
    (READY, QUICK_STOP): SOD,
    (READY, RESET): SOD,
    (ON, ENABLE): OP,
    (ON, SHUTDOWN): READY,
    (ON, DISABLE_VOLTAGE): SOD,
    (ON, QUICK_STOP): SOD,
    (ON, RESET): SOD,
    (OP, SWITCH_ON): ON,
    (OP, SHUTDOWN): READY,
    (OP, DISABLE_VOLTAGE): SOD,
    (OP, QUICK_STOP): STOP,
    (OP, RESET): SOD,
    (STOP, ENABLE): OP,
    (STOP, DISABLE_VOLTAGE): SOD,
    (STOP, RESET): SOD,
    (FAULT, RESET): SOD,
}


def go(bench, state):
    bench.write(0x605A, 0, 6, 2)  # stay in quick stop
    bench.configure()
    if state == FAULT:
        bench.node.emergency(0x2310, 0x02, b"")
    else:
        for word in PATHS[state]:
            assert bench.write(0x6040, 0, word, 2) == 0
    assert bench.state() == state


@pytest.mark.parametrize("command", COMMANDS, ids=hex)
@pytest.mark.parametrize("state", [*PATHS, FAULT])
def test_every_command_in_every_state(bench, state, command):
    go(bench, state)
    bench.write(0x6040, 0, command, 2)
    assert bench.state() == TRANSITIONS.get((state, command), state)
    assert bench.plant.enabled == (bench.state() == OP)
    if bench.state() in STATUS:
        assert bench.read(0x6041) & ~0x0400 == STATUS[bench.state()]


@pytest.mark.parametrize("state", [SOD, READY, ON])
@pytest.mark.parametrize("command", [0x86, 0x87, 0x8F], ids=hex)
def test_no_transition_upwards_while_the_reset_bit_is_set(bench, state, command):
    go(bench, state)
    bench.write(0x6040, 0, command, 2)
    assert bench.state() == (READY if (state, command) == (ON, 0x86) else state)


def test_a_fault_is_reset_by_a_rising_edge_only(bench):
    go(bench, SOD)
    bench.write(0x6040, 0, RESET, 2)
    bench.node.emergency(0x2310, 0x02, b"")
    bench.write(0x6040, 0, RESET, 2)  # the bit is still set
    assert bench.state() == FAULT
    bench.write(0x6040, 0, 0, 2)
    assert bench.state() == FAULT
    bench.write(0x6040, 0, RESET, 2)
    assert bench.state() == SOD
    bench.write(0x6040, 0, 0x8F, 2)
    assert bench.state() == SOD


@pytest.mark.parametrize("option", [1, 2])
def test_a_passing_quick_stop_ends_in_switch_on_disabled(bench, option):
    bench.configure().enable()
    bench.write(0x605A, 0, option, 2)
    bench.drive(100)
    bench.write(0x6040, 0, QUICK_STOP, 2)
    assert bench.state() == STOP
    bench.assert_off()
    bench.write(0x6040, 0, ENABLE, 2)  # there is no way back with these options
    assert bench.state() == STOP
    bench.wait(60)
    assert bench.state() == SOD


def test_a_quick_stop_by_disabling_does_not_linger(running):
    running.write(0x605A, 0, 0, 2)
    running.drive(100)
    running.write(0x6040, 0, QUICK_STOP, 2)
    assert running.state() == SOD
    running.assert_off()


@pytest.mark.parametrize("option", [5, 6])
def test_a_lasting_quick_stop_can_be_left(bench, option):
    bench.configure().enable()
    bench.write(0x605A, 0, option, 2)
    bench.write(0x6040, 0, QUICK_STOP, 2)
    bench.wait(200, sync=True)
    assert bench.read(0x6041) == 0x0617  # the shaft is at rest
    assert bench.state() == STOP
    bench.write(0x6040, 0, ENABLE, 2)
    assert bench.state() == OP
    assert bench.plant.enabled


@pytest.mark.parametrize("option", [1, 2])
def test_a_fault_reaction_by_ramp_takes_time_without_torque(running, option):
    running.write(0x605E, 0, option, 2)
    running.drive(300)
    running.node.emergency(0x4310, 0x08, b"")
    assert running.state() == "fault reaction active"
    running.assert_off()
    assert running.read(0x6041) == 0x021F
    running.rpdo(RESET, 0)
    running.sync()
    assert running.state() == "fault reaction active"
    running.wait(60)
    assert running.state() == FAULT


def test_operation_is_not_enabled_outside_of_nmt_operational(bench):
    bench.write(0x6060, 0, 10, 1)
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        bench.write(0x6040, 0, word, 2)
    assert bench.state() == ON
    bench.nmt(1)
    bench.write(0x6040, 0, ENABLE, 2)
    assert bench.state() == OP


def test_a_reset_of_the_node_clears_fault_and_controlword(bench):
    go(bench, FAULT)
    bench.write(0x6040, 0, 0x80, 2)
    bench.node.emergency(0x2310, 0x02, b"")
    bench.nmt(129)
    assert bench.state() == SOD
    assert bench.read(0x6041) == 0x0250
    assert (bench.read(0x1001), bench.read(0x1003)) == (0, 0)
    bench.node.emergency(0x2310, 0x02, b"")
    bench.write(0x6040, 0, 0x80, 2)
    assert bench.state() == SOD


def test_states_are_logged_in_order(bench):
    go(bench, OP)
    states = [values["state"] for _, what, values in bench.events if what == "state"]
    assert states == [SOD, READY, ON, OP]
    assert all(source == "drive" for source, _, _ in bench.events)
    nmt = [values["state"] for _, what, values in bench.events if what == "nmt"]
    assert nmt == ["initialising", "pre-operational", "operational"]
    assert [values for _, what, values in bench.events if what == "mode"] == [{"mode": 10}]
    writes = [values for _, what, values in bench.events if what == "sdo write"]
    assert {"index": "6060", "sub": 0, "value": 10} in writes


def control(bench, *words):
    for word in words:
        bench.write(0x6040, 0, word, 2)


def statusword(bench):
    """Let a period pass; return the statusword of the TPDO at its SYNC."""
    bench.now_s += 1e-3
    word, *_ = bench.sync()
    bench.node.tick(bench.now_s)
    return word


def test_the_wired_stop_without_a_code_is_in_the_statusword(make_bench):
    bench = make_bench(sto_error_code=0).configure().enable()
    assert statusword(bench) & 0x7F == 0x37
    bench.node.sto_dropped = True
    assert not bench.plant.enabled
    assert statusword(bench) & 0x7F == 0x40  # switch on disabled, and no voltage
    control(bench, 0x06, 0x07, 0x0F)
    assert statusword(bench) & 0x4F == 0x40
    bench.node.sto_dropped = False
    assert statusword(bench) & 0x7F == 0x50
    assert not bench.plant.enabled  # nothing happens by itself
    control(bench, 0x06, 0x07, 0x0F)
    assert bench.plant.enabled


def test_the_wired_stop_with_a_code_is_a_lasting_fault(make_bench):
    bench = make_bench(sto_error_code=0xFF20).configure().enable()
    bench.node.sto_dropped = True
    assert not bench.plant.enabled
    assert (0x80 + bench.node_id, bytes.fromhex("20ff010000000000")) in bench.sent
    for _ in range(60):
        word = statusword(bench)
    assert word & 0x4F == 0x08
    control(bench, 0x00, 0x80)
    assert statusword(bench) & 0x4F == 0x08
    bench.node.sto_dropped = False
    control(bench, 0x00, 0x80)
    assert statusword(bench) & 0x4F == 0x40
