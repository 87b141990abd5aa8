"""Profile values proposed from a motor's estimate, and controllers for its identification."""

from dataclasses import dataclass, replace
from math import floor, inf, log10
from typing import Any

from rigd.control import SHIPPED_CONTROLLER, ControlDesignError, check_stability, close_loop
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


def with_cautious_controller(rig_profile: Profile) -> Profile:
    """Return a profile with the slowest stable PID, which tolerates wrong motor data.

    The check of the torque scale (``limits.torque_ratio``) is off: the sessions measure that scale.
    """
    rig_profile = replace(
        _with_pid(rig_profile), limits=replace(rig_profile.limits, torque_ratio=inf)
    )
    for pole_rad_s in _CAUTIOUS_POLES_RAD_S:
        if pole_rad_s < rig_profile.control.pole_rad_s:
            slow_profile = replace(
                rig_profile, control=replace(rig_profile.control, pole_rad_s=pole_rad_s)
            )
            if _is_stable(slow_profile):
                return slow_profile
    return rig_profile


def with_tuned_controller(profile: Profile, estimate: MotorEstimate) -> Profile:
    """Return a profile whose PID is designed for the estimated motor.

    Inertia, friction and feed-forward are divided by the estimated torque scale, so that commands
    need not be scaled. If the loop is not stable with the profile's pole, the controller is that of
    `with_cautious_controller`.

    Parameters
    ----------
    profile
        Profile of the rig.
    estimate
        Estimate of the rig's motor.
    """
    profile = _with_pid(profile)
    torque_scale = estimate.torque_scale.value
    fitted_motor = replace(
        profile.rig.motor,
        inertia_kg_m2=estimate.inertia_kg_m2.value / torque_scale,
        viscous_nm_s_per_rad=max(0.0, estimate.viscous_nm_s_per_rad.value) / torque_scale,
    )
    control_settings = replace(
        profile.control, feedforward_gain=profile.control.feedforward_gain / torque_scale
    )
    relaxed_limits = replace(profile.limits, torque_ratio=inf)
    fitted_profile = replace(
        profile, design_motor=fitted_motor, control=control_settings, limits=relaxed_limits
    )
    return (
        fitted_profile if _is_stable(fitted_profile) else with_cautious_controller(fitted_profile)
    )


def _with_pid(profile: Profile) -> Profile:
    """Return a profile with rigd's PID, as a package's controller may require a known motor."""
    control_settings = replace(profile.control, controller=SHIPPED_CONTROLLER)
    return replace(profile, control=control_settings, controller_settings=None)


def _is_stable(profile: Profile) -> bool:
    """Return whether the closed loop of a profile is stable."""
    try:
        check_stability(close_loop(profile.loop_model()))
    except ControlDesignError:
        return False
    return True


# Proposal

_SIGNIFICANT_STDS = 3.0
"""Smallest significant deviation of an estimate from a value, in standard deviations."""
_MAX_UNREMARKED_MISFIT = 1.5
"""Largest misfit of an estimate that is not mentioned to the operator."""


@dataclass(frozen=True, slots=True)
class ProposalRow:
    """Comparison of a number of the profile with its estimate."""

    profile_key: str
    """Dotted key of the number in the profile."""
    measured_quantity: MotorQuantity
    """Estimate of the number."""
    profile_value: float
    """Value of the number in the profile."""
    value_source: str
    """Origin of the profile's value, as the profile states it."""
    min_allowed: float = 0.0
    """Smallest value that the profile's other settings allow."""

    @property
    def unit(self) -> str:
        """Unit of the compared numbers."""
        return unit_of(self.profile_key)

    @property
    def is_below_min_allowed(self) -> bool:
        """Whether the estimate is significantly below the smallest allowed value."""
        min_plausible_value = self.min_allowed - _SIGNIFICANT_STDS * (
            self.measured_quantity.std or 0.0
        )
        return self.min_allowed > 0.0 and self.measured_quantity.value < min_plausible_value

    @property
    def differs(self) -> bool | None:
        """Whether estimate and profile differ by more than three standard deviations.

        It is None if the quantity was not estimated.
        """
        if self.measured_quantity.std is None:
            return None
        return (
            abs(self.measured_quantity.value - self.profile_value)
            > _SIGNIFICANT_STDS * self.measured_quantity.std
        )

    def toml(self) -> str:
        """Return a line of TOML that enters the estimate in the profile.

        The smallest allowed value replaces an estimate that is insignificantly below it.
        """
        std = self.measured_quantity.std or 0.0
        value_text, std_text = _format_with_std(self.measured_quantity.value, std)
        if not self.is_below_min_allowed and float(value_text) < self.min_allowed:
            value_text = f"{self.min_allowed:g}"
        key_name = self.profile_key.rpartition(".")[2]
        return (
            f'{key_name} = {{ value = {value_text}, source = "measured" }}  # ± {std_text} '
            f"{self.unit}"
        )


