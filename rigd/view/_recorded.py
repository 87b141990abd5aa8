"""Drawing of recorded sessions in Rerun, as if they were live."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam
from rigd.documents import DocumentError, parse_toml
from rigd.session import Session, SessionError, linear_sweep_band_hz
from rigd.session.layout import Status
from rigd.session.quick_look import fit_of
from rigd.session.touches import touch_line, touches_of
from rigd.sweep_response import nominal_damping, sweep_ticks
from rigd.text_table import decode_text
from rigd.units import unit_of
from rigd.view._layout import blueprint
from rigd.view._scene import Scene
from rigd.view._session_info import (
    Health,
    Note,
    SessionDescription,
    outcome_note,
)
from rigd.view.banner import ended_state
from rigd.view.plots import AGES, FAULTY_TICKS, HEALTH, REAL_TIME_PLOT_COMPONENTS, TIMELINE

if TYPE_CHECKING:
    import rerun.blueprint as rrb
    from rerun import RecordingStream


Records = npt.NDArray[Any]
"""Structured array of samples or timings, shape (n,)."""

_DRAWING_BLOCK_S: Final = 1.0
"""Duration of the blocks of samples that are drawn together: the charts are updated as often."""
_MAX_TICKS_PER_SAMPLE: Final = 10
"""Largest ratio of a record's length in ticks to its number of samples.

Filling longer gaps would invent data and fill the disk."""
_TOUCH_DRAWING_DELAY_S: Final = 0.2
"""Delay after a touch until it is drawn, so that the antenna's lines around its time exist."""
_MAX_UTC_NS: Final = 2**63 - 1
"""Latest start of a session, in nanoseconds since 1970: the limit of a 64-bit integer."""
_ATTACHMENTS_WITH_DAMPING: Final = ("specimen.toml", "profile.toml")
"""Attachments of a session file that may state the nominal damping; the first that does is used."""


def describe_recorded_session(
    session: Session, tick_timings: Records | None = None, *, has_fit: bool = False
) -> SessionDescription:
    """Return the data of a recorded session that its display needs.

    A stopped session is shown with its planned length, as in the live view. If the file states no
    segments, the whole record counts as the sweep. `tick_timings` are the ages of the devices'
    readings (n,), of ``TIMING_DTYPE``. Raise `SessionError` if there are far too few samples, or if
    a number is missing or not plausible.
    """
    sample_ticks = session.samples["tick"]
    if len(sample_ticks) == 0:
        raise SessionError(f"{session.path}: no samples were recorded, so there is nothing to see.")
    first_tick, end_tick = int(sample_ticks[0]), int(sample_ticks[-1]) + 1
    if session.start_utc_ns > _MAX_UTC_NS:
        raise SessionError(
            f"{session.path}: start_utc_ns is {session.start_utc_ns} ns, after the year 2262, "
            "which Rerun cannot show. The writing program must correct it."
        )
    if end_tick - first_tick > _MAX_TICKS_PER_SAMPLE * len(sample_ticks):
        raise SessionError(
            f"{session.path}: only {len(sample_ticks)} of the {end_tick - first_tick} ticks from "
            f"{first_tick} to {end_tick - 1} have a sample, too few to be shown as a session."
        )
    profile_files = [
        session.attachments.get(attachment_name, b"")
        for attachment_name in _ATTACHMENTS_WITH_DAMPING
    ]
    return SessionDescription(
        name=session.metadata.get("id") or session.path.stem,
        rate_hz=_number_in_range(session, "rate_hz", 1.0, 1e5),
        scheduled_ticks=max(
            end_tick, *(segment_end for _, segment_end in session.segments.values()), 0
        ),
        sweep=sweep_ticks({"sweep": (first_tick, end_tick), **session.segments}),
        beam=Beam(
            _number_in_range(session, "beam_length_m", 1e-3, 1e3),
            _number_in_range(session, "beam_density_kg_per_m", 1e-6, 1e3),
            _number_in_range(session, "beam_bending_stiffness_n_m2", 1e-9, 1e9),
        ),
        damping=next(filter(None, map(nominal_damping, profile_files)), None),
        tool_inertia_kg_m2=session.number("tool_inertia_kg_m2", 0.0),
        angle_delay_s=session.number("angle_delay_s", 0.0),
        torque_delay_s=session.number("torque_delay_s", 0.0),
        excitation=session.metadata.get("excitation", ""),
        sweep_hz=linear_sweep_band_hz(session.metadata.get("excitation", ""), session.metadata),
        return_sweep=session.segments.get("back"),
        specimen=session.metadata.get("specimen", ""),
        limits=_stated_limits(profile_files[-1]),
        absent_components=_components_without_values(session, tick_timings),
        is_recorded=True,
        # The file has only the last fit.
        fitted_mode_count=0 if has_fit else None,
    )


