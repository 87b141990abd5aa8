"""Identified model of an analysis for linear models: from its document, or from a session."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify import BACKGROUND, ModalModel, Plant
from analysis.linear_model._dynamics import (
    LinearModelError,
    Uncertain,
    beam_dynamics,
    modal_dynamics,
)
from analysis.linear_model._modal_constants import changed, constant_value
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

_ANALYZE_AGAIN: Final = "analyze the session again"
_LOGARITHM: Final = "ln_"
_OFFSET: Final = "stiffness_offset_"
_LAST_OFFSET: Final = 50
_MOST_MODES: Final = 40
_NOT_LINEAR: Final = {
    "drag": "the drag of the air grows with the amplitude",
    "clock_rate_difference": "it is a property of the instruments",
}
"""Parameters that a linear model from motion to torque leaves out, and why. Clocks are a parameter
in documents of older versions only, as offsets of modes and the compliance of the clamp are."""
_SIGNED: Final = ("delay_s", _OFFSET)
_ORDERS: Final = ("alpha", "lambda")
_DEFAULT_BAND_HZ: Final = (0.05, 50.0)
_FIRST_HZ: Final = 0.05

PASSED: Final = "passed"


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedModel:
    """Models of one analysis.

    Attributes
    ----------
    source : str
        Name of the file that was analysed or read.
    where : str
        Name of the headline in messages.
    headline : mapping
        As ``headlines`` of the document has it.
    length_m : float or None
        Length of the beam; None if the document does not state one.
    band_hz : tuple of float
        Band of the analysis.
    """

    source: str
    where: str
    headline: Mapping[str, Any]
    length_m: float | None
    band_hz: tuple[float, float]

    @property
    def gate(self) -> tuple[str, float | None]:
        """Return the test of a uniform beam: status, and p-value if it was tested."""
        validity = self.headline.get("validity")
        gate = validity.get("uniform_beam") if isinstance(validity, dict) else None
        if not isinstance(gate, dict):
            return "not tested", None
        return str(gate.get("status", "not tested")), finite_number(gate.get("p_value"))

    @property
    def modal(self) -> ModalModel | None:
        """Return the modal model; None in documents of older versions."""
        content = self.headline.get("modal_model")
        if content is None:
            return None
        try:
            modal = ModalModel.from_json(content)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise self._error("modal_model", "is not a modal model") from error
        numbers = [*modal.poles_rad_s, *modal.residues, *modal.background]
        stable = all(pole.real < 0 < pole.imag for pole in modal.poles_rad_s)
        if len(modal.background) != BACKGROUND or not (
            len(modal.poles_rad_s) == len(modal.residues) <= _MOST_MODES
        ):
            raise self._error(
                "modal_model",
                f"must have up to {_MOST_MODES} poles, a residue for each of them, and "
                f"{BACKGROUND} coefficients of the background",
            )
        if not stable or not all(map(_is_finite, numbers)):
            raise self._error(
                "modal_model", "must have poles with negative real and positive imaginary parts"
            )
        return modal

    def modal_covariance(self) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Return names and covariance of the constants of the modal model; None: not stated."""
        return self._covariance("modal_model", self.headline.get("modal_model"), "covariance")

    def beam_covariance(self) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        """Return names and covariance of the parameters of the beam; None: not stated."""
        return self._covariance("covariance", self._beam_block.get("covariance"), "matrix")

    @property
    def beam_notes(self) -> tuple[str, ...]:
        """Return doubts about the beam's parameters, and effects that a linear model lacks."""
        parameters = self._beam_block["parameters"]
        flagged = [name for name, each in parameters.items() if _flag(each)]
        notes = [f"flagged by the analysis: {', '.join(flagged)}"] if flagged else []
        notes += [
            f"{name} is not part of the model: {why}"
            for name, why in _NOT_LINEAR.items()
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
        """Return the doubtful modes of the modal model."""
        listed = self.headline.get("modes")
        flagged = [
            str(each.get("mode"))
            for each in (listed if isinstance(listed, list) else [])
            if isinstance(each, dict)
            and each.get("source") == "modal"
            and any(_flag(each.get(key)) for key in ("frequency_hz", "damping_ratio"))
        ]
        return (f"flagged by the analysis: mode {', '.join(flagged)}",) if flagged else ()

    @property
    def _beam_block(self) -> Mapping[str, Any]:
        """Return parameters and covariance of the beam for the response.

        This is the beam with exact geometry, if its covariance is stated: parameters with a
        tolerance of the geometry reproduce the resonances less exactly than they were measured.
        """
        exact = self.headline.get("exact_geometry")
        if isinstance(exact, dict) and isinstance(exact.get("parameters"), dict):
            return exact if "covariance" in exact else self.headline
        return self.headline

    def beam(self) -> Uncertain:
        """Return the beam with its ends and channels.

        Raises
        ------
        IdentifiedBeamError
            If a parameter is missing, not known or out of range.
        LinearModelError
            If the length or the covariance cannot be used.
        """
        values = parameter_values(self.where, self._beam_block["parameters"])
        length_m = self.length_m
        if length_m is None:
            raise LinearModelError(
                f"{self.where}: no file of the document states beam_length_m, or several state "
                f"different ones; {_ANALYZE_AGAIN}."
            )
        names, covariance = self.beam_covariance() or ((), np.zeros((0, 0)))
        for name in names:
            plain = name.removeprefix(_LOGARITHM)
            if plain not in values or (plain != name and values[plain] <= 0):
                raise self._error("covariance.names", f"{name!r} has no such parameter")

        def at(parameters: Mapping[str, float]) -> Mapping[str, float]:
            return values | {
                name.removeprefix(_LOGARITHM): math.exp(min(value, 300.0))
                if name.startswith(_LOGARITHM)
                else value
                for name, value in parameters.items()
            }

        return Uncertain(
            lambda parameters: beam_dynamics(_plant(at(parameters), length_m)),
            names,
            np.array(
                [
                    math.log(values[name.removeprefix(_LOGARITHM)])
                    if name.startswith(_LOGARITHM)
                    else values[name]
                    for name in names
                ]
            ),
            covariance,
            lambda parameters: _allowed(at(parameters)),
        )

    def modes(self) -> Uncertain:
        """Return the modal model within the band of the analysis.

        Raises
        ------
        LinearModelError
            If there is none, or it or its covariance cannot be used.
        """
        modal, band_hz = self.modal, self.band_hz
        if modal is None:
            raise LinearModelError(
                f"{self.where} has no modal_model, as of an older version or of a campaign; "
                f"{_ANALYZE_AGAIN}, or export the beam's model with --beam."
            )
        count = len(modal.poles_rad_s)
        names, covariance = self.modal_covariance() or ((), np.zeros((0, 0)))
        values = [constant_value(modal, name) for name in names]
        known = [value for value in values if value is not None]
        if len(known) < len(names):
            raise self._error(
                "modal_model.names", f"{names[values.index(None)]!r} has no such constant"
            )
        nominal = dict(zip(names, known, strict=True))
        listed = self.headline["modal_model"].get("modes")
        stated = isinstance(listed, list) and len(listed) == count
        numbers = listed if stated else list(range(1, count + 1))

        def at(parameters: Mapping[str, float]) -> ModalModel:
            return changed(modal, {name: parameters[name] - nominal[name] for name in parameters})

        return Uncertain(
            lambda parameters: modal_dynamics(at(parameters), band_hz, numbers),
            names,
            np.array(known),
            covariance,
            lambda parameters: all(
                pole.real < 0 < pole.imag for pole in at(parameters).poles_rad_s
            ),
        )

    def _covariance(
        self, key: str, block: object, matrix_key: str
    ) -> tuple[tuple[str, ...], NDArray[np.float64]] | None:
        names = block.get("names") if isinstance(block, dict) else None
        matrix = block.get(matrix_key) if isinstance(block, dict) else None
        if not isinstance(names, list) or not isinstance(matrix, list):
            return None
        try:
            covariance = np.array(matrix, dtype=np.float64).reshape(len(names), len(names))
        except (TypeError, ValueError, OverflowError) as error:
            raise self._error(f"{key}.{matrix_key}", "must be a square matrix") from error
        if len(set(map(str, names))) < len(names):
            raise self._error(f"{key}.names", "must be different from each other")
        scale = np.sqrt(np.abs(np.diag(covariance)))
        scaled = covariance / np.outer(scale + (scale == 0), scale + (scale == 0))
        if not np.isfinite(covariance).all() or (
            len(names) and np.linalg.eigvalsh((scaled + scaled.T) / 2).min() < -1e-6
        ):
            raise self._error(f"{key}.{matrix_key}", "must be positive semidefinite")
        return tuple(map(str, names)), (covariance + covariance.T) / 2

    def _error(self, key: str, what: str) -> LinearModelError:
        return LinearModelError(f"{self.where}.{key}: {what}; {_ANALYZE_AGAIN}.")


def identified_in_document(path: Path) -> IdentifiedModel:
    """Read a document of ``analyze --json``.

    Parameters
    ----------
    path : Path

    Raises
    ------
    IdentifiedBeamError
        If it cannot be read or has no headline.
    LinearModelError
        If it has several and none of all sessions together.
    """
    document = read_document(path)
    where, headline = select_headline(path, document)
    assert isinstance(document, dict)
    file = headline.get("file")
    if file is not None and len(document["headlines"]) > 1:
        raise LinearModelError(
            f"{path} has the results of {len(document['headlines'])} sessions and none of all "
            "together; analyze one of them, or several as a campaign."
        )

    def entries(key: str) -> list[dict[str, Any]]:
        listed = document.get(key)
        found = (
            [each for each in listed if isinstance(each, dict)] if isinstance(listed, list) else []
        )
        return [each for each in found if file is None or each.get("file") == file]

    lengths = {finite_number(each.get("beam_length_m")) for each in entries("files")}
    (length_m,) = lengths if len(lengths) == 1 else (None,)
    bands = [each.get("band_hz") for each in entries("records")]
    return IdentifiedModel(
        path.name,
        where,
        headline,
        length_m if length_m and length_m > 0 and is_usable_size(length_m) else None,
        _band_hz(bands[0] if bands else None),
    )


def identified_in_session(path: Path) -> IdentifiedModel:
    """Analyse a session.

    Parameters
    ----------
    path : Path

    Raises
    ------
    rigd.session.SessionError, analysis.record.RecordError
        If the file cannot be read, or holds no record.
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


def _flag(quantity: object) -> object:
    """Return why a quantity is doubtful; an empty string if it is not."""
    return quantity.get("flag") if isinstance(quantity, dict) else None


def _band_hz(stated: object) -> tuple[float, float]:
    if isinstance(stated, list) and len(stated) == 2:
        low, high = map(finite_number, stated)
        if low is not None and high is not None and 0 <= low < high and high > _FIRST_HZ:
            return max(low, _FIRST_HZ), high
    return _DEFAULT_BAND_HZ


def _is_finite(value: complex) -> bool:
    return math.isfinite(value.real) and math.isfinite(value.imag)


def _allowed(values: Mapping[str, float]) -> bool:
    """Return whether sampled parameters describe a possible beam."""
    orders = all(0 <= values[name] < 2 for name in _ORDERS if name in values)
    signed = all(
        value >= 0 or name in _NOT_LINEAR or name.startswith(_SIGNED)
        for name, value in values.items()
    )
    return orders and signed


def _plant(values: Mapping[str, float], length_m: float) -> Plant:
    ratio, stiffness = values["density_over_stiffness"], values["bending_stiffness_n_m2"]
    last = max(
        (int(each.removeprefix(_OFFSET)) for each in values if each.startswith(_OFFSET)), default=1
    )
    if last > _LAST_OFFSET:
        raise LinearModelError(f"{_OFFSET}{last} is of a mode beyond the band; {_ANALYZE_AGAIN}.")
    return Plant(
        beam=Beam(length_m, ratio * stiffness, stiffness),
        damping=Damping(
            zeta=values.get("zeta", 0.0),
            alpha=values.get("alpha", 1.0),
            gamma=values.get("gamma", 0.0),
            lambda_=values.get("lambda", 1.0),
        ),
        stiffness_offsets=tuple(values.get(f"{_OFFSET}{mode}", 0.0) for mode in range(2, last + 1)),
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
