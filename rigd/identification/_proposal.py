"""Proposed profile values from a motor's estimate, and controllers for the identification."""

from dataclasses import dataclass, replace
from math import floor, inf, log10
from typing import Any

from rigd.control import ControlDesignError, check_stability, close_loop
from rigd.identification.estimate import MotorEstimate, MotorQuantity
from rigd.profile import Profile
from rigd.units import unit_of

# Controllers

_CAUTIOUS_POLES_RAD_S = (40.0, 50.0, 63.0)
"""Controller poles in rad/s for a motor with uncertain data, the slowest first.

At 40 rad/s the loop is stable for motors from a quarter to four times the inertia that the profile
states, and for command delays up to 2.4 ms. A faster controller is more sensitive to the delay of a
light motor. With a slower one the beam would move the motor; even 40 rad/s is too slow for the
lightest motors."""


def with_cautious_controller(profile: Profile) -> Profile:
    """Return a profile with the slowest stable controller, which tolerates wrong motor data.

    The check of the scales (``limits.torque_ratio``) is off, since the sessions measure them.
    """
    profile = replace(profile, limits=replace(profile.limits, torque_ratio=inf))
    for pole_rad_s in _CAUTIOUS_POLES_RAD_S:
        if pole_rad_s < profile.control.pole_rad_s:
            slow_profile = replace(profile, control=replace(profile.control, pole_rad_s=pole_rad_s))
            if _is_stable(slow_profile):
                return slow_profile
    return profile


def with_tuned_controller(profile: Profile, estimate: MotorEstimate) -> Profile:
    """Return a profile whose controller is designed for the estimated motor.

    The scale of the commands is unchanged: inertia, friction and feed-forward are divided by the
    torque scale instead. If the loop is not stable with the profile's pole, the controller is that
    of `with_cautious_controller`.

    Parameters
    ----------
    profile
        Profile of the rig.
    estimate
        Estimate of the rig's motor.
    """
    scale = estimate.torque_scale.value
    motor = replace(
        profile.rig.motor,
        inertia_kg_m2=estimate.inertia_kg_m2.value / scale,
        viscous_nm_s_per_rad=max(0.0, estimate.viscous_nm_s_per_rad.value) / scale,
    )
    control = replace(profile.control, feedforward_gain=profile.control.feedforward_gain / scale)
    limits = replace(profile.limits, torque_ratio=inf)
    fitted = replace(profile, design_motor=motor, control=control, limits=limits)
    return fitted if _is_stable(fitted) else with_cautious_controller(fitted)


def _is_stable(profile: Profile) -> bool:
    """Return whether the closed loop of a profile is stable."""
    try:
        check_stability(close_loop(profile.loop_model()))
    except ControlDesignError:
        return False
    return True


# Proposal

_SIGNIFICANT_STDS = 3.0
"""Standard deviations by which an estimate must deviate from a profile's value to differ."""
_MAX_UNREMARKED_MISFIT = 1.5
"""Misfit of an estimate above which there is a note for the operator."""


@dataclass(frozen=True, slots=True)
class ProposalRow:
    """Comparison of a number of the profile with its estimate."""

    key: str
    """Dotted key of the number in the profile."""
    measured: MotorQuantity
    """Estimate of the number."""
    profile_value: float
    """Value of the number in the profile."""
    source: str
    """Source of the profile's value."""
    least: float = 0.0
    """Smallest value that the profile's other settings allow."""

    @property
    def unit(self) -> str:
        """Unit of the compared numbers."""
        return unit_of(self.key)

    @property
    def is_below_least(self) -> bool:
        """Whether the estimate is significantly below the smallest allowed value."""
        lowest = self.least - _SIGNIFICANT_STDS * (self.measured.std or 0.0)
        return self.least > 0.0 and self.measured.value < lowest

    @property
    def differs(self) -> bool | None:
        """Whether estimate and profile differ by more than three standard deviations.

        It is None if the quantity was not estimated.
        """
        if self.measured.std is None:
            return None
        return abs(self.measured.value - self.profile_value) > _SIGNIFICANT_STDS * self.measured.std

    def toml(self) -> str:
        """Return the line with the estimate for the profile.

        An estimate insignificantly below the smallest allowed value is replaced by that value.
        """
        std = self.measured.std or 0.0
        value, deviation = _format_with_std(self.measured.value, std)
        if not self.is_below_least and float(value) < self.least:
            value = f"{self.least:g}"
        name = self.key.rpartition(".")[2]
        return f'{name} = {{ value = {value}, source = "measured" }}  # ± {deviation} {self.unit}'


