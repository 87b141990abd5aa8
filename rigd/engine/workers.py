"""The table of workers: each child process of rigd, how it is started, and what its loss entails.

Each row is a `Worker`, which `rigd.engine.processes.ChildProcess` starts. What the processes of
rigd use of the analyser is named here as text, because rigd does not import it.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rigd.engine._control_names import CONTROL_MODULE
from rigd.engine.shared_state import StateField


@dataclass(frozen=True, slots=True)
class MemoryLimit:
    """Limit of a worker's address space, as a fraction of the memory that is available."""

    available_fraction: float
    """Fraction of the available memory that the worker may use."""
    min_bytes: int
    """Memory in bytes that the worker may use in any case."""
    max_bytes: int
    """Maximum memory in bytes, however much is available."""

    def bytes_now(self, meminfo: Path = Path("/proc/meminfo")) -> int:
        """Return the limit in bytes for a worker that is started now.

        Parameters
        ----------
        meminfo
            File in which the system states the available memory.
        """
        available_text = meminfo.read_text().partition("MemAvailable:")[2].split()[0]
        allowed_bytes = int(self.available_fraction * int(available_text) * 1024)
        return min(max(allowed_bytes, self.min_bytes), self.max_bytes)


@dataclass(frozen=True, slots=True, kw_only=True)
class Worker:
    """Description of a kind of child process: how it is started, what it sends, how it ends."""

    name: str
    """Name of the process in messages to the operator."""
    module: str
    """Module that is run as ``python -m module``; empty for the supervisor."""
    sent_messages: tuple[str, ...] = ()
    """Class names of the messages that the process sends; the first one means that it is ready.
    Empty for a program, whose results are files and an exit code."""
    consequence: str
    """Sentence for the operator that states what happens after the loss of the process."""
    restarts: int = 0
    """Maximum number of restarts in a session; for the page, of consecutive restarts."""
    beat: StateField | None = None
    """Field of the shared state with its heartbeat; None: it has no access to the shared state."""
    start_timeout_s: float = 20.0
    """Longest time in s for the process to become ready on a busy computer."""
    max_silence_s: float | None = None
    """Longest time in s without a heartbeat; None: not limited."""
    end_timeout_s: float
    """Time in s that the process has to exit on request, and after SIGTERM before it is killed."""
    is_per_session: bool = False
    """Whether each session starts a new process of this kind."""
    niceness: int | None = 0
    """Increment of the niceness; None: the process runs only on an otherwise idle processor."""
    memory: MemoryLimit | None = None
    """Limit of the process's memory; None: no limit."""
    prefers_oom_kill: bool = False
    """Whether the system ends this process first if memory runs out."""
    captures_stderr: bool = False
    """Whether `ChildProcess` reads its standard error instead of showing it to the operator."""


# Processes of a rig, which share its memory

