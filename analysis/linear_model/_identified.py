"""Identified model to be exported as a linear model: read from a document, or of a session."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify import BACKGROUND_COEFFICIENTS, ModalModel, Plant
from analysis.linear_model._dynamics import (
    LinearModelError,
    UncertainDynamics,
    beam_dynamics,
    modal_dynamics,
)
from analysis.linear_model._modal_constants import constant_value, with_changed_constants
from rigd.beam import Beam, Damping
from rigd.identified_beam import (
    findings_without_parameter,
    parameter_values,
    read_document,
    select_headline,
)
from rigd.units import finite_number, is_usable_size

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

_ANALYZE_AGAIN_ADVICE: Final = "analyze the session again"
"""Advice at the end of error messages on documents."""

_LOGARITHM_PREFIX: Final = "ln_"
"""Prefix of the name of a parameter whose logarithm has the covariance."""

_STIFFNESS_OFFSET_PREFIX: Final = "stiffness_offset_"
"""Prefix of the name of the stiffness offset of one mode; its number follows."""

_MAX_OFFSET_MODE: Final = 50
"""Largest mode number that a stiffness offset may have."""

_MAX_MODES: Final = 40
"""Largest number of modes in a modal model."""

_REASONS_TO_LEAVE_OUT: Final = {
    "drag": "the drag of the air grows with the amplitude",
    "clock_rate_difference": "it is a property of the instruments",
}
"""Parameters that a linear model from motion to torque leaves out, and why. A clock rate difference
is a parameter in documents of older versions only, as offsets of modes and the compliance of the
clamp are."""
_SIGNED_PREFIXES: Final = ("delay_s", _STIFFNESS_OFFSET_PREFIX)
"""Prefixes of parameters that may be negative."""

_ORDER_NAMES: Final = ("alpha", "lambda")
"""Names of the damping orders."""

_DEFAULT_BAND_HZ: Final = (0.05, 50.0)
"""Band of a document that does not state its band."""

_MIN_FIRST_HZ: Final = 0.05
"""Lowest first frequency of a band, in hertz."""

PASSED_STATUS: Final = "passed"
"""Status of the uniform-beam test if a uniform beam predicts the modes."""


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedModel:
    """Models that one analysis identified, as the source of an exported linear model.

    Attributes
    ----------
    source : str
        Name of the file that was analysed or read.
    headline_name : str
        Name of the headline in messages.
    headline : mapping
        Element of ``headlines`` in the document of the analysis.
    length_m : float or None
        Length of the beam; None if the document does not state one.
    band_hz : tuple of float
        Band of the analysis.
    """

    source: str
    headline_name: str
    headline: Mapping[str, Any]
    length_m: float | None
    band_hz: tuple[float, float]

    @property
    def gate(self) -> tuple[str, float | None]:
        """Return status and p-value of the uniform-beam test.

        The p-value is None if it was not tested.
        """
        validity = self.headline.get("validity")
        gate = validity.get("uniform_beam") if isinstance(validity, dict) else None
        if not isinstance(gate, dict):
            return "not tested", None
        return str(gate.get("status", "not tested")), finite_number(gate.get("p_value"))

    @property
    def modal(self) -> ModalModel | None:
        """Return the modal model of the analysis. It is None in documents of older versions."""
        content = self.headline.get("modal_model")
        if content is None:
            return None
        try:
            modal = ModalModel.from_json(content)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise self._error("modal_model", "is not a modal model") from error
        numbers = [*modal.poles_rad_s, *modal.residues, *modal.background]
        stable = all(pole.real < 0 < pole.imag for pole in modal.poles_rad_s)
        if len(modal.background) != BACKGROUND_COEFFICIENTS or not (
            len(modal.poles_rad_s) == len(modal.residues) <= _MAX_MODES
        ):
            raise self._error(
                "modal_model",
                f"must have up to {_MAX_MODES} poles, a residue for each of them, and "
                f"{BACKGROUND_COEFFICIENTS} coefficients of the background",
            )
        if not stable or not all(map(_is_finite, numbers)):
            raise self._error(
                "modal_model", "must have poles with negative real and positive imaginary parts"
            )
        return modal

    def modal_covariance(self) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Return names and covariance of the modal constants, or None if they are not stated."""
        return self._covariance("modal_model", self.headline.get("modal_model"), "covariance")

    def beam_covariance(self) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Return names and covariance of the beam parameters, or None if they are not stated."""
        return self._covariance("covariance", self._beam_part.get("covariance"), "matrix")

    @property
    def beam_notes(self) -> tuple[str, ...]:
        """Return doubts about the beam parameters, and effects that a linear model leaves out."""
        parameters = self._beam_part["parameters"]
        flagged = [name for name, each in parameters.items() if _doubt_about(each)]
        notes = [f"flagged by the analysis: {', '.join(flagged)}"] if flagged else []
        notes += [
            f"{name} is not part of the model: {why}"
            for name, why in _REASONS_TO_LEAVE_OUT.items()
            if name in parameters and parameters[name]["value"]
        ]
        named = self.headline.get("named")
        notes += [
            f"not part of the model: {kind} ({sentence.removesuffix('.')})"
            for _, kind, sentence in findings_without_parameter(named)
        ]
        return tuple(notes)

    @property
    def modal_notes(self) -> tuple[str, ...]:
        """Return a note on the doubtful modes of the modal model, if there are any."""
        listed = self.headline.get("modes")
        flagged = [
            str(each.get("mode"))
            for each in (listed if isinstance(listed, list) else [])
            if isinstance(each, dict)
            and each.get("source") == "modal"
            and any(_doubt_about(each.get(key)) for key in ("frequency_hz", "damping_ratio"))
        ]
        return (f"flagged by the analysis: mode {', '.join(flagged)}",) if flagged else ()

    @property
    def _beam_part(self) -> Mapping[str, Any]:
        """Return the part of the headline that contains the parameters of the exported beam.

        This is the exactly uniform beam, if its covariance is stated: parameters with a tolerance
        of the geometry reproduce the resonances less exactly than they were measured.
        """
        exact_geometry = self.headline.get("exact_geometry")
        if isinstance(exact_geometry, dict) and isinstance(exact_geometry.get("parameters"), dict):
            return exact_geometry if "covariance" in exact_geometry else self.headline
        return self.headline

    def beam(self) -> UncertainDynamics:
        """Return the dynamics of the beam, with its ends and channels, and their uncertainty.

        Raises
        ------
        IdentifiedBeamError
            If a parameter is missing, not known or out of range.
        LinearModelError
            If the length or the covariance cannot be used.
        """
        values = parameter_values(self.headline_name, self._beam_part["parameters"])
        length_m = self.length_m
        if length_m is None:
            raise LinearModelError(
                f"{self.headline_name}: no file of the document states beam_length_m, or several "
                "state "
                f"different ones; {_ANALYZE_AGAIN_ADVICE}."
            )
        names, covariance = self.beam_covariance() or ((), np.zeros((0, 0)))
        for name in names:
            parameter_name = name.removeprefix(_LOGARITHM_PREFIX)
            if parameter_name not in values or (
                parameter_name != name and values[parameter_name] <= 0
            ):
                raise self._error("covariance.names", f"{name!r} has no such parameter")

        def all_values(parameters: Mapping[str, float]) -> Mapping[str, float]:
            """Return all parameter values, with logarithms converted."""
            return values | {
                name.removeprefix(_LOGARITHM_PREFIX): math.exp(min(value, 300.0))
                if name.startswith(_LOGARITHM_PREFIX)
                else value
                for name, value in parameters.items()
            }

        return UncertainDynamics(
            lambda parameters: beam_dynamics(
                _plant_of_parameters(all_values(parameters), length_m)
            ),
            names,
            np.array(
                [
                    math.log(values[name.removeprefix(_LOGARITHM_PREFIX)])
                    if name.startswith(_LOGARITHM_PREFIX)
                    else values[name]
                    for name in names
                ]
            ),
            covariance,
            lambda parameters: _is_possible_beam(all_values(parameters)),
        )

    def modes(self) -> UncertainDynamics:
        """Return the dynamics of the modal model in the band of the analysis, with uncertainty.

        Raises
        ------
        LinearModelError
            If there is no modal model, or it or its covariance cannot be used.
        """
        modal, band_hz = self.modal, self.band_hz
        if modal is None:
            raise LinearModelError(
                f"{self.headline_name} has no modal_model, as of an older version or of a "
                "campaign; "
                f"{_ANALYZE_AGAIN_ADVICE}, or export the beam's model with --beam."
            )
        count = len(modal.poles_rad_s)
        names, covariance = self.modal_covariance() or ((), np.zeros((0, 0)))
        values = [constant_value(modal, name) for name in names]
        known_values = [value for value in values if value is not None]
        if len(known_values) < len(names):
            raise self._error(
                "modal_model.names", f"{names[values.index(None)]!r} has no such constant"
            )
        nominal = dict(zip(names, known_values, strict=True))
        stated_modes = self.headline["modal_model"].get("modes")
        numbers_are_stated = isinstance(stated_modes, list) and len(stated_modes) == count
        numbers = stated_modes if numbers_are_stated else list(range(1, count + 1))

        def modal_model_of(parameters: Mapping[str, float]) -> ModalModel:
            """Return the modal model with given values of its constants."""
            return with_changed_constants(
                modal, {name: parameters[name] - nominal[name] for name in parameters}
            )

        return UncertainDynamics(
            lambda parameters: modal_dynamics(modal_model_of(parameters), band_hz, numbers),
            names,
            np.array(known_values),
            covariance,
            lambda parameters: all(
                pole.real < 0 < pole.imag for pole in modal_model_of(parameters).poles_rad_s
            ),
        )

    def _covariance(
        self, key: str, part: object, matrix_key: str
    ) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Read names and covariance matrix from a part of the headline, or return None."""
        names = part.get("names") if isinstance(part, dict) else None
        matrix = part.get(matrix_key) if isinstance(part, dict) else None
        if not isinstance(names, list) or not isinstance(matrix, list):
            return None
        try:
            covariance = np.array(matrix, dtype=np.float64).reshape(len(names), len(names))
        except (TypeError, ValueError, OverflowError) as error:
            raise self._error(f"{key}.{matrix_key}", "must be a square matrix") from error
        if len(set(map(str, names))) < len(names):
            raise self._error(f"{key}.names", "must be different from each other")
        scale = np.sqrt(np.abs(np.diag(covariance)))
        scaled_covariance = covariance / np.outer(scale + (scale == 0), scale + (scale == 0))
        if not np.isfinite(covariance).all() or (
            len(names)
            and np.linalg.eigvalsh((scaled_covariance + scaled_covariance.T) / 2).min() < -1e-6
        ):
            raise self._error(f"{key}.{matrix_key}", "must be positive semidefinite")
        return tuple(map(str, names)), (covariance + covariance.T) / 2

    def _error(self, key: str, what: str) -> LinearModelError:
        """Return the error that a key of the headline cannot be used."""
        return LinearModelError(f"{self.headline_name}.{key}: {what}; {_ANALYZE_AGAIN_ADVICE}.")


