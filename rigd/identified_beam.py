"""Reader of the beam that an analysis has identified, from the document of ``analyze --json``.

Every parameter and every finding of the document is either taken into account or causes an error
that names it; none is ignored.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, pi
from pathlib import Path
from typing import Any, Final

from rigd.beam import (
    BEAM_PARAMETERS,
    END_PARAMETERS,
    FILTER_PARAMETERS,
    OFFSET_PREFIX,
    Plant,
    clamped_free_eigenvalues,
    parameter_named,
    participation,
)
from rigd.documents import DocumentError, read_json
from rigd.errors import UserError
from rigd.units import finite_number, is_usable_size

_HALF_WIDTH_95_STDS: Final = 1.959964
"""Half-width of the two-sided 95 % interval of a normal distribution, in standard deviations."""
_ADVICE: Final = "write it with analyze session.mcap --json model.json"
"""Advice in messages about unusable documents."""


_FILTER_ADVICE: Final = (  # Advice if the analysis found a low-pass filter
    "state it in the profile (sensor.filter_hz = {corner_hz:.4g}, sensor.filter_order = {order}), "
    "record again and analyze that session"
)
_EFFECTS: Final[Mapping[str, tuple[str, str]]] = {
    "tip_mass_kg": ("a mass at the tip", "take it off, and record and analyze again"),
    "root_compliance_rad_per_nm": (
        "an elastic clamp",
        "tighten or stiffen the clamp, and record and analyze again",
    ),
    OFFSET_PREFIX: (
        "a mode whose stiffness is not that of a uniform beam",
        "look for an added mass or a section that varies, and record and analyze again",
    ),
    **dict.fromkeys(FILTER_PARAMETERS, ("a low-pass filter of the torque", _FILTER_ADVICE)),
    "clock_rate_difference": (
        "clocks of different rates",
        "sample angle and torque by one clock, and record and analyze again",
    ),
    "drag": ("drag of the air", "leave --model out, and expect more vibration than stated"),
}
"""Effects beyond a uniform beam with ideal channels, by the names of their parameters: description,
and how to obtain a document without the effect.

Offsets of modes, the compliance of the clamp and the difference of clocks are no longer
estimated."""

_FINDINGS_IN_ESTIMATES: Final = frozenset(
    {"hum", "sensor drift", "ringing start", "knock", "clipping", "stop"}
)
"""Kinds of findings on a record that the estimates take into account.

Doubtful numbers are flagged."""

_FINDINGS_IN_PARAMETERS: Final = frozenset(
    {
        *("delay", "tool inertia", "beam data", "air drag", "rival explanations"),
        # From analyses with model variants other than the uniform beam:
        *("not uniform", "elastic clamp", "tip mass", "torque filter"),
    }
)
"""Kinds of findings whose magnitude is among the parameters."""


class IdentifiedBeamError(UserError, ValueError):
    """The document of an analysis has no usable beam; the message names file, key and remedy."""


@dataclass(frozen=True, slots=True)
class Use:
    """Purpose for which an identified beam is used, with its requirements on the document."""

    name: str
    """Name of the purpose in messages, such as "a move"."""
    effects: frozenset[str]
    """Parameters of effects beyond a uniform beam that are taken into account."""
    certain: frozenset[str]
    """Parameters that must not be flagged, unless their standard deviation covers the doubt."""
    modes: bool = False
    """Whether observed modes can replace those of a uniform beam, with one stiffness per mode."""


MOVE: Final = Use(
    "a move",
    frozenset({"tip_mass_kg", "root_compliance_rad_per_nm", OFFSET_PREFIX}),
    frozenset({*BEAM_PARAMETERS, "tip_mass_kg", "root_compliance_rad_per_nm", OFFSET_PREFIX}),
    modes=True,
)
"""Use of a beam for a vibration-free move.

The move depends on the modes and hardly on the composition of their damping."""

TOUCH: Final = Use(
    "a search for touches",
    frozenset(),
    frozenset(BEAM_PARAMETERS),
)
"""Use of a beam to locate touches.

