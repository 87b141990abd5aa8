"""The processes of a rig: one table, by which they are started, watched, and ended.

Every process beats: it counts up a word of the board several times a second. A dead process is
noticed at once, a hung one by its beats; what then happens stands here.
"""

from dataclasses import dataclass

from rigd.engine.board import Word


@dataclass(frozen=True, slots=True)
class Process:
    """One kind of process."""

    name: str
    """What messages to the operator call it."""
    module: str
    """Run as ``python -m module``; empty: it is the one that starts the others."""
    beat: Word
    """Its word on the board."""
    hung_after_s: float | None
    """Without a beat; None: judged by what it leaves undone instead."""
    grace_s: float
    """In which it has to end when it is asked to; then it is terminated, then killed."""
    for_one_session: bool
    """A new one is started for each session."""
    loss: str
    """What follows if it dies or hangs."""


CONTROL = Process(
    "control",
    "rigd.engine.control",
    Word.CONTROL_BEAT,
    hung_after_s=3.0,
    grace_s=5.0,
    for_one_session=False,
    loss="the drive goes off by its own watch, the session ends as a fault",
)
RECORDER = Process(
    "recorder",
    "rigd.engine.recorder",
    Word.RECORDER_BEAT,
    # A disk may stall for seconds; the samples that wait for it are what counts.
    hung_after_s=None,
    grace_s=5.0,
    for_one_session=True,
    loss="the session ends as a fault",
)
LIVE = Process(
    "live",
    "rigd.live.publisher",
    Word.LIVE_BEAT,
    hung_after_s=5.0,
    grace_s=2.0,
    for_one_session=False,
    loss="it is started again, the session goes on",
)
SUPERVISOR = Process(
    "supervisor",
    "",
    Word.SUPERVISOR_BEAT,
    hung_after_s=2.0,
    grace_s=0.0,
    for_one_session=False,
    loss="the control process ends the session as a fault",
)

PROCESSES = (CONTROL, RECORDER, LIVE, SUPERVISOR)
"""In the order in which they are ended: the one with the torque first."""


class Pulse:
    """How long a process has not beaten, as seen by one that looks every so often.

    Only time in which the looking process itself ran is counted: a computer that stands still for a
    second has made nobody hang.
    """

    _MOST_PER_LOOK_S = 0.2

    def __init__(self) -> None:
        self._beat = -1
        self._looked_s = 0.0
        self.still_s = 0.0

    def look(self, beat: int, now_s: float) -> float:
        """Take a look at its beat and return for how long it has not changed, in s."""
        passed_s = min(now_s - self._looked_s, self._MOST_PER_LOOK_S)
        self.still_s = self.still_s + passed_s if beat == self._beat else 0.0
        self._beat, self._looked_s = beat, now_s
        return self.still_s