def identified_in_document(path: Path) -> IdentifiedModel:
    """Read the identified model from a document of ``analyze --json``.

    Parameters
    ----------
    path : Path
        Document in JSON.

    Raises
    ------
    IdentifiedBeamError
        If the document cannot be read or has no headline.
    LinearModelError
        If the document has several headlines and none for all sessions together.
    """
    document = read_document(path)
    headline_name, headline = select_headline(path, document)
    assert isinstance(document, dict)
    file = headline.get("file")
    if file is not None and len(document["headlines"]) > 1:
        raise LinearModelError(
            f"{path} has the results of {len(document['headlines'])} sessions and none of all "
            "together; analyze one of them, or several as a campaign."
        )

    def entries(key: str) -> list[dict[str, Any]]:
        """Return the entries of a list in the document that belong to the analysed file."""
        stated_list = document.get(key)
        dicts = (
            [each for each in stated_list if isinstance(each, dict)]
            if isinstance(stated_list, list)
            else []
        )
        return [each for each in dicts if file is None or each.get("file") == file]

    lengths = {finite_number(each.get("beam_length_m")) for each in entries("files")}
    (length_m,) = lengths if len(lengths) == 1 else (None,)
    bands = [each.get("band_hz") for each in entries("records")]
    return IdentifiedModel(
        path.name,
        headline_name,
        headline,
        length_m if length_m and length_m > 0 and is_usable_size(length_m) else None,
        _band_hz(bands[0] if bands else None),
    )


