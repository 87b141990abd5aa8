"""Reader of the beam that an analysis has identified, from the document of ``analyze --json``.

Every parameter and every finding of the document is either taken into account or causes an error
that names it; none is ignored.
"""

import json
from collections.abc import Iterator, Mapping
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
from rigd.estimates import Estimate, ReportedMode
from rigd.session import BeamUniformity
from rigd.units import is_usable_size

_INTERVAL_95_HALF_WIDTH_STDS: Final = 1.959964
"""Half-width of the two-sided 95 % interval of a normal distribution, in standard deviations."""
_WRITE_DOCUMENT_ADVICE: Final = "write it with analyze session.mcap --json model.json"
"""Advice in messages about unusable documents."""


_FILTER_ADVICE: Final = (  # Advice if the analysis found a low-pass filter
    "state it in the profile (sensor.filter_hz = {corner_hz:.4g}, sensor.filter_order = "
    "{order}), record again and analyze that session"
)
_EFFECTS_BY_PARAMETER: Final[Mapping[str, tuple[str, str]]] = {
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

_MAX_SENTENCE_LENGTH: Final = 300
"""Number of characters of a finding's sentence that are quoted in messages and notes."""

_DRAG_FINDING: Final = "air drag"
"""Kind of the finding that air drag acts on the beam."""

_FINDINGS_IN_PARAMETERS: Final = frozenset(
    {
        *("delay", "tool inertia", "beam data", _DRAG_FINDING, "rival explanations"),
        # From analyses with model variants other than the uniform beam:
        *("not uniform", "elastic clamp", "tip mass", "torque filter"),
    }
)
"""Kinds of findings whose magnitude is among the parameters, except for air drag that was fitted
with the modes."""


class IdentifiedBeamError(UserError, ValueError):
    """The document of an analysis has no usable beam; the message names file, key and remedy."""


@dataclass(frozen=True, slots=True)
class BeamUse:
    """Purpose for which an identified beam is used, with its requirements on the document."""

    name: str
    """Name of the purpose in messages, such as "a move"."""
    included_effects: frozenset[str]
    """Parameters of effects beyond a uniform beam that are taken into account."""
    required_parameters: frozenset[str]
    """Parameters that must not be flagged, unless their standard deviation covers the doubt."""
    allows_observed_modes: bool = False
    """Whether observed modes can replace those of a uniform beam, with one stiffness per mode."""


MOVE_USE: Final = BeamUse(
    "a move",
    frozenset({"tip_mass_kg", "root_compliance_rad_per_nm", OFFSET_PREFIX}),
    frozenset({*BEAM_PARAMETERS, "tip_mass_kg", "root_compliance_rad_per_nm", OFFSET_PREFIX}),
    allows_observed_modes=True,
)
"""Use of a beam for a vibration-free move.

The move depends on the modes and hardly on the composition of their damping."""

TOUCH_USE: Final = BeamUse("a search for touches", frozenset(), frozenset(BEAM_PARAMETERS))
"""Use of a beam to locate touches.

They are located by the exact model of a uniform beam with a free tip on a rigid clamp."""


@dataclass(frozen=True, slots=True)
class IdentifiedBeam:
    """Beam and torque channel that an analysis has identified, with uncertainties."""

    plant: Plant
    """Plant with the given length and the identified parameters. A damping coefficient of 0 means
    that the structure has no such damping."""
    parameter_stds: Mapping[str, float]
    """Known standard deviations of parameters, by their names in the document."""
    mode_uncertainty: tuple[float, ...] = ()
    """Relative standard uncertainty of the pole of each mode in the document."""

    def pole_uncertainty(self, mode_count: int) -> tuple[float, ...]:
        """Return the relative standard uncertainty of the pole of each of the first modes.

        Parameters
        ----------
        mode_count
            Number of modes, from the first on. For a mode that is not in the document it is the
            largest uncertainty of the modes in the document.
        """
        density_uncertainty = (
            0.5
            * self.parameter_stds.get(BEAM_PARAMETERS[0], 0.0)
            / self.plant.beam.density_over_stiffness
        )
        largest_uncertainty = max(self.mode_uncertainty, default=density_uncertainty)
        return (*self.mode_uncertainty, *(largest_uncertainty,) * mode_count)[:mode_count]


def read_identified_beam(
    document_path: str | Path, stated_plant: Plant, use: BeamUse
) -> IdentifiedBeam:
    """Read the identified beam from the document of an analysis or a campaign.

    The beam is that of the first headline, or of a campaign's pooled headline. If a uniform beam
    predicts the modes, the parameters are those of an exactly uniform beam, which predict the
    record best. Otherwise no uniform beam describes the rig, and the modes themselves are used if
    the purpose permits it.

    Parameters
    ----------
    document_path
        Document of ``analyze session.mcap --json``: ``headlines[].parameters``, ``modes``,
        ``exact_geometry``, ``validity.uniform_beam`` and ``named``.
    stated_plant
        Plant with the stated length, which no session determines, and with the delay and the tool
        inertia to use if the document has none.
    use
        Purpose of the beam: `MOVE_USE` or `TOUCH_USE`.

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
    headline_label, headline, refusal = _read_headline(Path(document_path))
    if refusal and not use.allows_observed_modes:
        raise IdentifiedBeamError(
            f"{headline_label}.validity.uniform_beam: {refusal}, and {use.name} relies on a "
            "uniform beam; remove what makes it differ (a mass, a soft clamp, an axis that is "
            "not plumb), and record and analyze again, or leave out --model."
        )
    _require_known_findings(headline_label, headline, use)
    exact_geometry = headline.get("exact_geometry")
    if not refusal and isinstance(exact_geometry, dict):
        headline_label, headline = f"{headline_label}.exact_geometry", exact_geometry
    estimates = parameter_estimates(headline_label, headline.get("parameters"))
    if refusal:
        # Effective values of a uniform beam do not describe the rig: the modes replace them.
        estimates = {
            name: estimate
            for name, estimate in estimates.items()
            if _effect_key(name) not in (OFFSET_PREFIX, *END_PARAMETERS)
        }
    parameter_values = {name: estimate.value for name, estimate in estimates.items()}
    _require_known_effects(headline_label, parameter_values, use)
    if not refusal:
        _require_unflagged_parameters(headline_label, estimates, use)
    _check_offset_modes(headline_label, parameter_values)
    plant_values = {
        name: value
        for name, value in parameter_values.items()
        if (effect_key := _effect_key(name)) not in _EFFECTS_BY_PARAMETER
        or effect_key in use.included_effects
    }
    channel_values = {
        name: getattr(stated_plant, name) for name in ("delay_s", "tool_inertia_kg_m2")
    }
    identified_beam = IdentifiedBeam(
        Plant.from_parameters(stated_plant.beam.length_m, channel_values | plant_values),
        {
            name: std
            for name, estimate in estimates.items()
            if (std := _standard_deviation(estimate)) is not None
        },
        tuple(_mode_uncertainties(headline_label, headline.get("modes"))),
    )
    return (
        _with_observed_modes(headline_label, identified_beam, headline.get("modes"), refusal)
        if refusal
        else identified_beam
    )


def _with_observed_modes(
    headline_label: str, identified_beam: IdentifiedBeam, mode_documents: object, refusal: str
) -> IdentifiedBeam:
    """Return the beam after its modes are replaced by the observed ones.

    Stiffness offsets give it the observed frequencies, and its inertia follows from the first
    mode's participation. `refusal` is the reason why no uniform beam can be used.
    """
    observed_modes: list[ReportedMode] = []
    for number, document in enumerate(
        mode_documents if isinstance(mode_documents, list) else [], start=1
    ):
        mode = ReportedMode.from_json(document, number)
        if mode is None or not mode.shown or not mode.damping_ratio.value or mode.flag:
            break
        if mode.participation is not None and mode.participation.flag:
            break
        observed_modes.append(mode)
    if not observed_modes:
        raise IdentifiedBeamError(
            f"{headline_label}.modes: {refusal}, and no mode is shown without a flag that could "
            "take its place; record a session that shows more modes and analyze it, or leave "
            "out --model."
        )
    try:
        plant = identified_beam.plant.with_frequencies(
            [mode.frequency_hz.value for mode in observed_modes]
        )
    except ValueError as error:
        raise IdentifiedBeamError(
            f"{headline_label}.parameters: {error} Leave out --model."
        ) from None
    beam, mode_inertia = plant.beam, observed_modes[0].participation
    if mode_inertia is not None and mode_inertia.value > 0:
        mass_scale = mode_inertia.value / (beam.density_kg_per_m * float(participation(beam, 1)[0]))
        beam = replace(
            beam,
            density_kg_per_m=mass_scale * beam.density_kg_per_m,
            bending_stiffness_n_m2=mass_scale * beam.bending_stiffness_n_m2,
        )
        plant = replace(plant, beam=beam)
    poles = plant.poles(clamped_free_eigenvalues(len(observed_modes)))[:, 0]
    # The difference between the damping of the beam and of the modes counts as uncertainty.
    pole_uncertainties = (
        hypot(std, abs(mode.damping_ratio.value + pole.real / abs(pole)))
        for std, mode, pole in zip(
            identified_beam.mode_uncertainty, observed_modes, poles, strict=False
        )
    )
    return replace(identified_beam, plant=plant, mode_uncertainty=tuple(pole_uncertainties))


def _read_headline(path: Path) -> tuple[str, Mapping[str, Any], str]:
    """Return the name of a headline in messages, the headline, and why no uniform beam can be used.

    The reason is "" if a uniform beam can be used.
    """
    document: Any = read_document(path)
    headline_label, headline = select_headline(path, document)
    # A single record of a campaign can exclude a uniform beam.
    is_pooled = headline.get("file", "") is None
    headlines = document["headlines"] if is_pooled else [headline]
    uniform_beam_refusals = [
        _uniform_beam_refusal(path, stated_headline)
        for stated_headline in headlines
        if isinstance(stated_headline, dict)
    ]
    return headline_label, headline, next(filter(None, uniform_beam_refusals), "")


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
        raise IdentifiedBeamError(f"{path}: {error}; {_WRITE_DOCUMENT_ADVICE}.") from error


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
    numbered_headlines = [
        (k, headline)
        for k, headline in enumerate(headlines if isinstance(headlines, list) else [])
        if isinstance(headline, dict)
    ]
    headline_index, headline = min(  # the pooled one, else the first
        numbered_headlines, key=_is_of_single_file, default=(0, {})
    )
    if not isinstance(headline.get("parameters"), dict):
        raise IdentifiedBeamError(
            f"{path}: has no headlines[0].parameters; {_WRITE_DOCUMENT_ADVICE}."
        )
    return f"{path}: headlines[{headline_index}]", headline


def _is_of_single_file(numbered_headline: tuple[int, Mapping[str, Any]]) -> bool:
    """Return whether a headline is of a single file, and not of all files together."""
    return numbered_headline[1].get("file", "") is not None


def uniform_beam_test(headline_label: str, headline: Mapping[str, Any]) -> BeamUniformity:
    """Return the result of a headline's test whether a uniform beam predicts the modes.

    Parameters
    ----------
    headline_label
        Name of the headline, or of its file, in messages.
    headline
        Headline of an analysis.

    Raises
    ------
    IdentifiedBeamError
        If the headline states a result that cannot be read.
    """
    validity = headline.get("validity")
    stated_test = validity.get("uniform_beam") if isinstance(validity, dict) else None
    if stated_test is None:
        return BeamUniformity("not tested")
    uniformity_test = BeamUniformity.from_document(stated_test)
    if uniformity_test is None:
        raise IdentifiedBeamError(
            f"{headline_label}: validity.uniform_beam = "
            f"{json.dumps(stated_test, default=str)[:60]} of a headline is not the result of a "
            f"test; {_WRITE_DOCUMENT_ADVICE}."
        )
    return uniformity_test


def _uniform_beam_refusal(path: Path, headline: Mapping[str, Any]) -> str:
    """Return why a uniform beam does not predict the modes of a record, or "" if it may."""
    uniformity_test = uniform_beam_test(str(path), headline)
    if uniformity_test.status != "refused":
        return ""
    return (
        "a uniform beam does not predict the modes that the record shows (p = "
        f"{uniformity_test.p_value:.1g})"
    )


def parameter_estimates(headline_label: str, parameter_documents: object) -> dict[str, Estimate]:
    """Return the estimates of a headline's parameters by name, after a check of their ranges.

    Parameters
    ----------
    headline_label
        Name of the headline in messages.
    parameter_documents
        Value of the key ``parameters`` of the headline.

    Raises
    ------
    IdentifiedBeamError
        If a parameter is unknown or out of range, or a required parameter is missing.
    """
    if not isinstance(parameter_documents, dict):
        raise IdentifiedBeamError(
            f"{headline_label}.parameters is missing; {_WRITE_DOCUMENT_ADVICE}."
        )
    estimates = {
        name: _parameter_estimate(headline_label, name, document)
        for name, document in parameter_documents.items()
    }
    for name in BEAM_PARAMETERS:
        if name not in estimates:
            raise IdentifiedBeamError(
                f"{headline_label}.parameters.{name} is missing; take the document of an "
                "analysis that found it (analyze session.mcap --json model.json)."
            )
    return estimates


def findings_without_parameter(headline: Mapping[str, Any]) -> list[tuple[int, str, str]]:
    """Return the findings of an analysis whose effect no parameter describes.

    Each one is a tuple of index, kind and sentence. Findings that concern only the record and not
    the antenna are omitted. Air drag has no parameter if it was fitted with the modes. It is then
    included if it has a size: without one, it is not significant.

    Parameters
    ----------
    headline
        Headline of an analysis, with its list ``named``.
    """
    named_findings, parameter_documents = headline.get("named"), headline.get("parameters")
    has_drag_parameter = isinstance(parameter_documents, dict) and "drag" in parameter_documents
    findings = (
        (index, finding if isinstance(finding, dict) else {})
        for index, finding in enumerate(named_findings if isinstance(named_findings, list) else [])
    )
    return [
        (index, kind[:60], str(finding.get("sentence"))[:_MAX_SENTENCE_LENGTH])
        for index, finding in findings
        if (kind := str(finding.get("what")))
        not in _FINDINGS_IN_ESTIMATES | _FINDINGS_IN_PARAMETERS
        or (kind == _DRAG_FINDING and finding.get("value") is not None and not has_drag_parameter)
    ]


def _effect_key(parameter_name: str) -> str:
    """Return a parameter's key in `_EFFECT_TEXTS`; that of an offset lacks the mode's number."""
    return OFFSET_PREFIX if parameter_name.startswith(OFFSET_PREFIX) else parameter_name


def _parameter_estimate(
    headline_label: str, parameter_name: str, parameter_document: object
) -> Estimate:
    """Return the estimate of a parameter, or raise if it is unknown or outside its range."""
    try:
        parameter_definition = parameter_named(parameter_name)
    except KeyError:
        raise IdentifiedBeamError(
            f"{headline_label}.parameters.{parameter_name[:60]!r} is not known to this version, "
            "so what it changes cannot be taken into account; update rigd, or do without this "
            "document."
        ) from None
    estimate = Estimate.from_json(parameter_document)
    if (
        estimate
        and parameter_definition.is_valid(estimate.value)
        and is_usable_size(estimate.value)
    ):
        return estimate
    stated_value = parameter_document.get("value") if isinstance(parameter_document, dict) else None
    raise IdentifiedBeamError(
        f"{headline_label}.parameters.{parameter_name}.value = "
        f"{json.dumps(stated_value, default=str)[:60]} must be a number of "
        f"{parameter_definition.range_text}; {_WRITE_DOCUMENT_ADVICE}."
    )


def _require_known_effects(
    headline_label: str, values_by_name: Mapping[str, float], use: BeamUse
) -> None:
    """Raise IdentifiedBeamError if the analysis found an effect that the use cannot include."""
    for parameter_name, parameter_value in values_by_name.items():
        effect_key = _effect_key(parameter_name)
        if (
            not parameter_value
            or effect_key not in _EFFECTS_BY_PARAMETER
            or effect_key in use.included_effects
        ):
            continue
        description, remedy = _EFFECTS_BY_PARAMETER[effect_key]
        corner_hz = 0.0 if "filter" not in parameter_name else 1.0 / (2.0 * pi * parameter_value)
        remedy_text = remedy.format(
            corner_hz=corner_hz, order=2 if parameter_name.startswith("second") else 1
        )
        unit = parameter_named(parameter_name).unit
        unit_text = f" {unit}" if unit else ""
        raise IdentifiedBeamError(
            f"{headline_label}.parameters.{parameter_name}.value = "
            f"{parameter_value:.4g}{unit_text}: the analysis found {description}, which "
            f"{use.name} does not take into account; {remedy_text}."
        )
    if values_by_name.get("tip_mass_kg") and any(
        values_by_name[n] for n in values_by_name if n.startswith(OFFSET_PREFIX)
    ):
        raise IdentifiedBeamError(
            f"{headline_label}.parameters: tip_mass_kg and {OFFSET_PREFIX}… together are not "
            "defined; use the JSON of an analysis that found one of them."
        )


def _require_known_findings(headline_label: str, headline: Mapping[str, Any], use: BeamUse) -> None:
    """Raise IdentifiedBeamError if no parameter describes a finding of the analysis."""
    for finding_index, finding_kind, sentence in findings_without_parameter(headline):
        remedy = (
            _EFFECTS_BY_PARAMETER["drag"][1]
            if finding_kind == _DRAG_FINDING
            else "remove its cause, and record and analyze again, or leave out --model"
        )
        raise IdentifiedBeamError(
            f"{headline_label}.named[{finding_index}]: {finding_kind}, which {use.name} does not "
            f"take into account ({sentence}); {remedy}."
        )


def _require_unflagged_parameters(
    headline_label: str, estimates: Mapping[str, Estimate], use: BeamUse
) -> None:
    """Raise IdentifiedBeamError if a parameter is flagged on which the use relies."""
    for name, estimate in estimates.items():
        # For a move the uncertainty of the modes includes the damping.
        is_covered_by_modes = use is MOVE_USE and _effect_key(name) not in _EFFECTS_BY_PARAMETER
        is_covered = is_covered_by_modes or _standard_deviation(estimate) is not None
        if estimate.flag is not None and (
            _effect_key(name) in use.required_parameters or not is_covered
        ):
            raise IdentifiedBeamError(
                f"{headline_label}.parameters.{name} is flagged ({estimate.flag[:100]}), and "
                f"{use.name} relies on it; record a session that shows more modes or is longer "
                "and analyze it, or leave out --model."
            )


def _standard_deviation(estimate: Estimate) -> float | None:
    """Return the standard deviation of an estimate, or None if it is unknown.

    It follows from the 95 % interval, which is valid for all structures, if there is one.
    """
    if estimate.interval_95 is not None:
        low, high = estimate.interval_95
        return abs(high - low) / (2 * _INTERVAL_95_HALF_WIDTH_STDS)
    return estimate.std if estimate.std is not None and estimate.std > 0 else None


def _check_offset_modes(headline_label: str, values_by_name: Mapping[str, float]) -> None:
    """Raise IdentifiedBeamError if the stiffness offsets are not those of modes 2, 3 etc."""
    offset_mode_numbers = sorted(
        int(n.removeprefix(OFFSET_PREFIX)) for n in values_by_name if n.startswith(OFFSET_PREFIX)
    )
    if offset_mode_numbers != list(range(2, 2 + len(offset_mode_numbers))):
        raise IdentifiedBeamError(
            f"{headline_label}.parameters: {OFFSET_PREFIX}… are those of modes "
            f"{', '.join(map(str, offset_mode_numbers))}, but must be those of modes 2 to "
            f"{1 + len(offset_mode_numbers)}; {_WRITE_DOCUMENT_ADVICE}."
        )


def _mode_uncertainties(headline_label: str, mode_documents: object) -> Iterator[float]:
    """Yield the relative standard uncertainty of the pole of each mode in the document."""
    for number, document in enumerate(
        mode_documents if isinstance(mode_documents, list) else [], start=1
    ):
        mode = ReportedMode.from_json(document, 0)
        if mode is None or mode.number != number:
            raise IdentifiedBeamError(
                f"{headline_label}.modes[{number - 1}] is not mode {number} with frequency_hz "
                f"and damping_ratio; {_WRITE_DOCUMENT_ADVICE}."
            )
        yield hypot(
            (_standard_deviation(mode.frequency_hz) or 0.0) / mode.frequency_hz.value,
            _standard_deviation(mode.damping_ratio) or 0.0,
        )
