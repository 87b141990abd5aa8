"""Recorded sessions as Rerun shows them, and Rerun's files."""

import contextlib
import os
import re
import stat
import tomllib
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam, Damping
from rigd.session import Session, SessionError, Status, rename_new
from rigd.view._layout import blueprint
from rigd.view._plots import APPLICATION_ID, TIMELINE
from rigd.view._scene import Picture
from rigd.view._session_info import Health, Note, Subject, outcome_note

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream


Records = npt.NDArray[Any]

_BLOCK_S: Final = 1.0
"""Part of the session that is drawn at a time: as often as the charts are drawn anew."""
_MOST_SPAN: Final = 10
"""Ticks per sample: what lies between few samples would be made up, and fill the disk."""
_LAST_UTC_NS: Final = 2**63 - 1
_PROFILE: Final = "profile.toml"
"""Attachment that tells the nominal damping."""


def subject_of_session(session: Session) -> Subject:
    """Return what the views need to know of a recorded session.

    A stopped session is shown as it was planned, as it was live. Without segments all of
    the record is the sweep.

    Raises
    ------
    SessionError
        If there are no samples, or far too few, or a number is missing, or cannot be a rig's.
    """
    ticks = session.samples["tick"]
    if len(ticks) == 0:
        raise SessionError(f"{session.path}: no samples were recorded, so there is nothing to see.")
    first, end = int(ticks[0]), int(ticks[-1]) + 1
    if session.start_utc_ns > _LAST_UTC_NS:
        raise SessionError(
            f"{session.path}: start_utc_ns is {session.start_utc_ns} ns, after the year 2262, "
            "which Rerun cannot show. Whoever writes the file must correct it."
        )
    if end - first > _MOST_SPAN * len(ticks):
        raise SessionError(
            f"{session.path}: only {len(ticks)} of the {end - first} ticks from {first} to "
            f"{end - 1} have a sample, too few to be shown as a session."
        )
    return Subject(
        name=session.metadata.get("id") or session.path.stem,
        rate_hz=_within(session, "rate_hz", "Hz", 1.0, 1e5),
        ticks=max(end, *(planned for _, planned in session.segments.values()), 0),
        sweep=session.segments.get("sweep", (first, end)),
        beam=Beam(
            _within(session, "beam_length_m", "m", 1e-3, 1e3),
            _within(session, "beam_density_kg_per_m", "kg/m", 1e-6, 1e3),
            _within(session, "beam_bending_stiffness_n_m2", "N·m²", 1e-9, 1e9),
        ),
        damping=nominal_damping(session.attachments.get(_PROFILE, b"")),
        tool_inertia_kg_m2=session.number("tool_inertia_kg_m2", 0.0),
        angle_delay_s=session.number("angle_delay_s", 0.0),
        torque_delay_s=session.number("torque_delay_s", 0.0),
    )


def nominal_damping(profile: bytes) -> Damping | None:
    """Return the nominal damping that a profile states; None if it states none that can be used.

    Only these numbers are looked for: the profile of an older or of a newer program serves as well.
    """
    try:
        table = tomllib.loads(profile.decode("utf-8"))["beam"]["damping"]
        zeta, alpha, gamma, lambda_ = (
            float(table[key]["value"]) for key in ("zeta", "alpha", "gamma", "lambda")
        )
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, KeyError, TypeError, ValueError):
        return None
    # Comparisons are false of what is not a number.
    usable = 0.0 <= zeta <= 1.0 and 0.0 <= alpha < 2.0 and 0.0 <= gamma < np.inf
    return Damping(zeta, alpha, gamma, lambda_) if usable and 0.0 <= lambda_ < 2.0 else None


