"""Proposal of an estimate for the profile, and controllers for the sessions that it needs."""

from dataclasses import dataclass, replace
from math import floor, inf, log10
from typing import Any

from rigd.control import ControlDesignError, check_stability, close_loop
from rigd.identification.estimate import MotorEstimate, MotorQuantity
from rigd.profile import Profile
from rigd.units import unit_of

# Controllers

_CAUTIOUS_POLES_RAD_S = (40.0, 50.0, 63.0)
"""At 40 rad/s the loop is stable for motors from a quarter to four times the inertia that the
profile states, and for command delays up to 2.4 ms. A quicker one minds the delay of a light motor
more; a slower one lets the beam take hold of the motor, and already 40 is too slow for the lightest
ones."""


def cautious(profile: Profile) -> Profile:
    """Return a profile with the slowest controller that holds its beam and tolerates errors.

    Its scales are not compared: they are what the sessions measure.
    """
    profile = replace(profile, limits=replace(profile.limits, torque_ratio=inf))
    for pole_rad_s in _CAUTIOUS_POLES_RAD_S:
        if pole_rad_s < profile.control.pole_rad_s:
            slow = replace(profile, control=replace(profile.control, pole_rad_s=pole_rad_s))
            if _is_stable(slow):
                return slow
    return profile


def tuned(profile: Profile, estimate: MotorEstimate) -> Profile:
    """Return a profile whose controller fits an estimate.

    The commands keep their scale: inertia, friction and feed-forward are divided by it instead.
    Where the loop is not stable with the profile's pole, it gets a cautious one.

    Parameters
    ----------
    profile
        Profile of the rig.
    estimate
        Estimate of its motor.
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
    return fitted if _is_stable(fitted) else cautious(fitted)


def _is_stable(profile: Profile) -> bool:
    try:
        check_stability(close_loop(profile.loop_model()))
    except ControlDesignError:
        return False
    return True


# Proposal

_DIFFERS = 3.0
"""Standard deviations."""
_HIGH_MISFIT = 1.5


@dataclass(frozen=True, slots=True)
class ProposalRow:
    """A number of the profile and its measured value."""

    key: str
    measured: MotorQuantity
    profile_value: float
    source: str
    """Source of the profile's value."""
    least: float = 0.0
    """Smallest value that the profile's other settings allow."""

    @property
    def unit(self) -> str:
        """Unit of all its numbers."""
        return unit_of(self.key)

    @property
    def is_below_least(self) -> bool:
        """Whether the measured value is below its lower bound by more than its scatter."""
        lowest = self.least - _DIFFERS * (self.measured.std or 0.0)
        return self.least > 0.0 and self.measured.value < lowest

    @property
    def differs(self) -> bool | None:
        """Whether measurement and profile are more than three deviations apart."""
        if self.measured.std is None:
            return None
        return abs(self.measured.value - self.profile_value) > _DIFFERS * self.measured.std

    def toml(self) -> str:
        """Return the line to paste; a value below its bound by less than its scatter is raised."""
        std = self.measured.std or 0.0
        value, deviation = _rounded(self.measured.value, std)
        if not self.is_below_least and float(value) < self.least:
            value = f"{self.least:g}"
        name = self.key.rpartition(".")[2]
        return f'{name} = {{ value = {value}, source = "measured" }}  # ± {deviation} {self.unit}'


