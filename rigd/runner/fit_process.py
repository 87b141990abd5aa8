"""The fit process: fits the record of a running session and plans the next excitation.

The process observes the ring of samples as the live publisher does, so that it neither delays the
loop nor takes samples from the recorder. It passes the samples to the analyser's fit program
(``python -m analysis.online``) and the answers to the supervisor. If the session runs until a
precision is reached, each answer also decides on the next segment of the reference
(`ExcitationPlanner`).
"""

import contextlib
import json
import os
import queue
import subprocess
import threading
from typing import Any, BinaryIO, Final, Self, cast

from rigd.engine import Observer
from rigd.engine.channels import Channels, attach_channels
from rigd.engine.messages import Failed, FileHeader, FitJob, FitReady, FitReport, RecordEnded
from rigd.engine.processes import Parent
from rigd.engine.realtime import pin_off_loop_core
from rigd.engine.reference import ReferenceWriter
from rigd.engine.shared_state import StateField
from rigd.runner._precision_search import ExcitationPlanner
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED
from rigd.runtime import ignore as ignore_signals
from rigd.session.layout import SAMPLE_SIZE, decode_samples
from rigd.session.online_fit import (
    EstimateRequest,
    StreamStart,
    estimate_lines,
    write_request,
    write_samples,
    write_start,
)

_PROGRAM: Final = "analysis.online"
_BLOCK: Final = 500
_IDLE_S: Final = 0.005
_EVERY_S: Final = 1.0
"""Time between two fits of a session with a given reference."""
_GRACE_S: Final = 1.0
_FIRST_REQUEST: Final = 1_000_000_000
"""First id of requested estimates; the ids of periodic estimates start at 0."""


class FitProgramError(Exception):
    """The fit program ended; the message states how."""


def main() -> None:
    """Run as ``python -m rigd.runner.fit_process``."""
    ignore_signals()
    parent = Parent()
    job: FitJob = parent.receive_job()
    if job.realtime is not None:
        pin_off_loop_core(job.realtime.cpu)
    try:
        with FitProgram() as program:
            follower = _Follower(job, parent, program, attach_channels(job.channels))
            try:
                follower.follow()
            except BrokenPipeError:
                raise program.ended() from None
    except FitProgramError as error:
        parent.send(Failed(str(error)))
        raise SystemExit(1) from None