def draw_session(
    stream: "RecordingStream",
    session: Session,
    timings: Records,
    *,
    layout: "rrb.Blueprint | None" = None,
    on_progress: Callable[[float], None] = lambda _share: None,
) -> None:
    """Draw a recorded session as it was drawn live, so that every chart grows with its time.

    Parameters
    ----------
    stream
        Takes the drawings.
    session
        Session to draw.
    timings
        The readings' ages (n,) of ``TIMING_DTYPE``; there may be none.
    layout
        Layout of the window; by default what `recorded_blueprint` returns.
    on_progress
        Told the share that is drawn, from time to time.

    Raises
    ------
    SessionError
        As `subject_of_session` does.
    """
    subject = subject_of_session(session)
    picture = Picture(subject, lambda: layout or recorded_blueprint())
    # The time at which it is drawn is not to be shown.
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.send_recording_start_time_nanos(session.start_utc_ns)
    for draw in picture.frame():
        draw(stream)
    for draw in picture.events([*_notes(session)]):
        draw(stream)
    samples = session.samples
    counts = np.zeros(3, np.int64)
    done, last_tick = 0, -1
    block_ticks = max(1, round(_BLOCK_S * subject.rate_hz))
    for block, ages in _blocks(samples, timings, block_ticks):
        done += len(block)
        counts += _counts(block, last_tick)
        last_tick = int(block["tick"][-1])
        missed, late, lost = counts.tolist()
        health = Health(missed_ticks=missed, late_ticks=late, lost_ticks=lost)
        for draw in (
            *picture.timings(ages),
            *picture.samples(block),
            *picture.health(int(block["t_ns"][-1]), health),
        ):
            draw(stream)
        on_progress(done / len(samples))
    for draw in picture.finish():
        draw(stream)


def recorded_blueprint(front: "Sequence[rrb.Container]" = ()) -> "rrb.Blueprint":
    """Return the layout of the live view, which here is played from the start.

    Parameters
    ----------
    front
        Tabs that stand before those of the live view.
    """
    import rerun.blueprint as rrb

    live = blueprint()
    return rrb.Blueprint(
        rrb.Tabs(*front, *live.root_container.contents),
        rrb.TimePanel(timeline=TIMELINE, play_state="playing", state="collapsed"),
        live.blueprint_panel,
        live.selection_panel,
    )


def _within(session: Session, key: str, unit: str, least: float, most: float) -> float:
    """Return a number of the file, if a rig can have it."""
    value = session.number(key)
    if not least <= value <= most:
        raise SessionError(
            f"{session.path}: {key} is {value:g} {unit}, but must be from {least:g} to {most:g} "
            f"{unit}. Whoever writes the file must correct it."
        )
    return value


def _notes(session: Session) -> Iterator[Note]:
    """Yield the log of the session, and how it ended, which is told elsewhere in the file."""
    for event in session.events:
        yield Note(event.t_ns, event.level, event.message)
    if session.outcome is not None:
        outcome = session.outcome.get("outcome", "unknown")
        reason = session.outcome.get("reason", "")
        yield outcome_note(int(session.samples["t_ns"][-1]), outcome, reason)


def _counts(samples: Records, last_tick: int) -> npt.NDArray[np.int64]:
    """Return how many ticks were missed, late and lost, (3,), from the one after `last_tick` on."""
    gaps = np.diff(samples["tick"].astype(np.int64), prepend=last_tick) - 1
    status = samples["status"]
    lost = np.where(status & Status.AFTER_LOST, gaps, 0)
    late = (status & Status.LATE) != 0
    return np.array([(gaps - lost).sum(), late.sum(), lost.sum()], np.int64)