def identified_in_session(path: Path) -> IdentifiedModel:
    """Analyse a session, and return the identified model.

    Parameters
    ----------
    path : Path
        Session file.

    Raises
    ------
    rigd.session.SessionError, analysis.record.RecordError
        If the file cannot be read, or contains no record.
    analysis.identify.MeasurementError
        If the record cannot be used.
    """
    from analysis.record import load_record
    from analysis.results import finite, whole_record

    record = load_record(path)
    whole = whole_record(record)
    headline = finite(whole.headline_json())
    return IdentifiedModel(
        path.name, str(path), headline, record.beam.length_m, _band_hz(list(whole.band_hz))
    )


def _doubt_about(quantity: object) -> object:
    """Return why a reported quantity is doubtful, or an empty value if it is not."""
    return quantity.get("flag") if isinstance(quantity, dict) else None


def _band_hz(stated: object) -> tuple[float, float]:
    """Return a stated band, or the default band if the statement cannot be used."""
    if isinstance(stated, list) and len(stated) == 2:
        low_hz, high_hz = map(finite_number, stated)
        if (
            low_hz is not None
            and high_hz is not None
            and 0 <= low_hz < high_hz
            and high_hz > _MIN_FIRST_HZ
        ):
            return max(low_hz, _MIN_FIRST_HZ), high_hz
    return _DEFAULT_BAND_HZ


