"""Sequence of a probing move: tare, enable, move to and fro, disable.

It uses the same cycle as a session, with the interlocks, stops and watchdogs, but with another
controller, and records nothing.
"""

from typing import Any

from rigd.engine._probed_rig import probed_rig
from rigd.engine._publish import ReadingPublisher
from rigd.engine._session_sequence import SessionEnd, SessionSequence
from rigd.engine.channels import Channels
from rigd.engine.cycle import Cycle, StandstillMonitor
from rigd.engine.messages import PostRecordPlan
from rigd.engine.processes import SupervisorConnection
from rigd.engine.shared_state import Phase, StateField
from rigd.engine.timing import Clock, TickScheduler
from rigd.profile import Profile
from rigd.runtime import StopRequest
from rigd.safety.probe_estimate import estimate_probe
from rigd.safety.probing_move import ProbingMove, plan_probe


class ProbeSequence(SessionSequence):
    """Sequence of one probing move on connected devices, which measures motor and encoder.

    The parameters are those of a `SessionSequence`.
    """

    def __init__(
        self,
        profile: Profile,
        cycle: Cycle,
        clock: Clock,
        scheduler: TickScheduler,
        standstill: StandstillMonitor,
        channels: Channels,
        reading_publisher: ReadingPublisher,
        parent: SupervisorConnection,
        stop_request: StopRequest,
    ) -> None:
        super().__init__(
            profile, (0.0,), cycle, clock, scheduler, standstill, channels,
            reading_publisher, parent, stop_request, PostRecordPlan(),
        )  # fmt: skip
        self._rig = probed_rig(profile)
        self._move: ProbingMove | None = None
        self._last_tick = 0

    def run_probing_move(self) -> dict[str, Any]:
        """Run the probing move on the enabled drive, switch the torque off, and return the result.

        The result has the name of the reason why the move ended (key ``end``), and the fields of a
        `rigd.safety.probe_estimate.ProbeEstimate`. Raise `SessionEnd` if the operator or an
        interlock ends the move.
        """
        self._shared_state[StateField.PHASE] = Phase.PROBING
        self._standstill.reset()
        cycle = self._cycle
        start_angle_rad = cycle.angle_rad
        probing_move = ProbingMove(self._rig, plan_probe(self._rig), self._rest_spread_nm)
        cycle.encoder_monitor = None  # the move itself compares angle and torques
        cycle.controller = probing_move
        cycle.start_control(self._rest_spread_nm)
        self._run_tick(start_angle_rad, may_miss_ticks=True)  # enabling takes its time
        self._move, self._last_tick = probing_move, self._scheduler.tick
        while probing_move.end is None:
            self._run_tick(cycle.angle_rad)
        cycle.switch_torque_off()
        return {"end": probing_move.end.name} | estimate_probe(self._rig, probing_move).as_dict()

    def _control_tick(self, reference_rad: float) -> SessionEnd | None:
        """Run one tick of the probing move, and report the ticks missed before it to the move."""
        if self._move is not None:
            self._move.missed = max(0, self._scheduler.tick - self._last_tick - 1)
            self._last_tick = self._scheduler.tick
        return super()._control_tick(reference_rad)
