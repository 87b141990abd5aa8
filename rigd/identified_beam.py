"""Identified beam of an analysis, read from the document of ``analyze --json``.

Every parameter and every finding of the document is either taken into account or refused by name;
none is ignored.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, inf, pi
from pathlib import Path
from typing import Any, Final

from rigd.beam import Beam, Damping, LoadedBeam, clamped_free_eigenvalues, participation
from rigd.documents import DocumentError, read_json
from rigd.errors import UserError
from rigd.units import finite_number, is_usable_size

_NEEDED: Final = ("density_over_stiffness", "bending_stiffness_n_m2")
_TWO_SIDED_95: Final = 1.959964
_REMEDY: Final = "write it with analyze session.mcap --json model.json"


@dataclass(frozen=True, slots=True)
class _Parameter:
    """Unit and range of a parameter of the document."""

    unit: str = ""
    least: float = 0.0
    below: float = inf
    words: str = ""
    """Description of an effect beyond a uniform beam with ideal channels; else empty."""
    remedy: str = ""
    """How to obtain a document without the effect."""


_OFFSET: Final = "stiffness_offset_"
_AT_ENDS: Final = ("tip_mass_kg", "root_compliance_rad_per_nm")
_STATE_FILTER: Final = (
    "state it in the profile (sensor.filter_hz = {corner_hz:.4g}, sensor.filter_order = {order}), "
    "record again and analyze that session"
)
_PARAMETERS: Final[Mapping[str, _Parameter]] = {
    "zeta": _Parameter("s^alpha", below=1.0),
    "alpha": _Parameter(below=2.0),
    "gamma": _Parameter("s^lambda/m⁴"),
    "lambda": _Parameter(below=2.0),
    "density_over_stiffness": _Parameter("s²/m⁴"),
    "bending_stiffness_n_m2": _Parameter("N·m²"),
    "tool_inertia_kg_m2": _Parameter("kg·m²"),
    "delay_s": _Parameter("s", least=-inf),
    "tip_mass_kg": _Parameter(
        "kg", words="a mass at the tip", remedy="take it off, and record and analyze again"
    ),
    "root_compliance_rad_per_nm": _Parameter(
        "rad/(N·m)",
        words="an elastic clamp",
        remedy="tighten or stiffen the clamp, and record and analyze again",
    ),
    _OFFSET: _Parameter(
        least=-0.9,
        below=10.0,
        words="a mode whose stiffness is not that of a uniform beam",
        remedy="look for an added mass or a section that varies, and record and analyze again",
    ),
    "filter_time_constant_s": _Parameter(
        "s", words="a low-pass filter of the torque", remedy=_STATE_FILTER
    ),
    "second_order_filter_time_constant_s": _Parameter(
        "s", words="a low-pass filter of the torque", remedy=_STATE_FILTER
    ),
    "clock_rate_difference": _Parameter(
        least=-1.0,
        below=1.0,
        words="clocks of different rates",
        remedy="sample angle and torque by one clock, and record and analyze again",
    ),
    "drag": _Parameter(
        "m",
        words="drag of the air",
        remedy="leave --model out, and expect more vibration than stated",
    ),
}
"""All parameters of documents of this version or an older one. Offsets of modes, the compliance of
the clamp and the difference of clocks are no longer estimated. A document with an unknown parameter
is refused, because its effect is unknown."""

_WITHOUT_EFFECT: Final = frozenset(
    {"hum", "sensor drift", "ringing start", "knock", "clipping", "stop"}
)
"""Findings on one record, which the estimates take into account; doubtful numbers are flagged."""

_IN_PARAMETERS: Final = frozenset(
    {
        *("delay", "tool inertia", "beam data", "air drag", "rival explanations"),
        # From analyses with model variants other than the uniform beam:
        *("not uniform", "elastic clamp", "tip mass", "torque filter"),
    }
)
"""Findings whose magnitude is among the parameters."""


class IdentifiedBeamError(UserError, ValueError):
    """A document has no usable beam; the message names file, key and remedy."""


@dataclass(frozen=True, slots=True)
class Use:
    """Purpose of an identified beam: effects taken into account and required parameters."""

    name: str
    """Name in messages, such as "a move"."""
    effects: frozenset[str]
    """Additional parameters that are taken into account."""
    certain: frozenset[str]
    """Parameters that must not be flagged, unless their standard deviation covers the doubt."""
    modes: bool = False
    """Whether observed modes can replace those of a uniform beam, with one stiffness per mode."""


MOVE: Final = Use(
    "a move",
    frozenset({"tip_mass_kg", "root_compliance_rad_per_nm", _OFFSET}),
    frozenset({*_NEEDED, "tip_mass_kg", "root_compliance_rad_per_nm", _OFFSET}),
    modes=True,
)
"""A vibration-free move depends on the modes and hardly on the composition of their damping."""

TOUCH: Final = Use(
    "a search for touches",
    frozenset(),
    frozenset(_NEEDED),
)
"""A touch is located by the exact model of a uniform beam with a free tip on a rigid clamp."""


@dataclass(frozen=True, slots=True)
class IdentifiedBeam:
    """Parameters of the exact model from an analysis."""

    beam: Beam
    """Beam with the given length and the identified stiffness and density."""
    damping: Damping
    """Identified damping; a coefficient of 0 means that the structure has no such damping."""
    tool_inertia_kg_m2: float | None
    """Inertia between sensor and beam; None: not identified."""
    delay_s: float | None
    """Delay of the torque less that of the angle; None: not identified."""
    std: Mapping[str, float]
    """Known standard deviations by parameter name in the document."""
    tip_mass_kg: float = 0.0
    """Point mass at the tip."""
    root_compliance_rad_per_nm: float = 0.0
    """Rotational compliance of the clamp."""
    stiffness_offsets: tuple[float, ...] = ()
    """Relative differences of the stiffness of modes 2, 3, … from the uniform beam's."""
    mode_uncertainty: tuple[float, ...] = ()
    """Relative standard uncertainty of the pole of each mode in the document."""

    @property
    def loaded_beam(self) -> LoadedBeam:
        """Beam with its damping and end conditions."""
        return LoadedBeam(
            self.beam,
            self.damping,
            self.tip_mass_kg,
            self.root_compliance_rad_per_nm,
            self.stiffness_offsets,
        )

    def pole_uncertainty(self, modes: int) -> tuple[float, ...]:
        """Return the relative standard uncertainty of the poles of some modes.

        Parameters
        ----------
        modes
            Number of modes, from the first. A mode that is not in the document gets the largest
            uncertainty of those in it.
        """
        of_beam = 0.5 * self.std.get(_NEEDED[0], 0.0) / self.beam.density_over_stiffness
        further = max(self.mode_uncertainty, default=of_beam)
        return (*self.mode_uncertainty, *(further,) * modes)[:modes]