@dataclass(frozen=True, slots=True)
class Proposal:
    """Comparison of an estimate with the profile that it is to improve."""

    estimate: MotorEstimate
    """Estimate of the motor."""
    rows: tuple[ProposalRow, ...]
    """Comparison of estimate and profile, one row a quantity."""
    notes: tuple[str, ...]
    """Sentences for the operator."""

    def table(self) -> list[str]:
        """Return the comparison as lines of text."""
        heads = ("", "measured", "± std", "profile", "source", "")
        cells = [heads]
        for row in self.rows:
            if row.measured.std is None:
                value, deviation = "not identifiable", ""
            else:
                value, deviation = _rounded(row.measured.value, row.measured.std)
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
        widths = [max(len(line[column]) for line in cells) for column in range(len(heads))]
        lines = ("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in cells)
        return [line.rstrip() for line in lines]

    def toml(self) -> list[str]:
        """Return the lines to paste into the profile, under their sections."""
        lines: list[str] = []
        section = ""
        for row in self.rows:
            if row.measured.std is None:
                continue
            wanted = row.key.rpartition(".")[0]
            if wanted != section:
                section = wanted
                lines += [""] * bool(lines) + [f"[{section}]"]
            lines.append(row.toml())
        return lines

    def as_dict(self) -> dict[str, Any]:
        """Return it as a document of JSON types."""
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
    """Compare an estimate with a profile.

    Parameters
    ----------
    estimate
        Estimate of the profile's motor.
    profile
        Profile in which the numbers are to go.
    unusable
        Passes that were left out before the estimate.
    """
    rig = profile.rig
    motor = rig.motor
    found: list[tuple[str, MotorQuantity, float]] = [
        ("motor.inertia_kg_m2", estimate.inertia_kg_m2, motor.inertia_kg_m2),
        (
            "motor.viscous_nm_s_per_rad",
            estimate.viscous_nm_s_per_rad,
            motor.viscous_nm_s_per_rad,
        ),
        ("motor.coulomb_nm", estimate.coulomb_nm, motor.coulomb_nm),
        (
            "motor.rated_torque_nm",
            _times(motor.rated_torque_nm, estimate.torque_scale),
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
        # The drive's own rated torque is compared with the profile's by it: both change alike.
        unit_nm = rig.cia402.rated_torque_unit_nm
        key = "cia402.rated_torque_unit_nm"
        found.append((key, _times(unit_nm, estimate.torque_scale), unit_nm))
    waits = rig.cia402 is not None and rig.cia402.torque_delivery == "at_sync"
    least = {"actuation.delay_s": 1 / rig.rate_hz} if waits else {}
    rows = tuple(
        ProposalRow(*row, profile.sources.get(row[0], "assumed"), least.get(row[0], 0.0))
        for row in found
    )
    notes = _notes(estimate, profile, unusable)
    if any(row.is_below_least for row in rows if row.key in least):
        notes.append(
            "The torque acts before the next SYNC: this drive takes it on arrival, whatever the "
            'type of its RPDO. Set cia402.torque_delivery = "on_arrival" together with the delay.'
        )
    return Proposal(estimate, rows, tuple(notes))


def _times(factor: float, quantity: MotorQuantity) -> MotorQuantity:
    std = None if quantity.std is None else factor * quantity.std
    return MotorQuantity(factor * quantity.value, std)


def _notes(estimate: MotorEstimate, profile: Profile, unusable: int) -> list[str]:
    scale = estimate.torque_scale
    if scale.std is None:
        notes = [
            "The torque constant is not identifiable: the coupling torque is too small, or follows "
            "the shaft like a rigid inertia (no antenna mounted?). The torque is taken as the "
            "drive states it, and inertia and friction refer to that."
        ]
    else:
        value, deviation = _rounded(scale.value, scale.std)
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
    if estimate.misfit > _HIGH_MISFIT:
        notes.append(
            f"The motor's equation leaves {estimate.misfit:.1f} times what scatter explains (up to "
            f"{estimate.friction_departure_nm:.2g} N·m of the mean torque of a pass): friction is "
            "not only viscous and Coulomb, or a delay of the profile is not true. The deviations "
            "are widened for it."
        )
    left_out = unusable + estimate.dropped
    if left_out:
        notes.append(
            f"{left_out} of {left_out + estimate.windows} passes were left out: {unusable} with "
            f"missed ticks or held readings, {estimate.dropped} in which the shaft may have stood "
            "still."
        )
    return notes


def _rounded(value: float, std: float) -> tuple[str, str]:
    """Format a value and its deviation to two digits of the deviation."""
    if std <= 0.0:
        return f"{value:.6g}", "0"
    exponent = floor(log10(max(abs(value), std)))
    digits = max(0, exponent - floor(log10(std)) + 1)
    if -3 <= exponent < 4:
        decimals = max(0, digits - exponent)
        return f"{value:.{decimals}f}", f"{std:.2g}"
    return f"{value:.{digits}e}", f"{std:.2g}"
