"""A session in this process: simulated devices under the virtual clock, with faults on demand."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from shipped_profile import load_shipped

from rigd.devices import open_devices
from rigd.devices.contracts import Devices
from rigd.engine import shared_memory_fd
from rigd.engine.channels import DESCRIPTOR_COUNT, create_channels
from rigd.engine.control_process import run_control
from rigd.engine.messages import SessionFinished, SessionJob
from rigd.engine.reference import write_reference
from rigd.engine.shared_state import Phase, StateField, read_events
from rigd.engine.timing import VirtualClock
from rigd.excitation import chirp
from rigd.runtime import StopRequest
from rigd.safety.limits import RECORDER_BUFFER_S
from rigd.session.layout import decode_samples


@dataclass
class WatchedDrive:
    """The simulated drive, with a log of its commands, and faults from a given read on."""

    inner: object
    fault_at: int | None = None
    fault: object = None
    stale_at: int | None = None
    stale_pattern: tuple = (True,)
    """Staleness of the reads from then on, repeated."""
    reads: int = 0
    held_rad: float = 0.0
    doubt: str = ""
    enabled: bool = False
    torque_nm: float = 0.0
    torques: list = field(default_factory=list)

    @property
    def angle_stale(self):
        if self.stale_at is None or self.reads < self.stale_at:
            return False
        return self.stale_pattern[(self.reads - self.stale_at) % len(self.stale_pattern)]

    @property
    def angle_time_ns(self):
        return self.inner.angle_time_ns

    @property
    def off_doubt(self):
        return self.doubt

    def connect(self):
        self.inner.connect()

    def enable(self, stop=None):
        self.inner.enable()
        self.enabled = True

    def latch(self, due_ns):
        self.inner.latch(due_ns)

    def read_angle(self):
        self.reads += 1
        angle_rad = self.inner.read_angle()
        if self.angle_stale:
            return self.held_rad
        self.held_rad = angle_rad
        if self.fault_at is not None and self.reads >= self.fault_at:
            return self.fault(angle_rad)
        return angle_rad

    def command(self, torque_nm):
        assert self.enabled
        self.torque_nm = torque_nm
        self.torques.append(torque_nm)
        return self.inner.command(torque_nm)

    def health(self):
        return self.inner.health()

    def disable(self):
        self.inner.disable()
        self.enabled = False
        self.torque_nm = 0.0

    def close(self):
        self.inner.close()


class FakeParent:
    """A supervisor that gives its orders, records the messages, and can die or hang."""

    def __init__(self, shared_state):
        self.shared_state = shared_state
        self.hangs = False
        self.orders = []
        self.messages = []
        self.living = True

    def poll(self, timeout_s):
        if not self.orders:
            raise EOFError
        return self.orders.pop(0)

    def messages_of(self, kind):
        """The messages of a kind."""
        return [message for message in self.messages if isinstance(message, kind)]

    def send(self, message):
        self.messages.append(message)

    def alive(self):
        if not self.hangs:
            self.shared_state.beat(StateField.SUPERVISOR_BEAT)
        return self.living


def strict(profile):
    """The limits on missed ticks that a rig would have; the recorder may lag until it loses.

    The ways from and to rest are as short as they may be.
    """
    limits = replace(
        profile.limits, missed_ticks_in_a_row=50, missed_percent=2.0, recorder_lag_s=100.0
    )
    brief = replace(profile.session, tare_s=0.5, return_s=0.3)
    return replace(profile, limits=limits, session=brief)


class Session:
    """One session, run to its end in this process.

    The record is small enough for the rings to hold it, so that no reader is needed meanwhile.
    """

    def __init__(self, clock=None, profile=None, excitation=None, buffered_s=RECORDER_BUFFER_S):
        self.profile = profile or strict(load_shipped("sim"))
        self.excitation = excitation or chirp(
            rate_hz=self.profile.rig.rate_hz,
            duration_s=2.0,
            rest_s=0.5,
            ring_down_s=0.5,
            stop_hz=5.0,
        )
        self.channels = create_channels(
            self.profile.rig.rate_hz,
            [shared_memory_fd() for _ in range(DESCRIPTOR_COUNT)],
            buffered_s,
        )
        self.shared_state = self.channels.shared_state
        self.parent = FakeParent(self.shared_state)
        self.stop = StopRequest()
        self.obtained = {}
        devices = open_devices(self.profile.rig)
        self.drive = WatchedDrive(devices.drive)
        self.devices = Devices(self.drive, devices.sensor, True, devices.renew_noise)
        self.clock = clock or VirtualClock()
        self.shared_state[StateField.RECORD_MAY_START] = 1

    def run(self):
        return self.obey(self.order())

    def order(self, excitation=None, seed=1):
        """Order a session: this one's, or one with another excitation."""
        reference_rad = (excitation or self.excitation).reference_rad
        reference = write_reference(shared_memory_fd(), reference_rad)
        return SessionJob(self.profile, reference, seed=seed)

    def obey(self, *orders):
        """Run the control process from connecting to closing, with these orders in between."""
        self.parent.orders = list(orders)
        run_control(
            self.profile,
            self.devices,
            self.clock,
            self.channels,
            self.parent,
            self.stop,
            self.obtained,
        )
        return self

    @property
    def finished(self):
        return self.parent.messages_of(SessionFinished)[-1]

    @property
    def samples(self):
        blocks = []
        while block := self.channels.samples.take(1000):
            blocks.append(decode_samples(block))
        return np.concatenate(blocks) if blocks else None

    @property
    def events(self):
        return read_events(self.channels.events.take(1000))

    def assert_safe(self):
        assert not self.drive.enabled
        assert self.drive.torque_nm == 0.0
        assert self.shared_state[StateField.PHASE] == Phase.OFF

    def close(self):
        self.channels.close()


@pytest.fixture(scope="session")
def complete_session():
    """A session without faults, and its samples; not to be changed."""
    session = Session().run()
    yield session, session.samples
    session.close()


@pytest.fixture
def make_session():
    made = []

    def make(**options):
        made.append(Session(**options))
        return made[-1]

    yield make
    for session in made:
        session.close()


@pytest.fixture
def quiet_profile():
    """The simulated rig without noise, friction and quantisation."""
    profile = load_shipped("sim")
    rig = profile.rig
    simulation = replace(rig.simulation, torque_noise_nm=0.0, force_noise_n=0.0)
    return replace(
        profile,
        rig=replace(
            rig,
            encoder=replace(rig.encoder, resolution_rad=0.0),
            sensor=replace(rig.sensor, resolution=(0.0,) * 6),
            motor=replace(rig.motor, coulomb_nm=0.0),
            simulation=simulation,
        ),
        control=replace(profile.control, friction_compensation_nm=0.0),
    )
