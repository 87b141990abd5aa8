"""No sequence of commands and faults reaches torque without an enabled, healthy session."""

import pytest
from cases import further
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from operated_daemons import (
    CommandError,
    DaemonState,
    DaemonStateMachine,
    IllegalTransitionError,
    Peer,
)

from rigd.devices.contracts import DeviceError

MOST_CALLS = 1500
"""Calls of the drive in a session: rest, settling, record, return, second tare."""


def sessions(duration_s):
    return {
        "excitation": "hold",
        "parameters": {"duration_s": duration_s, "rest_s": 0.0, "ring_down_s": 0.0},
    }


def device_fails(operated, drive):
    raise DeviceError("The drive is gone.")


def limit_is_violated(operated, drive):
    drive.offset_rad += 0.5


def control_dies(operated, drive):
    operated.rig._group.control.kill()


def recorder_dies(operated, drive):
    operated.rig._group.recorder.kill()


def stop_is_requested(operated, drive):
    operated.meanwhile("stop")


def everything_is_requested(operated, drive):
    for command in ("tare", "zero", "reset"):
        assert isinstance(operated.meanwhile(command), CommandError)
    assert isinstance(operated.meanwhile("start", **sessions(0.3)), CommandError)


def client_leaves(operated, drive):
    operated.service.release_control(operated.peer)


INCIDENTS = (
    device_fails,
    limit_is_violated,
    control_dies,
    recorder_dies,
    stop_is_requested,
    everything_is_requested,
    client_leaves,
)


def make_machine(operate):
    class Daemon(RuleBasedStateMachine):
        def __init__(self):
            super().__init__()
            self.operated = operate().open()
            self.world = self.operated.world
            self.reset_requested = False

        def arrange(self, incident, when):
            self.world.countdown = when
            self.world.then = incident and (lambda drive: incident(self.operated, drive))

        def settle(self):
            self.world.then = None
            for drive in self.world.drives:
                drive.offset_rad = 0.0

        def request(self, command, **fields):
            before, event_count = self.operated.state, len(self.operated.events)
            reply = self.operated.request(command, **fields)
            self.settle()
            states = [e for e in self.operated.events[event_count:] if e["event"] == "state"]
            if before == "fault" and command != "reset":
                assert isinstance(reply, CommandError) or command == "stop"
                assert states == []
            if before != "fault":
                assert all(event["from"] != "fault" for event in states)
            return reply

        @rule(
            incident=st.sampled_from((None, *INCIDENTS)),
            when=st.integers(1, MOST_CALLS),
            repeat=st.integers(1, 2),
            ms=st.integers(50, 400),
        )
        def start(self, incident, when, repeat, ms):
            self.arrange(incident, when)
            highest = self.world.highest_nm
            self.world.highest_nm = 0.0
            ready = self.operated.state == "ready" and not self.operated.rig.zero_lost
            reply = self.request("start", **sessions(ms / 1000), repeat=repeat)
            assert isinstance(reply, CommandError) != ready
            if not ready:
                assert self.world.highest_nm == 0.0
            elif incident is None:
                assert self.operated.state == "ready"
                assert len(self.operated.last["sessions"]) == repeat
                assert self.world.highest_nm > 0.0
            self.world.highest_nm = max(highest, self.world.highest_nm)

        @rule(
            command=st.sampled_from(("tare", "zero")),
            incident=st.sampled_from((None, device_fails, control_dies, limit_is_violated)),
            when=st.integers(1, 600),
        )
        def measure(self, command, incident, when):
            self.arrange(incident, when)
            before = self.world.highest_nm
            self.request(command)
            assert self.world.highest_nm == before

        @rule(absent=st.booleans())
        def reset(self, absent):
            fault = self.operated.state == "fault"
            self.world.absent = absent
            reply = self.request("reset")
            self.world.absent = False
            if isinstance(reply, CommandError):
                assert absent or not fault
            else:
                assert self.operated.state == "ready"

        @rule()
        def stop(self):
            assert self.request("stop") == {"stopping": False}

        @rule()
        def another_client_comes(self):
            self.operated.peer = Peer(self.operated.peer.number + 1, 300, 0)
            assert isinstance(self.request("tare"), dict) == (
                self.operated.service.controller == self.operated.peer
                and self.operated.state == "ready"
            )
            self.operated.service.release_control(self.operated.peer)
            self.operated.peer = self.operated.service.controller or self.operated.peer

        @rule()
        def control_dies_between_sessions(self):
            if self.operated.rig.connected:
                self.operated.rig._group.control.kill()
            self.operated.watch()
            assert self.operated.state == "fault"

        @rule()
        def time_passes(self):
            before = self.operated.state
            self.operated.watch()
            assert self.operated.state is before

        @invariant()
        def torque_only_in_a_session(self):
            assert self.world.wrong == []
            assert all(drive.safe for drive in self.world.drives)
            assert self.operated.state in (DaemonState.READY, DaemonState.FAULT)
            if self.operated.state == "ready":
                assert self.operated.rig.connected

        def teardown(self):
            self.operated.close()
            assert all(drive.safe for drive in self.world.drives)
            assert not self.operated.rig.connected

    return Daemon


@pytest.mark.parametrize("sequences", [6, further(25)])
def test_no_sequence_of_commands_and_faults_reaches_torque(operate, sequences):
    run_state_machine_as_test(
        make_machine(operate),
        settings=settings(
            max_examples=sequences,
            stateful_step_count=12,
            suppress_health_check=list(HealthCheck),
        ),
    )


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        ((), DaemonState.RUNNING),
        ((), DaemonState.STOPPING),
        ((DaemonState.READY,), DaemonState.STOPPING),
        ((DaemonState.READY, DaemonState.RUNNING), DaemonState.IDLE),
        ((DaemonState.READY, DaemonState.RUNNING, DaemonState.STOPPING), DaemonState.RUNNING),
        ((DaemonState.FAULT,), DaemonState.RUNNING),
        ((DaemonState.FAULT,), DaemonState.STOPPING),
    ],
)
def test_illegal_transitions(path, wrong):
    transitions = []
    machine = DaemonStateMachine(transitions.append)
    for state in path:
        machine.change_to(state, "test")
    with pytest.raises(IllegalTransitionError):
        machine.change_to(wrong, "test")
    assert machine.state is (path[-1] if path else DaemonState.IDLE)
    assert len(transitions) == len(path)


def test_history_is_bounded_and_has_times():
    clock = iter(range(10_000))
    machine = DaemonStateMachine(utc_ns=lambda: next(clock))
    assert machine.since_utc_ns == 0
    for _ in range(100):
        machine.change_to(DaemonState.READY, "in")
        machine.change_to(DaemonState.IDLE, "out")
    assert len(machine.history) == 50
    assert machine.since_utc_ns == 200
    assert machine.history[-1].reason == machine.reason == "out"