They are located by the exact model of a uniform beam with a free tip on a rigid clamp."""


@dataclass(frozen=True, slots=True)
class IdentifiedBeam:
    """Beam and torque channel that an analysis has identified, with uncertainties."""

    plant: Plant
    """Plant with the given length and the identified parameters. A damping coefficient of 0 means
    that the structure has no such damping."""
    std: Mapping[str, float]
    """Known standard deviations of parameters, by their names in the document."""
    mode_uncertainty: tuple[float, ...] = ()
    """Relative standard uncertainty of the pole of each mode in the document."""

    def pole_uncertainty(self, mode_count: int) -> tuple[float, ...]:
        """Return the relative standard uncertainty of the poles of the first modes.

        Parameters
        ----------
        mode_count
            Number of modes, from the first on. For a mode that is not in the document it is the
            largest uncertainty of the modes in the document.
        """
        density_uncertainty = (
            0.5 * self.std.get(BEAM_PARAMETERS[0], 0.0) / self.plant.beam.density_over_stiffness
        )
        largest_uncertainty = max(self.mode_uncertainty, default=density_uncertainty)
        return (*self.mode_uncertainty, *(largest_uncertainty,) * mode_count)[:mode_count]


def read_identified_beam(document_path: str | Path, stated: Plant, use: Use) -> IdentifiedBeam:
    """Read the identified beam from the document of an analysis or a campaign.

    It is that of the first headline, for a campaign that of the pooled headline. If a uniform beam
    predicts the modes, the parameters are those of an exactly uniform beam, which predict the
    record best. Otherwise no uniform beam describes the rig, and the modes themselves are used if
    the purpose permits it.

    Parameters
    ----------
    document_path
        Document of ``analyze session.mcap --json``: ``headlines[].parameters``, ``modes``,
        ``exact_geometry``, ``validity.uniform_beam`` and ``named``.
    stated
        Stated plant: its length, which is not observable in a session, its delay and tool inertia
        apply if the document has none.
    use
        Purpose of the beam: `MOVE` or `TOUCH`.

    Returns
    -------
    IdentifiedBeam
        Plant and uncertainties.

    Raises
    ------
    IdentifiedBeamError
        If the file cannot be read or lacks parameters, if it has an effect or a finding that this
        use does not take into account, or if a required number is flagged.
    """
    document_path = Path(document_path)
    headline_label, headline, refusal = _read_headline(document_path)
    if refusal and not use.modes:
        raise IdentifiedBeamError(
            f"{headline_label}.validity.uniform_beam: {refusal}, and {use.name} relies on a "
            "uniform beam; "
            "remove what makes it differ (a mass, a soft clamp, an axis that is not plumb), and "
            "record and analyze again, or leave out --model."
        )
    _require_known_findings(headline_label, headline.get("named"), use)
    parameter_object = headline
    if not refusal and isinstance(exact_geometry := headline.get("exact_geometry"), dict):
        headline_label, parameter_object = f"{headline_label}.exact_geometry", exact_geometry
    parameters = parameter_object.get("parameters")
    if not isinstance(parameters, dict):
        raise IdentifiedBeamError(f"{headline_label}.parameters is missing; {_ADVICE}.")
    values_by_name = parameter_values(headline_label, parameters)
    if refusal:
        # Effective values of a uniform beam do not describe the rig: the modes replace them.
        values_by_name = {
            n: v
            for n, v in values_by_name.items()
            if _effect_key(n) not in (OFFSET_PREFIX, *END_PARAMETERS)
        }
    _require_known_effects(headline_label, values_by_name, use)
    std = {}
    for parameter_name in values_by_name:
        parameter_std = (
            _standard_deviation(parameters[parameter_name])
            if refusal
            else _required_deviation(
                headline_label, parameter_name, parameters[parameter_name], use
            )
        )
        if parameter_std is not None:
            std[parameter_name] = parameter_std
    _check_offset_modes(headline_label, values_by_name)
    plant_values = {
        parameter_name: parameter_value
        for parameter_name, parameter_value in values_by_name.items()
        if (effect_key := _effect_key(parameter_name)) not in _EFFECTS or effect_key in use.effects
    }
    channel_values = {name: getattr(stated, name) for name in ("delay_s", "tool_inertia_kg_m2")}
    identified_beam = IdentifiedBeam(
        Plant.from_parameters(stated.beam.length_m, channel_values | plant_values),
        std,
        _mode_uncertainty(headline_label, parameter_object.get("modes")),
    )
    return (
        _with_observed_modes(headline_label, identified_beam, headline.get("modes"), refusal)
        if refusal
        else identified_beam
    )


def _with_observed_modes(
    label: str, identified_beam: IdentifiedBeam, modes: object, refusal: str
) -> IdentifiedBeam:
    """Return the beam after its modes are replaced by the observed ones.

    Stiffness offsets give it the observed frequencies, and its inertia follows from the first
    mode's participation. `refusal` is the reason why no uniform beam can be used.
    """
    observed_modes: list[tuple[float, float, float | None]] = []
    for entry in modes if isinstance(modes, list) else []:
        if not isinstance(entry, dict) or not entry.get("shown", True):
            break
        mode_quantities = [
            entry.get(key) for key in ("frequency_hz", "damping_ratio", "participation")
        ]
        hz, damping_ratio, mode_inertia = (
            finite_number(quantity_name.get("value")) if isinstance(quantity_name, dict) else None
            for quantity_name in mode_quantities
        )
        quantity_flags = [
            quantity_name.get("flag")
            for quantity_name in mode_quantities
            if isinstance(quantity_name, dict)
        ]
        if not hz or not damping_ratio or hz < 0 or any(quantity_flags):
            break
        observed_modes.append((hz, damping_ratio, mode_inertia))
    if not observed_modes:
        raise IdentifiedBeamError(
            f"{label}.modes: {refusal}, and no mode is shown without a flag that could take its "
            "place; record a session that shows more modes and analyze it, or leave out --model."
        )
    try:
        plant = identified_beam.plant.with_frequencies([hz for hz, _, _ in observed_modes])
    except ValueError as error:
        raise IdentifiedBeamError(f"{label}.parameters: {error} Leave out --model.") from None
    beam, mode_inertia = plant.beam, observed_modes[0][2]
    if mode_inertia and mode_inertia > 0:
        mass_scale = mode_inertia / (beam.density_kg_per_m * float(participation(beam, 1)[0]))
        beam = replace(
            beam,
            density_kg_per_m=mass_scale * beam.density_kg_per_m,
            bending_stiffness_n_m2=mass_scale * beam.bending_stiffness_n_m2,
        )
        plant = replace(plant, beam=beam)
    poles = plant.poles(clamped_free_eigenvalues(len(observed_modes)))[:, 0]
    # The difference between the damping of the beam and of the modes counts as uncertainty.
    pole_uncertainties = (
        hypot(parameter_std, abs(damping_ratio + pole.real / abs(pole)))
        for parameter_std, (_, damping_ratio, _), pole in zip(
            identified_beam.mode_uncertainty, observed_modes, poles, strict=False
        )
    )
    return replace(identified_beam, plant=plant, mode_uncertainty=tuple(pole_uncertainties))


def _read_headline(path: Path) -> tuple[str, Mapping[str, Any], str]:
    """Return the name of a headline in messages, the headline, and why no uniform beam can be used.

    The reason is "" if a uniform beam can be used.
    """
    document: Any = read_document(path)
    label, headline = select_headline(path, document)
    # A single record of a campaign can exclude a uniform beam.
    pooled = headline.get("file", "") is None
    headlines = filter(_is_json_object, document["headlines"]) if pooled else [headline]
    return label, headline, next(filter(None, map(_uniform_beam_refusal, headlines)), "")


def _is_json_object(entry: object) -> bool:
    """Return whether a value of a document is a JSON object."""
    return isinstance(entry, dict)


def read_document(path: Path) -> object:
    """Read the JSON document of an analysis.

    Parameters
    ----------
    path
        File that ``analyze --json`` has written.

    Raises
    ------
    IdentifiedBeamError
        If the file cannot be read, or is not JSON.
    """
    try:
        return read_json(path)
    except DocumentError as error:
        raise IdentifiedBeamError(f"{path}: {error}; {_ADVICE}.") from error


def select_headline(path: Path, document: object) -> tuple[str, Mapping[str, Any]]:
    """Return the first headline of an analysis' document, after its name in messages.

    For a campaign it is the pooled headline.

    Parameters
    ----------
    path
        File of the document, for messages.
    document
        Document as returned by `read_document`.

    Raises
    ------
    IdentifiedBeamError
        If the document has no headline with parameters.
    """
    headlines = document.get("headlines") if isinstance(document, dict) else None
    if not isinstance(headlines, list):
        headlines = []
    numbered_headlines = [
        (k, headline_entry)
        for k, headline_entry in enumerate(headlines)
        if isinstance(headline_entry, dict)
    ]
    pooled_headlines = [
        (k, headline_entry)
        for k, headline_entry in numbered_headlines
        if headline_entry.get("file", "") is None
    ]
    headline_index, headline = next(iter(pooled_headlines + numbered_headlines), (0, {}))
    if not isinstance(headline.get("parameters"), dict):
        raise IdentifiedBeamError(f"{path}: has no headlines[0].parameters; {_ADVICE}.")
    return f"{path}: headlines[{headline_index}]", headline


def _uniform_beam_refusal(headline: Mapping[str, Any]) -> str:
    """Return why a uniform beam does not predict the modes of a record, or "" if it may."""
    model_validity = headline.get("validity")
    uniform_beam_test = (
        model_validity.get("uniform_beam") if isinstance(model_validity, dict) else None
    )
    if not isinstance(uniform_beam_test, dict) or uniform_beam_test.get("status") != "refused":
        return ""
    p_value = finite_number(uniform_beam_test.get("p_value"))
    p = "" if p_value is None else f" (p = {p_value:.1g})"
    return f"a uniform beam does not predict the modes that the record shows{p}"


def parameter_values(label: str, parameter_entries: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of a headline's parameters, after a check of their ranges.

    Parameters
    ----------
    label
        Name of the headline in messages.
    parameter_entries
        Object ``parameter_entries`` of the headline.

    Raises
    ------
    IdentifiedBeamError
        If a parameter is unknown or out of range, or a required parameter is missing.
    """
    values_by_name = {
        parameter_name: _parameter_value(label, parameter_name, parameter_entry)
        for parameter_name, parameter_entry in parameter_entries.items()
    }
    for parameter_name in BEAM_PARAMETERS:
        if parameter_name not in values_by_name:
            raise IdentifiedBeamError(
                f"{label}.parameters.{parameter_name} is missing; take the document of an "
                "analysis that "
                "found it (analyze session.mcap --json model.json)."
            )
    return values_by_name