def _blocks(
    samples: Records, timings: Records, block_ticks: int
) -> Iterator[tuple[Records, Records]]:
    """Yield samples of `block_ticks` consecutive ticks each, and the timings of the same ticks."""
    starts = np.flatnonzero(np.diff(samples["tick"] // block_ticks)) + 1
    ends = np.append(starts, len(samples))
    last_ticks = samples["tick"][ends - 1]
    timing_ends = np.searchsorted(timings["tick"], last_ticks, side="right")
    first = first_timing = 0
    for end, timing_end in zip(ends, timing_ends, strict=True):
        yield samples[first:end], timings[first_timing:timing_end]
        first, first_timing = end, timing_end


# Files of Rerun's

SUFFIX: Final = ".rrd"
"""Suffix by which Rerun's viewer recognises its files."""

_MAGIC: Final = b"RRF"
_TRIAL_BYTES: Final = 1 << 20
_OS_ERROR: Final = re.compile(r"os error (\d+)")
"""The system's error number in the SDK's messages, whose sentences are not for the operator."""


def without_settings(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment without what is meant for Rerun: ``RERUN=off`` and so on."""
    return {
        name: value
        for name, value in environment.items()
        if not name.lstrip("_").startswith("RERUN")
    }


def settle_sdk() -> None:
    """Prepare this process's environment for the SDK; to be called before it is imported.

    What it has to say of a server that is gone or of a full disk is told by us.
    """
    for name in os.environ.keys() - without_settings(os.environ).keys():
        del os.environ[name]
    os.environ["RUST_LOG"] = "off"


class RrdFileError(Exception):
    """A file of Rerun's cannot be written, or is none."""


@contextlib.contextmanager
def new_rrd_file(path: Path) -> Iterator["RecordingStream"]:
    """Give a recording that is written to a file, which has its name once all is in it.

    Raises
    ------
    RrdFileError
        If there is something of that name, or the file cannot be written.
    """
    settle_sdk()
    import rerun as rr

    check_new(path)
    part = path.with_name(f".rigd-{os.getpid()}-{uuid.uuid4().hex[:8]}.part")
    stream = rr.RecordingStream(APPLICATION_ID, recording_id=str(uuid.uuid4()))
    try:
        with _told(path, part):
            path.parent.mkdir(parents=True, exist_ok=True)
            stream.save(part)
        yield stream
        with _told(path, part):
            stream.flush()
            stream.disconnect()
            rename_new(part, path)
    finally:
        stream.disconnect()
        part.unlink(missing_ok=True)


def check_new(path: Path) -> None:
    """Raise RrdFileError if something has that name, or it is no name of such a file."""
    if path.suffix != SUFFIX:
        raise RrdFileError(f"{path}: name the file ….rrd, which is how Rerun's viewer knows it.")
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return  # the folder is made, or why not is told, when the file is written
    except OSError as error:
        raise RrdFileError(
            f"{path} cannot be written: {error.strerror}. Choose another name."
        ) from None
    raise RrdFileError(
        f"{path} exists; choose another name or move it away, nothing is overwritten."
    )


def check_rrd_file(path: Path) -> None:
    """Raise RrdFileError if a file is no recording of Rerun's, as far as its beginning tells."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise RrdFileError(f"{path} is not a file. Give a recording of Rerun's (*.rrd).")
        with path.open("rb") as file:
            found = file.read(len(_MAGIC))
    except OSError as error:
        raise RrdFileError(
            f"{path} cannot be read: {error.strerror}. Check the path and its permissions."
        ) from None
    if found != _MAGIC:
        raise RrdFileError(
            f"{path} is no recording of Rerun's, though its name says so. Give a session file "
            "(*.mcap), or what `rigd replay … --save` or `analyze … --rerun` wrote."
        )


@contextlib.contextmanager
def _told(path: Path, part: Path) -> Iterator[None]:
    """Say what kept a file from being written."""
    try:
        yield
    except FileExistsError:
        raise RrdFileError(
            f"{path} has appeared meanwhile; choose another name, nothing is overwritten."
        ) from None
    except OSError as error:
        raise RrdFileError(f"{path} cannot be written: {error.strerror}.") from None
    except RuntimeError as error:  # from the SDK
        number = _OS_ERROR.search(str(error))
        cause = os.strerror(int(number[1])) if number else _why_not(part)
        raise RrdFileError(f"{path} cannot be written: {cause}.") from None


def _why_not(part: Path) -> str:
    """Find out by trying why a file does not grow; the SDK may only say that it gave up."""
    try:
        with part.open("ab") as file:
            file.write(bytes(_TRIAL_BYTES))
    except OSError as error:
        return error.strerror or str(error)
    return "Rerun gave up"
