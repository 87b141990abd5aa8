"""Identified model to be exported as a linear model: from a document, or from a session file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify import BACKGROUND_COEFFICIENTS, ModalModel
from analysis.linear_model._dynamics import (
    LinearModelError,
    UncertainDynamics,
    beam_dynamics,
    modal_dynamics,
)
from analysis.linear_model._modal_constants import constant_value, with_changed_constants
from rigd.beam import OFFSET_PREFIX, Plant, parameter_named
from rigd.estimates import Estimate, modes_from_json
from rigd.identified_beam import (
    findings_without_parameter,
    parameter_estimates,
    read_document,
    select_headline,
    uniform_beam_test,
)
from rigd.session import BeamUniformity
from rigd.units import finite_number, is_usable_size

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

_ANALYZE_AGAIN_ADVICE: Final = "analyze the session again"
"""Advice at the end of error messages on documents."""

_LOGARITHM_PREFIX: Final = "ln_"
"""Prefix of a parameter's name in a covariance if this is the covariance of its logarithm."""

_MAX_OFFSET_MODE_NUMBER: Final = 50
"""Largest number of a mode for which a document may state a stiffness offset."""

_MAX_MODES: Final = 40
"""Largest number of modes in a modal model."""

_OMISSION_REASONS_BY_PARAMETER: Final = {
    "drag": "the drag of the air grows with the amplitude",
    "clock_rate_difference": "it is a property of the instruments",
}
"""Parameters that a linear model from motion to torque leaves out, and why. Only documents of older
versions have the clock rate difference as a parameter, as well as offsets of modes and the
compliance of the clamp."""
_DEFAULT_BAND_HZ: Final = (0.05, 50.0)
"""Band in hertz of an analysis whose document does not state the band."""