CONTROL: Final = Worker(
    name="control",
    module=CONTROL_MODULE,
    # It takes its real-time priority itself, as the profile states.
    sent_messages=(
        "DevicesConnected",
        "ReadyToRecord",
        "SessionFinished",
        "MeasurementResult",
        "MeasurementRefused",
        "ControlEnded",
    ),
    consequence="The drive's watchdog switches it off, if it acts; the session ends as a fault.",
    beat=StateField.CONTROL_BEAT,
    max_silence_s=3.0,
    end_timeout_s=5.0,
)
RECORDER: Final = Worker(
    name="recorder",
    module="rigd.engine.recorder",
    sent_messages=("FileOpened", "RecorderReady", "FileClosed", "ProcessFailed"),
    consequence="The session ends as a fault.",
    beat=StateField.RECORDER_BEAT,
    # A disk may stall for seconds; the number of waiting samples is checked instead.
    max_silence_s=None,
    end_timeout_s=5.0,
    is_per_session=True,
)
LIVE: Final = Worker(
    name="live",
    module="rigd.live.publisher",
    sent_messages=("LiveAddress", "LiveSessionShown", "ProcessFailed"),
    consequence="It is not restarted; the session continues.",
    restarts=3,
    beat=StateField.LIVE_BEAT,
    start_timeout_s=60.0,
    max_silence_s=5.0,
    end_timeout_s=2.0,
)
TOUCH: Final = Worker(
    name="touch",
    module="rigd.engine.touch_estimator",
    sent_messages=("TouchReady", "TouchReport"),
    consequence="Touches are detected but not estimated; the session continues.",
    beat=StateField.TOUCH_BEAT,
    start_timeout_s=60.0,  # it computes the responses of the beam first
    # An estimate may take long; a missing estimate is reported as such.
    max_silence_s=None,
    end_timeout_s=1.0,
    is_per_session=True,
)
FIT: Final = Worker(
    name="fit",
    module="rigd.runner.fit_process",
    sent_messages=("FitReady", "FitReport", "PlannedSegment", "SearchEnded", "ProcessFailed"),
    # A session that plans itself ends with what is planned instead.
    consequence="The session continues without fits.",
    beat=StateField.FIT_BEAT,
    # A decision may take long on a busy computer; the loop holds the angle meanwhile.
    max_silence_s=30.0,
    end_timeout_s=1.0,
    is_per_session=True,
    niceness=5,  # a third of a processor in competition with another program
    prefers_oom_kill=True,
)
SUPERVISOR: Final = Worker(
    name="supervisor",
    module="",
    consequence="The control process ends the session as a fault.",
    beat=StateField.SUPERVISOR_BEAT,
    max_silence_s=2.0,
    end_timeout_s=0.0,
)

PROCESSES: Final = (CONTROL, RECORDER, LIVE, TOUCH, FIT, SUPERVISOR)
"""All processes of a rig in the order in which they are ended: first the control process, which
switches the torque off."""


# Processes of the daemon and of its page

PAGE: Final = Worker(
    name="page",
    module="rigd.web",
    sent_messages=("OperatorPageServed", "ProcessFailed"),
    consequence="It is not started again; the rig does not need it.",
    restarts=4,
    end_timeout_s=3.0,
)
PREDICTION: Final = Worker(
    name="prediction",
    module="rigd.daemon.background",
    sent_messages=("JobPerformed",),
    consequence="The client's request is refused.",
    end_timeout_s=0.0,
    niceness=19,  # it may run during a session
    # Apart from the control process of a session, the memory of no process is locked. A session of
    # two minutes needs 180 MiB, of which 120 MiB are the program.
    memory=MemoryLimit(available_fraction=0.25, min_bytes=256 << 20, max_bytes=4 << 30),
    prefers_oom_kill=True,
    captures_stderr=True,
)
PLAN: Final = Worker(
    name="plan",
    module=PREDICTION.module,
    sent_messages=PREDICTION.sent_messages,
    consequence="The session is not started.",
    end_timeout_s=0.0,
    memory=PREDICTION.memory,
    prefers_oom_kill=True,
    captures_stderr=True,
)


# Programs and other parts of the analyser

ONLINE_ESTIMATOR: Final = "analysis.online:OnlineEstimator"
"""Class with which the process `FIT` makes its estimates, as ``module:name``."""

QUICK_LOOK: Final = Worker(
    name="quick look",
    module="analysis.quick_look",
    consequence="The session has no quick look.",
    end_timeout_s=0.5,
    # Not the lowest priority, because other programs may never pause.
    niceness=10,
    prefers_oom_kill=True,
    captures_stderr=True,
)
REPORT: Final = Worker(
    name="report",
    module="analysis",
    consequence="The report, campaign or export is not made.",
    end_timeout_s=5.0,
    niceness=None,
    prefers_oom_kill=True,
    captures_stderr=True,
)

WORKERS: Final = (*PROCESSES, PAGE, PREDICTION, PLAN, QUICK_LOOK, REPORT)
"""All workers."""
