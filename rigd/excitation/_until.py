"""Sessions that end when a precision is reached: their targets, and the initial scan.

The reference of such a session is planned up to the end of a quick sweep over all modes. The
segments after it are planned during the session, from the record so far (`experiment_design`).
"""

from dataclasses import dataclass
from math import pi
from typing import Annotated, Final, Protocol

import numpy as np
from annotated_types import doc
from numpy.typing import NDArray

from rigd.beam import Beam, undamped_frequencies_rad_s
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD
from rigd.excitation._beam_estimate import BeamEstimate
from rigd.excitation._options import RestS, documented
from rigd.excitation._signals import (
    Excitation,
    ExcitationError,
    check_ticks,
    lay_out_segments,
    require_frequency,
    require_positive,
    require_within_turn,
)
from rigd.excitation.experiment_design import DesignRig, geometry_floors
from rigd.excitation.moves import quintic
from rigd.excitation.targets import QUANTITIES, Target, parse_target
from rigd.units import with_percentage

RealArray = NDArray[np.float64]

SEGMENT_PAUSE_S: Final = 0.5
"""Pause in s of the reference for a fit, such as the first. The record gains information meanwhile,
because the beam still rings."""
_SCAN_FADE_S: Final = 0.25
"""Duration in s of the scan's fade at either end."""
_SCAN_LIMIT_FRACTION: Final = 0.8
"""Largest fraction of the limits that the scan uses, since the beam may differ from the profile."""
_SCAN_RELATIVE_FREQUENCIES: Final = (0.2, 1.0, 2.3, 6.3, 12.0)
"""Frequencies, divided by that of mode 1, at which the scan's relative amplitude is given."""
_SCAN_RELATIVE_AMPLITUDES: Final = (1.0, 0.4, 0.19, 0.15, 1.0)
"""Relative amplitudes of the scan at these frequencies, with 1 for its largest amplitude.

If the slope of the tip is limited and modes passed earlier still ring, these amplitudes determine
the dampings of the first three modes equally well. For random beams within a fifth of the profile,
the least certain damping then has 0.63 times the deviation of a scan whose amplitude rises
linearly.
"""
_SCAN_FREQUENCY_POWER: Final = 1.25
"""Power of the time with which the scan's frequency rises, so that low modes get more time."""
_MAX_UNIFORMITY_PERCENT: Final = 10.0
"""Largest valid value of the option `uniformity_percent`."""
_EXAMPLE_TARGET: Final = "--damping 1%"
"""Example of a target on the command line, for an error message."""


class ScanRig(DesignRig, Protocol):
    """Interface to a rig for which a quick sweep through all modes is planned: predictions."""

    def fraction_of_limits(self, reference_rad: RealArray) -> float:
        """Return the largest fraction of a limit that a reference in rad is predicted to use."""

    def tip_slope_rad(self, reference_rad: RealArray) -> float:
        """Return the largest predicted slope in rad of the beam's free end for a reference."""

    @property
    def beam(self) -> Beam:
        """Beam of the rig's profile."""

    @property
    def stated_estimate(self) -> BeamEstimate:
        """Beam of the rig's profile and the sensor's noise, with all parameters free."""

    @property
    def uniformity(self) -> float:
        """Relative standard deviation of the modes' frequencies from those of a uniform beam."""


@dataclass(frozen=True, slots=True)
class PrecisionSearch:
    """Plan of a session that ends at target standard deviations, and begins with a quick sweep.

    Attributes
    ----------
    targets
        Standard deviations to be reached.
    planned_ticks
        Number of ticks of the reference that are planned before the session: rest, scan and pause.
    scan
        First tick of the scan, and its reference angle at each tick, shape (n,).
    tip_slope_rad
        Largest slope of the beam's free end.
    uniformity_percent
        Relative standard deviation of each mode's frequency from that of a uniform beam; None: the
        value of the profile.
    """

    targets: tuple[Target, ...]
    planned_ticks: int
    scan: tuple[int, RealArray]
    tip_slope_rad: float
    uniformity_percent: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PrecisionExcitation(Excitation):
    """Excitation that is planned during the session, until a precision is reached.

    Attributes
    ----------
    search
        Plan of the session: the target standard deviations, and the quick sweep at its beginning.
    """

    search: PrecisionSearch

    @property
    def planned_ticks(self) -> int:
        """Number of ticks of the reference that are planned before the session."""
        return self.search.planned_ticks

    @property
    def later_tip_slope_rad(self) -> float:
        """Largest slope of the beam's free end in the segments that the session plans."""
        return self.search.tip_slope_rad