@dataclass(frozen=True, slots=True)
class Proposal:
    """Proposed values for a profile from an estimate of its motor."""

    estimate: MotorEstimate
    """Estimate of the motor."""
    rows: tuple[ProposalRow, ...]
    """Comparison of estimate and profile, a row for each number."""
    notes: tuple[str, ...]
    """Sentences for the operator on the estimate."""

    def table(self) -> list[str]:
        """Return the lines of a table that compares estimate and profile."""
        titles = ("", "measured", "± std", "profile", "source", "")
        cells = [titles]
        for row in self.rows:
            if row.measured.std is None:
                value, deviation = "not identifiable", ""
            else:
                value, deviation = _format_with_std(row.measured.value, row.measured.std)
            verdict = {True: "DIFFERS", False: "agrees", None: ""}[row.differs]
            cells.append(
                (
                    row.key,
                    f"{value} {row.unit}" if deviation else value,
                    deviation,
                    f"{row.profile_value:g}",
                    row.source,
                    verdict,
                )
            )
        widths = [max(len(line[column]) for line in cells) for column in range(len(titles))]
        lines = ("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in cells)
        return [line.rstrip() for line in lines]

    def toml(self) -> list[str]:
        """Return the lines with the estimates for the profile, under their sections."""
        lines: list[str] = []
        section = ""
        for row in self.rows:
            if row.measured.std is None:
                continue
            row_section = row.key.rpartition(".")[0]
            if row_section != section:
                section = row_section
                lines += [""] * bool(lines) + [f"[{section}]"]
            lines.append(row.toml())
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Return the proposal as a JSON document."""
        scale = self.estimate.torque_scale
        return {
            "parameters": {
                row.key: {
                    "value": row.measured.value,
                    "std": row.measured.std,
                    "unit": row.unit,
                    "profile": row.profile_value,
                    "source": row.source,
                    "differs": row.differs,
                }
                for row in self.rows
            },
            "torque_scale": {"value": scale.value, "std": scale.std},
            "passes": self.estimate.windows,
            "dropped": self.estimate.dropped,
            "misfit": self.estimate.misfit,
            "friction_departure_nm": self.estimate.friction_departure_nm,
            "notes": list(self.notes),
            "toml": "\n".join(self.toml()),
        }


def propose(estimate: MotorEstimate, profile: Profile, *, unusable: int = 0) -> Proposal:
    """Compare a motor's estimate with the profile, and propose new values.

    Parameters
    ----------
    estimate
        Estimate of the profile's motor.
    profile
        Profile for which values are proposed.
    unusable
        Number of passes that were omitted before the estimate.
    """
    rig = profile.rig
    motor = rig.motor
    compared: list[tuple[str, MotorQuantity, float]] = [
        ("motor.inertia_kg_m2", estimate.inertia_kg_m2, motor.inertia_kg_m2),
        (
            "motor.viscous_nm_s_per_rad",
            estimate.viscous_nm_s_per_rad,
            motor.viscous_nm_s_per_rad,
        ),
        ("motor.coulomb_nm", estimate.coulomb_nm, motor.coulomb_nm),
        (
            "motor.rated_torque_nm",
            _scaled(motor.rated_torque_nm, estimate.torque_scale),
            motor.rated_torque_nm,
        ),
        ("actuation.delay_s", estimate.actuation_delay_s, rig.actuation.delay_s),
        (
            "control.friction_compensation_nm",
            estimate.coulomb_nm,
            profile.control.friction_compensation_nm,
        ),
    ]
    if rig.cia402 is not None and rig.cia402.rated_torque_unit_nm > 0.0:
        # It converts the drive's own rated torque for the comparison: both change by one factor.
        unit_nm = rig.cia402.rated_torque_unit_nm
        key = "cia402.rated_torque_unit_nm"
        compared.append((key, _scaled(unit_nm, estimate.torque_scale), unit_nm))
    torque_at_sync = rig.cia402 is not None and rig.cia402.torque_delivery == "at_sync"
    smallest_values = {"actuation.delay_s": 1 / rig.rate_hz} if torque_at_sync else {}
    rows = tuple(
        ProposalRow(*row, profile.sources.get(row[0], "assumed"), smallest_values.get(row[0], 0.0))
        for row in compared
    )
    notes = _notes(estimate, profile, unusable)
    if any(row.is_below_least for row in rows if row.key in smallest_values):
        notes.append(
            "The torque acts before the next SYNC: this drive takes it on arrival, whatever the "
            'type of its RPDO. Set cia402.torque_delivery = "on_arrival" together with the delay.'
        )
    return Proposal(estimate, rows, tuple(notes))


def _scaled(factor: float, quantity: MotorQuantity) -> MotorQuantity:
    """Return a quantity and its standard deviation, multiplied by a factor."""
    std = None if quantity.std is None else factor * quantity.std
    return MotorQuantity(factor * quantity.value, std)


def _notes(estimate: MotorEstimate, profile: Profile, unusable: int) -> list[str]:
    """Return the sentences for the operator on what the estimate does not determine."""
    scale = estimate.torque_scale
    if scale.std is None:
        notes = [
            "The torque constant is not identifiable: the coupling torque is too small, or follows "
            "the shaft like a rigid inertia (no antenna mounted?). The torque is taken as the "
            "drive states it, and inertia and friction refer to that."
        ]
    else:
        value, deviation = _format_with_std(scale.value, scale.std)
        notes = [
            f"The motor exerts {value} ± {deviation} times the torque commanded, against the "
            "sensor; motor.rated_torque_nm is corrected by that. Inertia and friction refer to the "
            "sensor's N·m: paste all lines together."
        ]
    notes.append(
        "Only the sum of delays from command to angle is known: actuation.delay_s is this sum "
        f"minus encoder.delay_s = {profile.rig.encoder.delay_s:g} s, and sensor.delay_s = "
        f"{profile.rig.sensor.delay_s:g} s is assumed correct."
    )
    notes.append(
        "control.friction_compensation_nm switches the friction feed-forward on; 0 leaves it off."
    )
    if estimate.misfit > _MAX_UNREMARKED_MISFIT:
        notes.append(
            f"The motor's equation leaves {estimate.misfit:.1f} times what scatter explains (up to "
            f"{estimate.friction_departure_nm:.2g} N·m of the mean torque of a pass): friction is "
            "not only viscous and Coulomb, or a delay of the profile is not true. The deviations "
            "are widened for it."
        )
    omitted = unusable + estimate.dropped
    if omitted:
        notes.append(
            f"{omitted} of {omitted + estimate.windows} passes were left out: {unusable} with "
            f"missed ticks or held readings, {estimate.dropped} in which the shaft may have stood "
            "still."
        )
    return notes


def _format_with_std(value: float, std: float) -> tuple[str, str]:
    """Format a value and its standard deviation, to two significant digits of the latter."""
    if std <= 0.0:
        return f"{value:.6g}", "0"
    exponent = floor(log10(max(abs(value), std)))
    digits = max(0, exponent - floor(log10(std)) + 1)
    if -3 <= exponent < 4:
        decimals = max(0, digits - exponent)
        return f"{value:.{decimals}f}", f"{std:.2g}"
    return f"{value:.{digits}e}", f"{std:.2g}"