@dataclass(frozen=True, slots=True)
class Proposal:
    """Values for a profile that follow from an estimate of its motor."""

    estimate: MotorEstimate
    """Estimate of the motor."""
    rows: tuple[ProposalRow, ...]
    """Comparison of estimate and profile, a row for each number."""
    notes: tuple[str, ...]
    """Sentences for the operator on the estimate."""

    def table(self) -> list[str]:
        """Return the lines of a table that compares estimate and profile."""
        column_titles = ("", "measured", "± std", "profile", "source", "")
        table_cells = [column_titles]
        for row in self.rows:
            if row.measured_quantity.std is None:
                value_text, std_text = "not identifiable", ""
            else:
                value_text, std_text = _format_with_std(
                    row.measured_quantity.value, row.measured_quantity.std
                )
            verdict_text = {True: "DIFFERS", False: "agrees", None: ""}[row.differs]
            table_cells.append(
                (
                    row.profile_key,
                    f"{value_text} {row.unit}" if std_text else value_text,
                    std_text,
                    f"{row.profile_value:g}",
                    row.value_source,
                    verdict_text,
                )
            )
        column_widths = [
            max(len(cell_row[column_index]) for cell_row in table_cells)
            for column_index in range(len(column_titles))
        ]
        table_lines = (
            "  ".join(c.ljust(w) for c, w in zip(cell_row, column_widths, strict=True))
            for cell_row in table_cells
        )
        return [cell_row.rstrip() for cell_row in table_lines]

    def toml(self) -> list[str]:
        """Return lines of TOML that enter the estimates in the profile, section by section."""
        toml_lines: list[str] = []
        current_section = ""
        for row in self.rows:
            if row.measured_quantity.std is None:
                continue
            row_section = row.profile_key.rpartition(".")[0]
            if row_section != current_section:
                current_section = row_section
                toml_lines += [""] * bool(toml_lines) + [f"[{current_section}]"]
            toml_lines.append(row.toml())
        return toml_lines

    def as_dict(self) -> dict[str, Any]:
        """Return the proposal as a JSON document."""
        torque_scale = self.estimate.torque_scale
        return {
            "parameters": {
                row.profile_key: {
                    "value": row.measured_quantity.value,
                    "std": row.measured_quantity.std,
                    "unit": row.unit,
                    "profile": row.profile_value,
                    "source": row.value_source,
                    "differs": row.differs,
                }
                for row in self.rows
            },
            "torque_scale": {"value": torque_scale.value, "std": torque_scale.std},
            "passes": self.estimate.window_count,
            "dropped": self.estimate.dropped_window_count,
            "misfit": self.estimate.misfit,
            "friction_departure_nm": self.estimate.friction_departure_nm,
            "notes": list(self.notes),
            "toml": "\n".join(self.toml()),
        }