def read_identified_beam(path: str | Path, length_m: float, use: Use) -> IdentifiedBeam:
    """Return the beam of the headline of an analysis; for a campaign, the pooled one.

    If a uniform beam predicts the modes, the parameters are those of an exactly uniform beam, which
    predict the record best. Otherwise no uniform beam describes the rig, and the modes themselves
    are used if the purpose permits it.

    Parameters
    ----------
    path
        Document of ``analyze session.mcap --json``: ``headlines[].parameters``, ``modes``,
        ``exact_geometry``, ``validity.uniform_beam`` and ``named``.
    length_m
        Length of the beam, which is not observable in a session.
    use
        Purpose of the beam: `MOVE` or `TOUCH`.

    Raises
    ------
    IdentifiedBeamError
        If the file cannot be read or lacks parameters, if it has an effect or a finding that this
        use does not take into account, or if a required number is flagged.
    """
    path = Path(path)
    where, headline, refused = _headline(path)
    if refused and not use.modes:
        raise IdentifiedBeamError(
            f"{where}.validity.uniform_beam: {refused}, and {use.name} relies on a uniform beam; "
            "remove what makes it differ (a mass, a soft clamp, an axis that is not plumb), and "
            "record and analyze again, or leave out --model."
        )
    _refuse_findings(where, headline.get("named"), use)
    source = headline
    if not refused and isinstance(exact := headline.get("exact_geometry"), dict):
        where, source = f"{where}.exact_geometry", exact
    parameters = source.get("parameters")
    if not isinstance(parameters, dict):
        raise IdentifiedBeamError(f"{where}.parameters is missing; {_REMEDY}.")
    values = parameter_values(where, parameters)
    if refused:
        # Effective values of a uniform beam do not describe the rig: the modes replace them.
        values = {n: v for n, v in values.items() if _of(n) not in (_OFFSET, *_AT_ENDS)}
    _refuse_effects(where, values, use)
    std = {}
    for name in values:
        deviation = (
            _deviation(parameters[name])
            if refused
            else _deviation_for(where, name, parameters[name], use)
        )
        if deviation is not None:
            std[name] = deviation
    density_over_stiffness, stiffness = (values[name] for name in _NEEDED)
    found = IdentifiedBeam(
        beam=Beam(length_m, density_over_stiffness * stiffness, stiffness),
        damping=Damping(
            zeta=values.get("zeta", 0.0),
            alpha=values.get("alpha", 1.0),
            gamma=values.get("gamma", 0.0),
            lambda_=values.get("lambda", 1.0),
        ),
        tool_inertia_kg_m2=values.get("tool_inertia_kg_m2"),
        delay_s=values.get("delay_s"),
        std=std,
        tip_mass_kg=values.get("tip_mass_kg", 0.0),
        root_compliance_rad_per_nm=values.get("root_compliance_rad_per_nm", 0.0),
        stiffness_offsets=_offsets(where, values),
        mode_uncertainty=_mode_uncertainty(where, source.get("modes")),
    )
    return _with_modes(where, found, headline.get("modes"), refused) if refused else found