def findings_without_parameter(named: object) -> list[tuple[int, str, str]]:
    """Return the findings of an analysis whose effect no parameter describes.

    Each one is a tuple of index, kind and sentence. Findings that concern only the record and not
    the antenna are omitted.

    Parameters
    ----------
    named
        List ``named`` of a headline.
    """
    unmodelled_findings = []
    for finding_index, finding_entry in enumerate(named if isinstance(named, list) else []):
        finding = finding_entry if isinstance(finding_entry, dict) else {}
        finding_kind = finding.get("what")
        if (
            finding_kind not in _FINDINGS_IN_ESTIMATES
            and finding_kind not in _FINDINGS_IN_PARAMETERS
        ):
            unmodelled_findings.append(
                (finding_index, str(finding_kind)[:60], str(finding.get("sentence"))[:200])
            )
    return unmodelled_findings


def _effect_key(parameter_name: str) -> str:
    """Return the key of a parameter in `_EFFECTS`; that of an offset lacks the mode's number."""
    return OFFSET_PREFIX if parameter_name.startswith(OFFSET_PREFIX) else parameter_name


def _parameter_value(label: str, name: str, entry: object) -> float:
    """Return the value of a parameter, or raise if it is unknown or outside its range."""
    try:
        definition = parameter_named(name)
    except KeyError:
        raise IdentifiedBeamError(
            f"{label}.parameters.{name[:60]!r} is not known to this version, so what it changes "
            "cannot be taken into account; update rigd, or do without this document."
        ) from None
    stated_value = entry.get("value") if isinstance(entry, dict) else None
    finite_value = finite_number(stated_value)
    if (
        finite_value is not None
        and definition.is_valid(finite_value)
        and is_usable_size(finite_value)
    ):
        return finite_value
    raise IdentifiedBeamError(
        f"{label}.parameters.{name}.value = {json.dumps(stated_value, default=str)[:60]} "
        f"must be a number of {definition.range_text}; {_ADVICE}."
    )