_PROFILE_KEYS_OF_LIMITS: Final = {
    "angle": ("limits", "angle_rad"),
    "velocity": ("limits", "velocity_rad_s"),
    "tracking_error": ("limits", "tracking_error_rad"),
    "torque_command": ("motor", "peak_torque_nm"),
    "i2t": ("motor", "continuous_torque_nm"),
    "missed": ("limits", "missed_percent"),
}
"""Section and key of a profile with the limit of each gauge, by the name of the gauge."""


def _stated_limits(profile_bytes: bytes) -> dict[str, float]:
    """Return the limits that a profile of any version states: gauge name → positive limit."""
    try:
        profile_table = parse_toml(decode_text(profile_bytes))
    except (UnicodeDecodeError, DocumentError):
        return {}
    positive_limits = {}
    for gauge_name, (section_name, key) in _PROFILE_KEYS_OF_LIMITS.items():
        with suppress(KeyError, TypeError, ValueError, OverflowError):
            if (stated_limit := float(profile_table[section_name][key]["value"])) > 0.0:
                positive_limits[gauge_name] = stated_limit
    return positive_limits


def _components_without_values(session: Session, tick_timings: Records | None) -> frozenset[str]:
    """Return the component names in Rerun of the plots for which a session has no values."""
    absent_components = {plot.component for plot in HEALTH.plots if plot is not FAULTY_TICKS}
    if tick_timings is None or len(tick_timings) == 0:
        absent_components.add(AGES.component)
    if not (session.samples["lateness_ns"].any() or session.samples["work_ns"].any()):
        absent_components |= REAL_TIME_PLOT_COMPONENTS
    return frozenset(absent_components)


def draw_session(
    stream: "RecordingStream",
    session: Session,
    tick_timings: Records,
    *,
    front_tabs: "Sequence[rrb.Container]" = (),
    on_progress: Callable[[float], None] = lambda _fraction: None,
) -> None:
    """Draw a recorded session as if it were live, so that every chart grows with time.

    Parameters
    ----------
    stream
        Stream for the drawings.
    session
        Session to draw.
    tick_timings
        Ages of the devices' readings (n,), of ``TIMING_DTYPE``; may be empty.
    front_tabs
        Tabs to show before those of the live view.
    on_progress
        Function that is called from time to time with the fraction of the session that is drawn.

    Raises
    ------
    SessionError
        As `describe_recorded_session` does.
    """
    fit_document = fit_of(session.outcome)
    description = describe_recorded_session(session, tick_timings, has_fit=fit_document is not None)
    scene = Scene(
        description,
        lambda: recorded_blueprint(
            front_tabs,
            description.absent_components,
            fitted_mode_count=description.fitted_mode_count,
        ),
    )
    outcome_document = session.outcome or {}
    banner_state = ended_state(
        outcome_document.get("outcome", "no outcome"), outcome_document.get("reason", "")
    )
    scene.state_drawings(0, replace(banner_state, is_over=False))
    # The viewer shows session time only, not the time of drawing.
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.send_recording_start_time_nanos(session.start_utc_ns)
    for send_drawing in scene.initial_drawings():
        send_drawing(stream)
    remaining_touches = _touches_in_record(session)
    for send_drawing in scene.event_drawings(
        sorted(_session_notes(session, remaining_touches), key=lambda note: note.t_ns)
    ):
        send_drawing(stream)
    recorded_samples = session.samples
    faulty_tick_counts = np.zeros(3, np.int64)
    drawn_sample_count, last_tick = 0, -1
    block_ticks = max(1, round(_DRAWING_BLOCK_S * description.rate_hz))
    for sample_block, block_timings in _sample_blocks(recorded_samples, tick_timings, block_ticks):
        drawn_sample_count += len(sample_block)
        faulty_tick_counts += _count_faulty_ticks(sample_block, last_tick)
        last_tick, t_ns = int(sample_block["tick"][-1]), int(sample_block["t_ns"][-1])
        missed_ticks, late_ticks, lost_ticks = faulty_tick_counts.tolist()
        health = Health(missed_ticks=missed_ticks, late_ticks=late_ticks, lost_ticks=lost_ticks)
        for send_drawing in (
            *scene.timing_drawings(block_timings),
            *scene.sample_drawings(sample_block),
            *scene.health_drawings(t_ns, health),
        ):
            send_drawing(stream)
        touches_to_draw = [
            touch
            for touch in remaining_touches
            if _TOUCH_DRAWING_DELAY_S + touch["time_s"]["value"] < 1e-9 * t_ns
        ]
        for send_drawing in scene.touch_drawings(touches_to_draw):
            send_drawing(stream)
        remaining_touches = remaining_touches[len(touches_to_draw) :]
        on_progress(drawn_sample_count / len(recorded_samples))
    for send_drawing in (
        *scene.final_drawings(),
        *scene.touch_drawings(remaining_touches),
        *(scene.fit_drawings(fit_document) if fit_document is not None else ()),
    ):
        send_drawing(stream)