def _with_modes(where: str, found: IdentifiedBeam, modes: object, refused: str) -> IdentifiedBeam:
    """Return a beam with observed mode frequencies and participation of the first mode."""
    shown: list[tuple[float, float, float | None]] = []
    for entry in modes if isinstance(modes, list) else []:
        if not isinstance(entry, dict) or not entry.get("shown", True):
            break
        quantities = [entry.get(key) for key in ("frequency_hz", "damping_ratio", "participation")]
        hz, ratio, inertia = (
            finite_number(each.get("value")) if isinstance(each, dict) else None
            for each in quantities
        )
        flags = [each.get("flag") for each in quantities if isinstance(each, dict)]
        if not hz or not ratio or hz < 0 or any(flags):
            break
        shown.append((hz, ratio, inertia))
    if not shown:
        raise IdentifiedBeamError(
            f"{where}.modes: {refused}, and no mode is shown without a flag that could take its "
            "place; record a session that shows more modes and analyze it, or leave out --model."
        )
    try:
        like = found.loaded_beam.with_frequencies([hz for hz, _, _ in shown])
    except ValueError as error:
        raise IdentifiedBeamError(f"{where}.parameters: {error} Leave out --model.") from None
    beam, inertia = like.beam, shown[0][2]
    if inertia and inertia > 0:
        size = inertia / (beam.density_kg_per_m * float(participation(beam, 1)[0]))
        beam = replace(
            beam,
            density_kg_per_m=size * beam.density_kg_per_m,
            bending_stiffness_n_m2=size * beam.bending_stiffness_n_m2,
        )
    found = replace(found, beam=beam, stiffness_offsets=like.stiffness_offsets)
    poles = found.loaded_beam.poles(clamped_free_eigenvalues(len(shown)))[:, 0]
    # The difference between the damping of the beam and of the modes counts as uncertainty.
    uncertainty = (
        hypot(own, abs(ratio + pole.real / abs(pole)))
        for own, (_, ratio, _), pole in zip(found.mode_uncertainty, shown, poles, strict=False)
    )
    return replace(found, mode_uncertainty=tuple(uncertainty))


def _headline(path: Path) -> tuple[str, Mapping[str, Any], str]:
    """Return a headline after its name in messages, and why it excludes a uniform beam."""
    document: Any = read_document(path)
    where, headline = select_headline(path, document)
    # One record of a campaign that excludes it is enough.
    pooled = headline.get("file", "") is None
    counting = filter(_is_object, document["headlines"]) if pooled else [headline]
    return where, headline, next(filter(None, map(_refusal, counting)), "")


def _is_object(entry: object) -> bool:
    """Return whether a value of a document is an object."""
    return isinstance(entry, dict)


def read_document(path: Path) -> object:
    """Read a document of ``analyze --json``.

    Parameters
    ----------
    path

    Raises
    ------
    IdentifiedBeamError
        If the file cannot be read, or is not JSON.
    """
    try:
        return read_json(path)
    except DocumentError as error:
        raise IdentifiedBeamError(f"{path}: {error}; {_REMEDY}.") from error