def _is_finite(value: complex) -> bool:
    """Return whether real and imaginary part of a number are finite."""
    return math.isfinite(value.real) and math.isfinite(value.imag)


def _is_possible_beam(values: Mapping[str, float]) -> bool:
    """Return whether sampled parameters describe a physically possible beam."""
    valid_orders = all(0 <= values[name] < 2 for name in _ORDER_NAMES if name in values)
    valid_signs = all(
        value >= 0 or name in _REASONS_TO_LEAVE_OUT or name.startswith(_SIGNED_PREFIXES)
        for name, value in values.items()
    )
    return valid_orders and valid_signs


def _plant_of_parameters(values: Mapping[str, float], length_m: float) -> Plant:
    """Return the rig with a beam of given parameters."""
    density_over_stiffness, stiffness = (
        values["density_over_stiffness"],
        values["bending_stiffness_n_m2"],
    )
    last_offset_mode = max(
        (
            int(each.removeprefix(_STIFFNESS_OFFSET_PREFIX))
            for each in values
            if each.startswith(_STIFFNESS_OFFSET_PREFIX)
        ),
        default=1,
    )
    if last_offset_mode > _MAX_OFFSET_MODE:
        raise LinearModelError(
            f"{_STIFFNESS_OFFSET_PREFIX}{last_offset_mode} is of a mode beyond the band; "
            f"{_ANALYZE_AGAIN_ADVICE}."
        )
    return Plant(
        beam=Beam(length_m, density_over_stiffness * stiffness, stiffness),
        damping=Damping(
            zeta=values.get("zeta", 0.0),
            alpha=values.get("alpha", 1.0),
            gamma=values.get("gamma", 0.0),
            lambda_=values.get("lambda", 1.0),
        ),
        stiffness_offsets=tuple(
            values.get(f"{_STIFFNESS_OFFSET_PREFIX}{mode}", 0.0)
            for mode in range(2, last_offset_mode + 1)
        ),
        **{
            name: values.get(name, 0.0)
            for name in (
                "delay_s",
                "tool_inertia_kg_m2",
                "root_compliance_rad_per_nm",
                "tip_mass_kg",
                "filter_time_constant_s",
                "second_order_filter_time_constant_s",
            )
        },
    )