def recorded_blueprint(
    front_tabs: "Sequence[rrb.Container]" = (),
    absent_components: Collection[str] = (),
    fitted_mode_count: int | None = None,
) -> "rrb.Blueprint":
    """Return the window's layout for a recorded session: that of the live view, playing from 0 s.

    `front_tabs` precede those of the live view; the other arguments are those of `blueprint`.
    """
    import rerun.blueprint as rrb

    live_layout = blueprint(
        absent_components=absent_components, fitted_mode_count=fitted_mode_count
    )
    return rrb.Blueprint(
        rrb.Tabs(*front_tabs, *live_layout.root_container.contents),
        rrb.TimePanel(timeline=TIMELINE, play_state="playing", state="collapsed"),
        live_layout.blueprint_panel,
        live_layout.selection_panel,
    )


def _number_in_range(
    session: Session, metadata_key: str, least_value: float, greatest_value: float
) -> float:
    """Return a number that the session file states; raise SessionError outside a given range."""
    stated_number = session.number(metadata_key)
    if not least_value <= stated_number <= greatest_value:
        raise SessionError(
            f"{session.path}: {metadata_key} is {stated_number:g} {unit_of(metadata_key)}, "
            f"but must be from {least_value:g} to {greatest_value:g} {unit_of(metadata_key)}. The "
            "writing program must correct it."
        )
    return stated_number


def _session_notes(
    session: Session, touch_documents: Sequence[Mapping[str, Any]]
) -> Iterator[Note]:
    """Yield the notes for the log panel of the viewer: events, touches and outcome of a session."""
    for session_event in session.events:
        yield Note(session_event.t_ns, session_event.level, session_event.message)
    for touch in touch_documents:
        yield Note(round(1e9 * touch["time_s"]["value"]), "info", touch_line(touch))
    if session.outcome is not None:
        outcome_name = session.outcome.get("outcome", "unknown")
        outcome_reason = session.outcome.get("reason", "")
        yield outcome_note(int(session.samples["t_ns"][-1]), outcome_name, outcome_reason)


def _touches_in_record(session: Session) -> list[dict[str, Any]]:
    """Return the touches whose estimated time is within the record, in order of time."""
    record_end_s = 1e-9 * int(session.samples["t_ns"][-1])
    touches_with_time = [
        touch for touch in touches_of(session.outcome) if touch["time_s"] is not None
    ]
    touches_in_record = [
        touch for touch in touches_with_time if 0.0 <= touch["time_s"]["value"] <= record_end_s
    ]
    return sorted(touches_in_record, key=lambda touch: touch["time_s"]["value"])


def _count_faulty_ticks(samples: Records, last_tick: int) -> npt.NDArray[np.int64]:
    """Return the numbers of missed, late and lost ticks after the tick `last_tick`, shape (3,)."""
    gap_ticks = np.diff(samples["tick"].astype(np.int64), prepend=last_tick) - 1
    status_bits = samples["status"]
    lost_ticks = np.where(status_bits & Status.AFTER_LOST, gap_ticks, 0)
    is_late = (status_bits & Status.LATE) != 0
    return np.array([(gap_ticks - lost_ticks).sum(), is_late.sum(), lost_ticks.sum()], np.int64)


def _sample_blocks(
    samples: Records, tick_timings: Records, block_ticks: int
) -> Iterator[tuple[Records, Records]]:
    """Yield samples in blocks of `block_ticks` ticks, each with the timings of the same ticks."""
    block_starts = np.flatnonzero(np.diff(samples["tick"] // block_ticks)) + 1
    block_ends = np.append(block_starts, len(samples))
    last_ticks = samples["tick"][block_ends - 1]
    timing_ends = np.searchsorted(tick_timings["tick"], last_ticks, side="right")
    first_sample_index = first_timing_index = 0
    for end, timing_end in zip(block_ends, timing_ends, strict=True):
        yield samples[first_sample_index:end], tick_timings[first_timing_index:timing_end]
        first_sample_index, first_timing_index = end, timing_end