def select_headline(path: Path, document: object) -> tuple[str, Mapping[str, Any]]:
    """Return the name in messages and the first headline of a document, pooled for a campaign.

    Parameters
    ----------
    path
        File of the document, for messages.
    document
        As `read_document` returns it.

    Raises
    ------
    IdentifiedBeamError
        If there is none.
    """
    headlines = document.get("headlines") if isinstance(document, dict) else None
    if not isinstance(headlines, list):
        headlines = []
    found = [(k, each) for k, each in enumerate(headlines) if isinstance(each, dict)]
    pooled = [(k, each) for k, each in found if each.get("file", "") is None]
    index, headline = next(iter(pooled + found), (0, {}))
    if not isinstance(headline.get("parameters"), dict):
        raise IdentifiedBeamError(f"{path}: has no headlines[0].parameters; {_REMEDY}.")
    return f"{path}: headlines[{index}]", headline


def _refusal(headline: Mapping[str, Any]) -> str:
    """Return why a uniform beam does not predict the modes of a record; empty if it may."""
    validity = headline.get("validity")
    test = validity.get("uniform_beam") if isinstance(validity, dict) else None
    if not isinstance(test, dict) or test.get("status") != "refused":
        return ""
    p_value = finite_number(test.get("p_value"))
    p = "" if p_value is None else f" (p = {p_value:.1g})"
    return f"a uniform beam does not predict the modes that the record shows{p}"