class FitProgram:
    """The analyser's fit program; leaving the context ends it."""

    def __init__(self) -> None:
        try:
            self._process = subprocess.Popen(
                [*OWN_PYTHON, "-m", _PROGRAM, "--parent", str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | SINGLE_THREADED,
            )
        except OSError as error:
            raise FitProgramError(
                f"The fit program cannot be started ({error.strerror})."
            ) from None
        self.input = cast("BinaryIO", self._process.stdin)
        """Input stream, in the format of `rigd.session.online_fit`."""
        self._answers: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def answer(self) -> dict[str, Any] | None:
        """Return the next answer, or None if there is none; raise if the program has ended."""
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            return None
        if answer is None:
            raise self.ended()
        return answer

    def ended(self) -> FitProgramError:
        """Return an error that states how the program ended."""
        code = self._process.wait()
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return FitProgramError(f"The fit program {how}.")

    def _read(self) -> None:
        assert self._process.stdout is not None
        with contextlib.suppress(ValueError):  # incomplete line: the program ended while writing
            for line in self._process.stdout:
                self._answers.put(json.loads(line))
        self._answers.put(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self.input.close()
        try:
            self._process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class _Follower:
    """Fit one session, from its first sample to the fit of the whole record."""

    def __init__(
        self, job: FitJob, parent: Parent, program: FitProgram, channels: Channels
    ) -> None:
        self._parent = parent
        self._program = program
        self._shared_state = channels.shared_state
        self._reader = Observer(channels.samples, job.first)
        self._job = job
        self._search: ExcitationPlanner | None = None
        self._pending: EstimateRequest | None = None
        self._ahead = False
        self._before: dict[str, Any] | None = None
        self._ticks = self._number = 0
        self._ended_after: int | None = None

    def follow(self) -> None:
        """Run until the whole record is fitted, or the supervisor has ended."""
        self._parent.send(FitReady())
        while True:
            self._shared_state.beat(StateField.FIT_BEAT)
            moved = self._feed()
            answer = self._program.answer()
            if answer is not None and self._answered(answer):
                return
            self._ask(drained=not moved)
            try:
                message = self._parent.poll(0.0 if moved else _IDLE_S)
            except EOFError:
                return
            match message:
                case FileHeader():
                    self._begin(message)
                case RecordEnded(ticks):
                    self._ended_after = ticks
                    if self._search is not None and self._search.due is not None:
                        before, begun = (
                            self._shared_state[StateField.HELD_BEFORE],
                            self._shared_state[StateField.BEGUN],
                        )
                        self._parent.send(self._search.ended(ticks, before, begun))

    def _begin(self, header: FileHeader) -> None:
        """Start the fits with the header of the session file."""
        job = self._job
        if job.search is not None:
            writer = ReferenceWriter(job.reference, self._shared_state)
            start_rad = float(header.metadata["start_angle_rad"])
            self._search = ExcitationPlanner(job.search, job.profile, writer, start_rad=start_rad)
        every_s = _EVERY_S if job.search is None else None
        start = StreamStart(dict(header.metadata), dict(header.segments), every_s)
        write_start(self._program.input, start)

    def _feed(self) -> bool:
        """Pass recorded samples to the fit program; return whether there were any."""
        block = self._reader.take(_BLOCK)
        if not block:
            return False
        write_samples(self._program.input, block)
        self._ticks = int(decode_samples(block[-SAMPLE_SIZE:])["tick"][0]) + 1
        return True

    def _ask(self, *, drained: bool) -> None:
        """Request the next estimate as soon as its samples are available."""
        if self._pending is not None:
            return
        search = self._search
        if self._ended_after is not None:
            if drained:
                self._request(self._ended_after, whole=True)
        elif (
            search is not None
            and search.due is not None
            and search.is_begun(self._shared_state[StateField.BEGUN])
        ):
            # Read after the samples: the loop counts a held tick before it publishes the sample.
            tick = search.due + self._shared_state[StateField.HELD]
            if self._ticks >= tick:
                self._request(tick, whole=search.may_be_last, from_last=True)

    def _request(self, tick: int, *, whole: bool, from_last: bool = False) -> None:
        self._number += 1
        self._pending = EstimateRequest(_FIRST_REQUEST + self._number, tick, whole, from_last)
        write_request(self._program.input, self._pending)

    def _answered(self, answer: dict[str, Any]) -> bool:
        """Report an estimate and plan with it; return whether it is of the whole record."""
        request, search = self._pending, self._search
        if request is not None and request.id != answer["id"]:
            request = None
        # Only the last estimate is requested without start values from the previous one.
        final = request is not None and request.tick == self._ended_after and not request.from_last
        ahead = self._ahead
        if request is not None:
            self._pending, self._ahead = None, False
        if search is not None and not final:
            if request is not None and self._ended_after is None and not ahead:
                self._decide(search, request, answer)
            return False
        answer["text"] = estimate_lines(answer, self._before)
        if search is None:
            self._before = answer
        else:
            answer["search"] = search.state(answer)
        self._parent.send(FitReport(answer, final=final))
        return final

    def _decide(
        self, search: ExcitationPlanner, request: EstimateRequest, answer: dict[str, Any]
    ) -> None:
        """Plan the next segment from an estimate."""
        held, before = (
            self._shared_state[StateField.HELD],
            self._shared_state[StateField.HELD_BEFORE],
        )
        for message in search.decide(answer, held, before):
            self._parent.send(message)
        if search.needs_early_fit:
            # This fit of all structures gives start values for the check of the whole record.
            self._request(request.tick, whole=True, from_last=True)
            self._ahead = True


if __name__ == "__main__":
    main()