def propose(estimate: MotorEstimate, profile: Profile, *, unusable_count: int = 0) -> Proposal:
    """Compare a motor's estimate with the profile, and propose new values.

    Parameters
    ----------
    estimate
        Estimate of the profile's motor.
    profile
        Profile for which values are proposed.
    unusable_count
        Number of passes with missing, old or clipped readings, which were not used.
    """
    rig = profile.rig
    rig_motor = rig.motor
    compared_numbers: list[tuple[str, MotorQuantity, float]] = [
        ("motor.inertia_kg_m2", estimate.inertia_kg_m2, rig_motor.inertia_kg_m2),
        (
            "motor.viscous_nm_s_per_rad",
            estimate.viscous_nm_s_per_rad,
            rig_motor.viscous_nm_s_per_rad,
        ),
        ("motor.coulomb_nm", estimate.coulomb_nm, rig_motor.coulomb_nm),
        (
            "motor.rated_torque_nm",
            _scaled_quantity(rig_motor.rated_torque_nm, estimate.torque_scale),
            rig_motor.rated_torque_nm,
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
        torque_key = "cia402.rated_torque_unit_nm"
        compared_numbers.append(
            (torque_key, _scaled_quantity(unit_nm, estimate.torque_scale), unit_nm)
        )
    is_torque_at_sync = rig.cia402 is not None and rig.cia402.torque_delivery == "at_sync"
    smallest_values = {"actuation.delay_s": 1 / rig.rate_hz} if is_torque_at_sync else {}
    proposal_rows = tuple(
        ProposalRow(
            *compared_number,
            profile.sources.get(compared_number[0], "assumed"),
            smallest_values.get(compared_number[0], 0.0),
        )
        for compared_number in compared_numbers
    )
    operator_notes = _operator_notes(estimate, profile, unusable_count)
    if any(row.is_below_min_allowed for row in proposal_rows if row.profile_key in smallest_values):
        operator_notes.append(
            "The torque acts before the next SYNC: this drive takes it on arrival, whatever the "
            'type of its RPDO. Set cia402.torque_delivery = "on_arrival" together with the delay.'
        )
    return Proposal(estimate, proposal_rows, tuple(operator_notes))


def _scaled_quantity(scale_factor: float, quantity: MotorQuantity) -> MotorQuantity:
    """Return a quantity whose value and standard deviation are multiplied by a factor."""
    std = None if quantity.std is None else scale_factor * quantity.std
    return MotorQuantity(scale_factor * quantity.value, std)


def _operator_notes(estimate: MotorEstimate, profile: Profile, unusable_count: int) -> list[str]:
    """Return the sentences for the operator on assumptions and defects of the estimate."""
    torque_scale = estimate.torque_scale
    if torque_scale.std is None:
        operator_notes = [
            "The torque constant is not identifiable: the coupling torque is too small, or follows "
            "the shaft like a rigid inertia (no antenna mounted?). The torque is assumed to be as "
            "the drive states it, and inertia and friction refer to that."
        ]
    else:
        value_text, std_text = _format_with_std(torque_scale.value, torque_scale.std)
        operator_notes = [
            f"The motor exerts {value_text} ± {std_text} times the torque commanded, according to "
            "the sensor; motor.rated_torque_nm is corrected by that. Inertia and friction refer to "
            "the sensor's N·m: paste all lines together."
        ]
    operator_notes.append(
        "Only the sum of delays from command to angle is known: actuation.delay_s is this sum "
        f"minus encoder.delay_s = {profile.rig.encoder.delay_s:g} s, and sensor.delay_s = "
        f"{profile.rig.sensor.delay_s:g} s is assumed correct."
    )
    operator_notes.append(
        "control.friction_compensation_nm switches the friction feed-forward on; 0 leaves it off."
    )
    if estimate.misfit > _MAX_UNREMARKED_MISFIT:
        operator_notes.append(
            f"The residual of the motor's equation is {estimate.misfit:.1f} times what scatter "
            f"explains (up to {estimate.friction_departure_nm:.2g} N·m of the mean torque of a "
            "pass): friction is not only viscous and Coulomb, or a delay of the profile is "
            "wrong. The standard deviations include this."
        )
    omitted_count = unusable_count + estimate.dropped_window_count
    if omitted_count:
        operator_notes.append(
            f"{omitted_count} of {omitted_count + estimate.window_count} passes were left out: "
            f"{unusable_count} with missed ticks or held readings, {estimate.dropped_window_count} "
            "in which the shaft may have stood still."
        )
    return operator_notes


def _format_with_std(estimate_value: float, std: float) -> tuple[str, str]:
    """Format a value and its standard deviation, which is rounded to two significant digits."""
    if std <= 0.0:
        return f"{estimate_value:.6g}", "0"
    exponent = floor(log10(max(abs(estimate_value), std)))
    significant_digits = max(0, exponent - floor(log10(std)) + 1)
    if -3 <= exponent < 4:
        decimals = max(0, significant_digits - exponent)
        return f"{estimate_value:.{decimals}f}", f"{std:.2g}"
    return f"{estimate_value:.{significant_digits}e}", f"{std:.2g}"