@documented
def until(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    targets: Annotated[
        str,
        doc(
            "Standard deviations to be reached: one or several of ``QUANTITY STD``, such as "
            "``damping 1%; frequency 1:0.002Hz``; see `rigd.excitation.targets.parse_target`."
        ),
    ],
    at_most_s: Annotated[float, doc("Longest duration of the record in s.")] = 120.0,
    tip_slope_rad: Annotated[
        float,
        doc(
            "Largest slope of the beam's free end. The scan is predicted to use up to 80 % of it, "
            "a segment up to 77 %. Beyond the default, the linear model is not exact."
        ),
    ] = SMALL_TIP_SLOPE_RAD,
    amplitude_rad: Annotated[
        float,
        doc(
            "Largest amplitude of the scan, at its end. The amplitude is a sixth of it at mode "
            "2 and two fifths at mode 1. It is lower if the rig's limits or the slope require "
            "it."
        ),
    ] = 0.05,
    start_hz: Annotated[float, doc("Lowest frequency of the scan.")] = 0.5,
    stop_hz: Annotated[float, doc("Highest frequency of the scan.")] = 52.0,
    scan_s: Annotated[float, doc("Duration of the scan in s.")] = 5.0,
    rest_s: RestS = 1.0,
    uniformity_percent: Annotated[
        float | None,
        doc(
            "Relative standard deviation of each mode's frequency from that of a uniform beam, "
            "for the fits; None: the value of the profile."
        ),
    ] = None,
    rig: Annotated[
        ScanRig | None,
        doc(
            "Rig whose limits and modes determine the amplitude; None: one amplitude for all "
            "frequencies."
        ),
    ] = None,
) -> PrecisionExcitation:
    """Return the excitation of a session until target standard deviations are reached.

    It begins with a quick scan of all modes. The segments after it are planned during the session:
    each is the most informative excitation.

    Raises
    ------
    ExcitationError
        If an option is out of range, or a target is below the floor that the tolerance of the
        geometry sets.

    Examples
    --------
    >>> from rigd.excitation import until
    >>> session = until(rate_hz=1000, targets="damping 1%", at_most_s=60)
    >>> session.search.planned_ticks, session.reference_rad.size
    (6500, 60000)
    """
    requested_targets = _parse_targets(targets)
    require_positive("at_most_s", at_most_s, "s")
    require_positive("amplitude_rad", amplitude_rad, "rad")
    require_within_turn("amplitude_rad", amplitude_rad)
    require_positive("tip_slope_rad", tip_slope_rad, "rad")
    require_frequency("start_hz", start_hz, rate_hz, zero_allowed=True)
    require_frequency("stop_hz", stop_hz, rate_hz)
    if uniformity_percent is not None and not 0.0 <= uniformity_percent <= _MAX_UNIFORMITY_PERCENT:
        raise ExcitationError(
            f"uniformity_percent = {uniformity_percent:g} % must lie between 0 and "
            f"{_MAX_UNIFORMITY_PERCENT:g} %."
        )
    segment_ticks = lay_out_segments(rate_hz, rest_s, scan_s, 0.0)
    scan_begin, sweep_end = segment_ticks["sweep"]
    if scan_s < 2 * _SCAN_FADE_S:
        raise ExcitationError(
            f"scan_s = {scan_s:g} s is too short for fades of {_SCAN_FADE_S:g} s at both ends; "
            f"choose at least {2 * _SCAN_FADE_S:g} s."
        )
    check_ticks("With at_most_s, the session", at_most_s * rate_hz, rate_hz)
    planned_ticks = sweep_end + round(SEGMENT_PAUSE_S * rate_hz)
    record_ticks = round(at_most_s * rate_hz)
    if record_ticks < planned_ticks:
        raise ExcitationError(
            f"at_most_s = {at_most_s:g} s is too short for rest, scan and pause; choose at least "
            f"{planned_ticks / rate_hz:g} s."
        )
    scan_rad = np.zeros(sweep_end)
    profile_beam = None if rig is None else rig.beam
    scan_rad[scan_begin:] = amplitude_rad * _unit_scan(
        sweep_end - scan_begin, rate_hz, start_hz, stop_hz, profile_beam
    )
    if rig is not None:
        uniformity = rig.uniformity if uniformity_percent is None else uniformity_percent / 100.0
        _require_reachable_targets(rig, requested_targets, uniformity, at_most_s, tip_slope_rad)
        limit_fraction = max(
            rig.fraction_of_limits(scan_rad), rig.tip_slope_rad(scan_rad) / tip_slope_rad
        )
        if limit_fraction > _SCAN_LIMIT_FRACTION:
            amplitude_rad *= _SCAN_LIMIT_FRACTION / limit_fraction
            scan_rad *= _SCAN_LIMIT_FRACTION / limit_fraction
    reference_rad = np.zeros(record_ticks)
    reference_rad[: scan_rad.size] = scan_rad
    reference_rad.flags.writeable = False
    targets_text = ", ".join(map(str, requested_targets))
    return PrecisionExcitation(
        kind="until",
        parameters={
            "targets": targets,
            "at_most_s": at_most_s,
            "tip_slope_rad": tip_slope_rad,
            "amplitude_rad": amplitude_rad,
            "start_hz": start_hz,
            "stop_hz": stop_hz,
            "scan_s": scan_s,
            "rest_s": rest_s,
            **({} if uniformity_percent is None else {"uniformity_percent": uniformity_percent}),
        },
        rate_hz=rate_hz,
        reference_rad=reference_rad,
        # The sweep goes on for as long as it takes.
        segments={
            "rest": (0, scan_begin),
            "scan": (scan_begin, sweep_end),
            "sweep": (scan_begin, record_ticks),
        },
        motion=(
            f"scans {start_hz:g} to {stop_hz:g} Hz in {scan_s:g} s at up to {amplitude_rad:.3g} "
            f"rad, then chooses the most informative excitation until {targets_text} (standard "
            "deviation)"
        ),
        search=PrecisionSearch(
            requested_targets,
            planned_ticks,
            (scan_begin, scan_rad[scan_begin:]),
            tip_slope_rad,
            uniformity_percent,
        ),
    )