_MIN_BAND_START_HZ: Final = 0.05
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
    def uniform_beam_test(self) -> BeamUniformity:
        """Return the result of the test whether a uniform beam predicts the modes."""
        return uniform_beam_test(self.headline_name, self.headline)

    @property
    def modal(self) -> ModalModel | None:
        """Return the modal model of the analysis. It is None in documents of older versions."""
        model_entry = self.headline.get("modal_model")
        if model_entry is None:
            return None
        try:
            modal_model = ModalModel.from_json(model_entry)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise self._headline_error("modal_model", "is not a modal model") from error
        modal_numbers = [*modal_model.poles_rad_s, *modal_model.residues, *modal_model.background]
        is_stable = all(pole.real < 0 < pole.imag for pole in modal_model.poles_rad_s)
        if len(modal_model.background) != BACKGROUND_COEFFICIENTS or not (
            len(modal_model.poles_rad_s) == len(modal_model.residues) <= _MAX_MODES
        ):
            raise self._headline_error(
                "modal_model",
                f"must have up to {_MAX_MODES} poles, a residue for each of them, and "
                f"{BACKGROUND_COEFFICIENTS} coefficients of the background",
            )
        if not is_stable or not all(map(_is_finite, modal_numbers)):
            raise self._headline_error(
                "modal_model", "must have poles with negative real and positive imaginary parts"
            )
        return modal_model

    def modal_covariance(self) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Return names and covariance of the modal constants, or None if they are not stated."""
        return self._covariance("modal_model", self.headline.get("modal_model"), "covariance")

    def beam_covariance(self) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Return names and covariance of the beam parameters, or None if they are not stated."""
        return self._covariance("covariance", self._beam_part.get("covariance"), "matrix")

    @property
    def beam_notes(self) -> tuple[str, ...]:
        """Return doubts about the beam parameters, and effects that a linear model leaves out."""
        estimates = parameter_estimates(self.headline_name, self._beam_part["parameters"])
        flagged_names = [name for name, estimate in estimates.items() if estimate.flag]
        note_texts = (
            [f"flagged by the analysis: {', '.join(flagged_names)}"] if flagged_names else []
        )
        return (*note_texts, *self._omitted_effects(estimates))

    @property
    def modal_notes(self) -> tuple[str, ...]:
        """Return a note on doubtful modes of the modal model, and effects that it leaves out."""
        flagged_modes = [
            str(mode.number)
            for mode in modes_from_json(self.headline.get("modes"))
            if mode.source == "modal" and mode.flag
        ]
        note_texts = (
            [f"flagged by the analysis: mode {', '.join(flagged_modes)}"] if flagged_modes else []
        )
        estimates = {
            name: estimate
            for name, parameter_document in self.headline["parameters"].items()
            if (estimate := Estimate.from_json(parameter_document)) is not None
        }
        return (*note_texts, *self._omitted_effects(estimates))

    def _omitted_effects(self, estimates: Mapping[str, Estimate]) -> Iterator[str]:
        """Yield a note on each effect that the analysis found and no linear model contains."""
        for parameter_name, omission_reason in _OMISSION_REASONS_BY_PARAMETER.items():
            if parameter_name in estimates and estimates[parameter_name].value:
                yield f"{parameter_name} is not part of the model: {omission_reason}"
        for _, effect_kind, effect_sentence in findings_without_parameter(self.headline):
            yield f"not part of the model: {effect_kind} ({effect_sentence.removesuffix('.')})"

    @property
    def _beam_part(self) -> Mapping[str, Any]:
        """Return the section of the reported numbers with the parameters of the exported beam.

        It is the section of the exactly uniform beam, if that states a covariance: parameters of an
        uneven beam reproduce the resonances less exactly than these were measured.
        """
        exact_geometry = self.headline.get("exact_geometry")
        if isinstance(exact_geometry, dict) and isinstance(exact_geometry.get("parameters"), dict):
            return exact_geometry if "covariance" in exact_geometry else self.headline
        return self.headline

    def beam(self) -> UncertainDynamics:
        """Return the dynamics of the fitted beam, and the covariance of its parameters.

        Raise `IdentifiedBeamError` if a parameter is missing, not known or out of range. Raise
        `LinearModelError` if the length or the covariance cannot be used.
        """
        estimates = parameter_estimates(self.headline_name, self._beam_part["parameters"])
        beam_values = {name: estimate.value for name, estimate in estimates.items()}
        length_m = self.length_m
        if length_m is None:
            raise LinearModelError(
                f"{self.headline_name}: no file of the document states beam_length_m, or several "
                f"state different ones; {_ANALYZE_AGAIN_ADVICE}."
            )
        determined_names, covariance = self.beam_covariance() or ((), np.zeros((0, 0)))
        for key_name in determined_names:
            parameter_name = key_name.removeprefix(_LOGARITHM_PREFIX)
            if parameter_name not in beam_values or (
                parameter_name != key_name and beam_values[parameter_name] <= 0
            ):
                raise self._headline_error(
                    "covariance.names", f"{key_name!r} has no such parameter"
                )

        def complete_beam_values(determined_values: Mapping[str, float]) -> Mapping[str, float]:
            """Return all beam parameters by name, some of them replaced by `determined_values`.

            A value whose name begins with "ln_" is a logarithm, and is converted.
            """
            return beam_values | {
                key_name.removeprefix(_LOGARITHM_PREFIX): math.exp(min(parameter_value, 300.0))
                if key_name.startswith(_LOGARITHM_PREFIX)
                else parameter_value
                for key_name, parameter_value in determined_values.items()
            }

        return UncertainDynamics(
            lambda parameters: beam_dynamics(
                _plant_of_parameters(complete_beam_values(parameters), length_m)
            ),
            determined_names,
            np.array(
                [
                    math.log(beam_values[key_name.removeprefix(_LOGARITHM_PREFIX)])
                    if key_name.startswith(_LOGARITHM_PREFIX)
                    else beam_values[key_name]
                    for key_name in determined_names
                ]
            ),
            covariance,
            lambda parameters: _is_possible_beam(complete_beam_values(parameters)),
        )

    def modes(self) -> UncertainDynamics:
        """Return the dynamics of the modal model, and the covariance of its constants.

        They are valid in the band of the analysis only. Raise `LinearModelError` if there is no
        modal model, or it or its covariance cannot be used.
        """
        modal_fit, band_hz = self.modal, self.band_hz
        if modal_fit is None:
            raise LinearModelError(
                f"{self.headline_name} has no modal_model, as of an older version or of a "
                f"campaign; {_ANALYZE_AGAIN_ADVICE}, or export the beam's model with --beam."
            )
        mode_count = len(modal_fit.poles_rad_s)
        constant_names, covariance = self.modal_covariance() or ((), np.zeros((0, 0)))
        constant_values = [
            constant_value(modal_fit, constant_name) for constant_name in constant_names
        ]
        known_constant_values = [
            nominal_value for nominal_value in constant_values if nominal_value is not None
        ]
        if len(known_constant_values) < len(constant_names):
            raise self._headline_error(
                "modal_model.names",
                f"{constant_names[constant_values.index(None)]!r} has no such constant",
            )
        nominal_constants = dict(zip(constant_names, known_constant_values, strict=True))
        stated_mode_numbers = self.headline["modal_model"].get("modes")
        numbers_are_stated = (
            isinstance(stated_mode_numbers, list) and len(stated_mode_numbers) == mode_count
        )
        mode_numbers = stated_mode_numbers if numbers_are_stated else list(range(1, mode_count + 1))

        def modal_model_of(sampled_constants: Mapping[str, float]) -> ModalModel:
            """Return the modal model with given values of its modal constants, by name."""
            return with_changed_constants(
                modal_fit,
                {
                    changed_name: sampled_constants[changed_name] - nominal_constants[changed_name]
                    for changed_name in sampled_constants
                },
            )

        return UncertainDynamics(
            lambda parameters: modal_dynamics(modal_model_of(parameters), band_hz, mode_numbers),
            constant_names,
            np.array(known_constant_values),
            covariance,
            lambda parameters: all(
                pole.real < 0 < pole.imag for pole in modal_model_of(parameters).poles_rad_s
            ),
        )

    def _covariance(
        self, entry_key: str, headline_entry: object, matrix_key: str
    ) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Read parameter names and covariance matrix from an entry of the reported numbers.

        Return None if they are not stated. Raise `LinearModelError` if they cannot be used.
        """
        stated_names = headline_entry.get("names") if isinstance(headline_entry, dict) else None
        stated_matrix = headline_entry.get(matrix_key) if isinstance(headline_entry, dict) else None
        if not isinstance(stated_names, list) or not isinstance(stated_matrix, list):
            return None
        try:
            covariance = np.array(stated_matrix, dtype=np.float64).reshape(
                len(stated_names), len(stated_names)
            )
        except (TypeError, ValueError, OverflowError) as error:
            raise self._headline_error(
                f"{entry_key}.{matrix_key}", "must be a square matrix"
            ) from error
        if len(set(map(str, stated_names))) < len(stated_names):
            raise self._headline_error(f"{entry_key}.names", "must be different from each other")
        parameter_stds = np.sqrt(np.abs(np.diag(covariance)))
        scaled_covariance = covariance / np.outer(
            parameter_stds + (parameter_stds == 0), parameter_stds + (parameter_stds == 0)
        )
        if not np.isfinite(covariance).all() or (
            len(stated_names)
            and np.linalg.eigvalsh((scaled_covariance + scaled_covariance.T) / 2).min() < -1e-6
        ):
            raise self._headline_error(f"{entry_key}.{matrix_key}", "must be positive semidefinite")
        return tuple(map(str, stated_names)), (covariance + covariance.T) / 2

    def _headline_error(self, headline_key: str, entry_problem: str) -> LinearModelError:
        """Return the exception that states why a key of the reported numbers cannot be used."""
        return LinearModelError(
            f"{self.headline_name}.{headline_key}: {entry_problem}; {_ANALYZE_AGAIN_ADVICE}."
        )


def read_identified_model(path: Path | str) -> IdentifiedModel:
    """Read the identified model from a document of ``analyze --json``.

    Parameters
    ----------
    path : Path or str
        Document in JSON.

    Raises
    ------
    IdentifiedBeamError
        If the document cannot be read or has no headline.
    LinearModelError
        If the document has several headlines and none for all sessions together.
    """
    path = Path(path)
    document = read_document(path)
    headline_name, headline = select_headline(path, document)
    assert isinstance(document, dict)
    file_name = headline.get("file")
    if file_name is not None and len(document["headlines"]) > 1:
        raise LinearModelError(
            f"{path} has the results of {len(document['headlines'])} sessions and none of all "
            "together; analyze one of them, or several as a campaign."
        )

    def list_entries(list_key: str) -> list[dict[str, Any]]:
        """Return the entries of a list in the document that belong to the file of the headline."""
        stated_list = document.get(list_key)
        entry_dicts = (
            [document_entry for document_entry in stated_list if isinstance(document_entry, dict)]
            if isinstance(stated_list, list)
            else []
        )
        return [
            document_entry
            for document_entry in entry_dicts
            if file_name is None or document_entry.get("file") == file_name
        ]

    lengths_m = {
        finite_number(document_entry.get("beam_length_m"))
        for document_entry in list_entries("files")
    }
    (length_m,) = lengths_m if len(lengths_m) == 1 else (None,)
    # A campaign, which lists no records, states the band of all sessions among its settings.
    campaign_settings = document.get("settings")
    stated_bands = [document_entry.get("band_hz") for document_entry in list_entries("records")] + (
        [campaign_settings.get("record_band_hz")] if isinstance(campaign_settings, dict) else []
    )
    return IdentifiedModel(
        path.name,
        headline_name,
        headline,
        length_m if length_m and length_m > 0 and is_usable_size(length_m) else None,
        _usable_band_hz(stated_bands[0] if stated_bands else None),
    )


def identify_session(path: Path | str) -> IdentifiedModel:
    """Analyse the record of a session, and return the identified model.

    Parameters
    ----------
    path : Path or str
        Session file.

    Raises
    ------
    rigd.session.SessionError, analysis.record.RecordError
        If the file cannot be read, or contains no record.
    analysis.identify.MeasurementError
        If the record cannot be used.
    """
    from analysis.record import load_record
    from analysis.results import finite_json, whole_record

    path = Path(path)
    record = load_record(path)
    record_analysis = whole_record(record)
    headline_json = finite_json(record_analysis.headline_json())
    return IdentifiedModel(
        path.name,
        str(path),
        headline_json,
        record.beam.length_m,
        _usable_band_hz(list(record_analysis.band_hz)),
    )


def _usable_band_hz(stated_band: object) -> tuple[float, float]:
    """Return the first and last frequency of a stated band, in hertz.

    Return the default band if the stated one cannot be used.
    """
    if isinstance(stated_band, list) and len(stated_band) == 2:
        low_hz, high_hz = map(finite_number, stated_band)
        if (
            low_hz is not None
            and high_hz is not None
            and 0 <= low_hz < high_hz
            and high_hz > _MIN_BAND_START_HZ
        ):
            return max(low_hz, _MIN_BAND_START_HZ), high_hz
    return _DEFAULT_BAND_HZ


def _is_finite(complex_number: complex) -> bool:
    """Return whether real and imaginary part of a number are finite."""
    return math.isfinite(complex_number.real) and math.isfinite(complex_number.imag)


def _is_possible_beam(sampled_values: Mapping[str, float]) -> bool:
    """Return whether sampled parameters describe a physically possible beam."""
    return all(
        parameter_name in _OMISSION_REASONS_BY_PARAMETER
        or parameter_named(parameter_name).is_valid(parameter_value)
        for parameter_name, parameter_value in sampled_values.items()
    )


def _plant_of_parameters(beam_values: Mapping[str, float], length_m: float) -> Plant:
    """Return the plant whose beam has the given parameters, by name, and length in metres."""
    last_offset_mode = max(
        (
            int(key_name.removeprefix(OFFSET_PREFIX))
            for key_name in beam_values
            if key_name.startswith(OFFSET_PREFIX)
        ),
        default=1,
    )
    if last_offset_mode > _MAX_OFFSET_MODE_NUMBER:
        raise LinearModelError(
            f"{OFFSET_PREFIX}{last_offset_mode} is of a mode beyond the band; "
            f"{_ANALYZE_AGAIN_ADVICE}."
        )
    plant_values = {
        parameter_name: parameter_value
        for parameter_name, parameter_value in beam_values.items()
        if parameter_name not in _OMISSION_REASONS_BY_PARAMETER
    }
    try:
        return Plant.from_parameters(length_m, plant_values)
    except ValueError:
        raise LinearModelError(
            "The model has a tip mass and modes of their own stiffness, which together are not "
            "defined; export the modal model, without --beam."
        ) from None