def parameter_values(where: str, parameters: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of a headline's parameters, each within its range.

    Parameters
    ----------
    where
        Name of the headline in messages.
    parameters
        ``parameters`` of the headline.

    Raises
    ------
    IdentifiedBeamError
        If a parameter is unknown or out of range, or a required parameter is missing.
    """
    values = {name: _value(where, name, entry) for name, entry in parameters.items()}
    for name in _NEEDED:
        if name not in values:
            raise IdentifiedBeamError(
                f"{where}.parameters.{name} is missing; take the document of an analysis that "
                "found it (analyze session.mcap --json model.json)."
            )
    return values


def findings_without_parameter(named: object) -> list[tuple[int, str, str]]:
    """Return index, kind and sentence of the findings whose effect no parameter describes.

    Findings on one record only, which do not concern the antenna, are omitted.

    Parameters
    ----------
    named
        ``named`` of a headline.
    """
    found = []
    for number, entry in enumerate(named if isinstance(named, list) else []):
        given = entry if isinstance(entry, dict) else {}
        what = given.get("what")
        if what not in _WITHOUT_EFFECT and what not in _IN_PARAMETERS:
            found.append((number, str(what)[:60], str(given.get("sentence"))[:200]))
    return found


def _of(name: str) -> str:
    """Return the name of a parameter in `_PARAMETERS`, for a mode's offset without the mode."""
    return _OFFSET if name.startswith(_OFFSET) and name[len(_OFFSET) :].isdecimal() else name


def _value(where: str, name: str, entry: object) -> float:
    """Return the value of a parameter in the valid range of the exact model."""
    known = _PARAMETERS.get(_of(name))
    if known is None or name == _OFFSET:
        raise IdentifiedBeamError(
            f"{where}.parameters.{name[:60]!r} is not known to this version, so what it changes "
            "cannot be taken into account; update rigd, or do without this document."
        )
    given = entry.get("value") if isinstance(entry, dict) else None
    value = finite_number(given)
    in_range = value is not None and known.least <= value < known.below and is_usable_size(value)
    if value is not None and in_range and (value > 0.0 or name not in _NEEDED):
        return value
    bound = "any size"
    if known.least > -inf:
        bound = "more than 0" if name in _NEEDED else f"{known.least:g} or more"
    if known.below < inf:
        bound += f" below {known.below:g}"
    unit = f" {known.unit}" if known.unit else ""
    raise IdentifiedBeamError(
        f"{where}.parameters.{name}.value = {json.dumps(given, default=str)[:60]} "
        f"must be a number of {bound}{unit}; {_REMEDY}."
    )


def _refuse_effects(where: str, values: Mapping[str, float], use: Use) -> None:
    """Raise for effects in addition to a uniform beam that the use does not take into account."""
    for name, value in values.items():
        known = _PARAMETERS[_of(name)]
        if not known.words or not value or _of(name) in use.effects:
            continue
        corner_hz = 0.0 if "filter" not in name else 1.0 / (2.0 * pi * value)
        remedy = known.remedy.format(
            corner_hz=corner_hz, order=2 if name.startswith("second") else 1
        )
        unit = f" {known.unit}" if known.unit else ""
        raise IdentifiedBeamError(
            f"{where}.parameters.{name}.value = {value:.4g}{unit}: the analysis found "
            f"{known.words}, which {use.name} does not take into account; {remedy}."
        )
    if values.get("tip_mass_kg") and any(values[n] for n in values if _of(n) == _OFFSET):
        raise IdentifiedBeamError(
            f"{where}.parameters: tip_mass_kg and {_OFFSET}… together are not defined; take the "
            "document of an analysis that found one of them."
        )


def _refuse_findings(where: str, named: object, use: Use) -> None:
    """Raise for findings without a parameter that change the beam or make the record doubtful."""
    for number, what, sentence in findings_without_parameter(named):
        raise IdentifiedBeamError(
            f"{where}.named[{number}]: {what}, which {use.name} does not take into "
            f"account ({sentence}); remove its cause, and record and analyze again, or "
            "leave out --model."
        )


def _deviation_for(where: str, name: str, entry: Mapping[str, Any], use: Use) -> float | None:
    """Return the standard deviation of a parameter, including the doubt of a flag."""
    flag = entry.get("flag")
    if flag is None:
        return _deviation(entry)
    # From analyses with other model variants: the deviation over all of them.
    any_rig = finite_number(entry.get("std_any_rig"))
    if any_rig is not None and any_rig > 0:
        return any_rig
    deviation = _deviation(entry)
    # For a move the uncertainty of the modes includes the damping.
    in_modes = use is MOVE and not _PARAMETERS[_of(name)].words
    if _of(name) not in use.certain and (deviation is not None or in_modes):
        return deviation
    raise IdentifiedBeamError(
        f"{where}.parameters.{name} is flagged ({str(flag)[:100]}), and {use.name} relies on it; "
        "record a session that shows more modes or is longer and analyze it, or leave out --model."
    )


def _deviation(entry: Mapping[str, Any]) -> float | None:
    """Return the 95 % half-width over 1.96, valid for all structures; else the std."""
    ends, std = entry.get("interval_95"), finite_number(entry.get("std"))
    if isinstance(ends, list) and len(ends) == 2:
        low, high = map(finite_number, ends)
        if low is not None and high is not None:
            return abs(high - low) / (2 * _TWO_SIDED_95)
    return std if std is not None and std > 0 else None


def _offsets(where: str, values: Mapping[str, float]) -> tuple[float, ...]:
    """Return the offsets of modes 2, 3, … up to the last one in the document."""
    found = {int(n[len(_OFFSET) :]): value for n, value in values.items() if _of(n) == _OFFSET}
    modes = range(2, 2 + len(found))
    if sorted(found) != list(modes):
        given = ", ".join(map(str, sorted(found)))
        raise IdentifiedBeamError(
            f"{where}.parameters: {_OFFSET}… are those of modes {given}, but must be those of "
            f"modes 2 to {modes[-1]}; {_REMEDY}."
        )
    return tuple(found[mode] for mode in modes)


def _mode_uncertainty(where: str, modes: object) -> tuple[float, ...]:
    """Return the relative standard uncertainty of the poles of modes 1, 2, …."""
    found: list[float] = []
    for number, entry in enumerate(modes if isinstance(modes, Sequence) else [], start=1):
        given = entry if isinstance(entry, dict) else {}
        hz, ratio = (
            of if isinstance(of := given.get(name), dict) else {}
            for name in ("frequency_hz", "damping_ratio")
        )
        value_hz = finite_number(hz.get("value"))
        if not value_hz or not ratio or given.get("mode") != number:
            raise IdentifiedBeamError(
                f"{where}.modes[{number - 1}] is not mode {number} with frequency_hz and "
                f"damping_ratio; {_REMEDY}."
            )
        found.append(hypot(_of_mode(hz) / value_hz, _of_mode(ratio)))
    return tuple(found)


def _of_mode(entry: Mapping[str, Any]) -> float:
    any_rig = finite_number(entry.get("std_any_rig"))
    return max(any_rig or 0.0, _deviation(entry) or 0.0)