def _require_reachable_targets(
    rig: ScanRig,
    targets: tuple[Target, ...],
    uniformity: float,
    at_most_s: float,
    tip_slope_rad: float,
) -> None:
    """Raise `ExcitationError` if a beam of limited uniformity cannot reach a target precision."""
    geometry_limits = geometry_floors(
        rig.stated_estimate, rig, targets, uniformity, at_most_s, tip_slope_rad
    )
    unreachable_floors = [floor for floor in geometry_limits if floor.makes_target_unreachable]
    if not unreachable_floors:
        return
    floors_text = "; ".join(
        f"{floor.target} (standard deviation) is below the floor of "
        f"{with_percentage(floor.std, floor.value)}, "
        f"{with_percentage(floor.exact_geometry_std, floor.value)} if the beam "
        "is exactly uniform"
        for floor in unreachable_floors
    )
    raise ExcitationError(
        f"With modes that differ from those of a uniform beam by {100 * uniformity:g} % "
        f"(uniformity_percent), within {at_most_s:g} s: {floors_text}. Request a larger standard "
        "deviation, or one of the modes (--damping, --frequency), or state --uniformity 0 on a "
        "simulated rig: no real specimen is exactly uniform."
    )


def _unit_scan(
    tick_count: int, rate_hz: float, start_hz: float, stop_hz: float, beam: Beam | None
) -> RealArray:
    """Return a quick sweep of n ticks with largest amplitude 1, at rest at both ends; shape (n,).

    With a beam, the amplitude depends on the frequency relative to the beam's first mode.
    """
    t = np.arange(tick_count) / rate_hz
    u = t * (rate_hz / tick_count)
    frequency_hz = start_hz + (stop_hz - start_hz) * u**_SCAN_FREQUENCY_POWER
    phase_rad = (
        2.0
        * pi
        * t
        * (
            start_hz
            + (stop_hz - start_hz) * u**_SCAN_FREQUENCY_POWER / (_SCAN_FREQUENCY_POWER + 1.0)
        )
    )
    relative_amplitude = np.ones(tick_count)
    if beam is not None:
        first_mode_hz = undamped_frequencies_rad_s(beam, 1)[0] / (2.0 * pi)
        relative_frequency = np.maximum(frequency_hz / first_mode_hz, _SCAN_RELATIVE_FREQUENCIES[0])
        relative_amplitude = np.exp(
            np.interp(
                np.log(relative_frequency),
                np.log(_SCAN_RELATIVE_FREQUENCIES),
                np.log(_SCAN_RELATIVE_AMPLITUDES),
            )
        )
    fade_factors = quintic(_SCAN_FADE_S, rate_hz)
    relative_amplitude[: fade_factors.size] *= fade_factors
    relative_amplitude[tick_count - fade_factors.size :] *= 1.0 - fade_factors
    unit_sweep: RealArray = relative_amplitude * np.sin(phase_rad)
    return unit_sweep


def _parse_targets(targets: str) -> tuple[Target, ...]:
    """Parse targets such as "damping 1%", separated by ";"; raise `ExcitationError` if none."""
    parsed_targets = []
    for target_text in targets.split(";"):
        if target_text.strip():
            quantity_name, _, std_text = target_text.strip().partition(" ")
            parsed_targets.append(parse_target(quantity_name, std_text))
    if not parsed_targets:
        raise ExcitationError(
            f"No precision is requested; give one or more of {', '.join(QUANTITIES)}, such "
            f"as {_EXAMPLE_TARGET}."
        )
    return tuple(parsed_targets)