def _require_known_effects(label: str, values_by_name: Mapping[str, float], use: Use) -> None:
    """Raise IdentifiedBeamError if the analysis found an effect that the use cannot include."""
    for parameter_name, parameter_value in values_by_name.items():
        effect_key = _effect_key(parameter_name)
        if not parameter_value or effect_key not in _EFFECTS or effect_key in use.effects:
            continue
        description, remedy = _EFFECTS[effect_key]
        corner_hz = 0.0 if "filter" not in parameter_name else 1.0 / (2.0 * pi * parameter_value)
        remedy_text = remedy.format(
            corner_hz=corner_hz, order=2 if parameter_name.startswith("second") else 1
        )
        unit = parameter_named(parameter_name).unit
        unit_text = f" {unit}" if unit else ""
        raise IdentifiedBeamError(
            f"{label}.parameters.{parameter_name}.value = {parameter_value:.4g}{unit_text}: "
            f"the analysis found {description}, which {use.name} does not take into account; "
            f"{remedy_text}."
        )
    if values_by_name.get("tip_mass_kg") and any(
        values_by_name[n] for n in values_by_name if n.startswith(OFFSET_PREFIX)
    ):
        raise IdentifiedBeamError(
            f"{label}.parameters: tip_mass_kg and {OFFSET_PREFIX}… together are not defined; take "
            "the document of an analysis that found one of them."
        )


def _require_known_findings(label: str, named: object, use: Use) -> None:
    """Raise IdentifiedBeamError if no parameter describes a finding of the analysis."""
    for finding_index, finding_kind, sentence in findings_without_parameter(named):
        raise IdentifiedBeamError(
            f"{label}.named[{finding_index}]: {finding_kind}, which {use.name} does not take into "
            f"account ({sentence}); remove its cause, and record and analyze again, or "
            "leave out --model."
        )


def _required_deviation(label: str, name: str, entry: Mapping[str, Any], use: Use) -> float | None:
    """Return the standard deviation of a parameter, or None if it is unknown.

    Raises if the parameter is flagged and the use relies on it.
    """
    entry_flag = entry.get("flag")
    if entry_flag is None:
        return _standard_deviation(entry)
    # From analyses with other model variants: the deviation over all of them.
    std_any_rig = finite_number(entry.get("std_any_rig"))
    if std_any_rig is not None and std_any_rig > 0:
        return std_any_rig
    parameter_std = _standard_deviation(entry)
    # For a move the uncertainty of the modes includes the damping.
    covered_by_modes = use is MOVE and _effect_key(name) not in _EFFECTS
    if _effect_key(name) not in use.certain and (parameter_std is not None or covered_by_modes):
        return parameter_std
    raise IdentifiedBeamError(
        f"{label}.parameters.{name} is flagged ({str(entry_flag)[:100]}), and {use.name} "
        "relies on it; "
        "record a session that shows more modes or is longer and analyze it, or leave out --model."
    )


def _standard_deviation(entry: Mapping[str, Any]) -> float | None:
    """Return the standard deviation of a parameter, or None if it is unknown.

    It follows from the 95 % interval, which is valid for all structures, if there is one.
    """
    interval_95, std = entry.get("interval_95"), finite_number(entry.get("std"))
    if isinstance(interval_95, list) and len(interval_95) == 2:
        low, upper_end = map(finite_number, interval_95)
        if low is not None and upper_end is not None:
            return abs(upper_end - low) / (2 * _HALF_WIDTH_95_STDS)
    return std if std is not None and std > 0 else None


def _check_offset_modes(label: str, values_by_name: Mapping[str, float]) -> None:
    """Raise IdentifiedBeamError if the stiffness offsets are not those of modes 2, 3 etc."""
    given_modes = sorted(
        int(n.removeprefix(OFFSET_PREFIX)) for n in values_by_name if n.startswith(OFFSET_PREFIX)
    )
    if given_modes != list(range(2, 2 + len(given_modes))):
        raise IdentifiedBeamError(
            f"{label}.parameters: {OFFSET_PREFIX}… are those of modes "
            f"{', '.join(map(str, given_modes))}, but must be those of modes 2 to "
            f"{1 + len(given_modes)}; {_ADVICE}."
        )


def _mode_uncertainty(label: str, modes: object) -> tuple[float, ...]:
    """Return the relative standard uncertainty of the pole of each mode in the document."""
    uncertainties: list[float] = []
    for mode_index, mode_entry in enumerate(modes if isinstance(modes, Sequence) else [], start=1):
        mode_object = mode_entry if isinstance(mode_entry, dict) else {}
        hz, damping_ratio = (
            of if isinstance(of := mode_object.get(quantity_name), dict) else {}
            for quantity_name in ("frequency_hz", "damping_ratio")
        )
        value_hz = finite_number(hz.get("value"))
        if not value_hz or not damping_ratio or mode_object.get("mode") != mode_index:
            raise IdentifiedBeamError(
                f"{label}.modes[{mode_index - 1}] is not mode {mode_index} with frequency_hz and "
                f"damping_ratio; {_ADVICE}."
            )
        uncertainties.append(hypot(_mode_deviation(hz) / value_hz, _mode_deviation(damping_ratio)))
    return tuple(uncertainties)


def _mode_deviation(entry: Mapping[str, Any]) -> float:
    """Return the standard deviation of a mode's quantity, or 0 if it is unknown."""
    std_any_rig = finite_number(entry.get("std_any_rig"))
    return max(std_any_rig or 0.0, _standard_deviation(entry) or 0.0)
