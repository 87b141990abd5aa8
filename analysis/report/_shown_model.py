"""Model that a report of a record shows: the modal model, or the beam if no mode is visible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from analysis.identify import ModeEstimate, RecordAnalysis
from analysis.report.bands import modal_response_band, response_band

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from analysis.identify import ModalFit, ModalModel, RecordFit
    from analysis.identify.headline import Headline
    from analysis.record import Record
    from analysis.report.bands import ResponseBand
    from rigd.beam import Plant

    # Array of real numbers.
    RealArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ShownModel:
    """Model of a record that figures and curves show: the modal model or the beam.

    Attributes
    ----------
    name : str
        Name of the model in captions.
    modal : ModalFit or None
        Modal model; None if no mode is visible.
    beam_fit : RecordFit
        Fit of the beam, which is shown if there is no modal model.
    modes : tuple of ModeEstimate
        Modes that are visible in the record.
    stated_delay_s : float
        Delay of the torque channel minus that of the angle channel, as the file states them.
    """

    name: str
    modal: ModalFit | None
    beam_fit: RecordFit
    modes: tuple[ModeEstimate, ...]
    stated_delay_s: float

    @classmethod
    def from_headline(cls, headline: Headline, record: Record) -> ShownModel:
        """Return the model that the report of a record shows.

        Parameters
        ----------
        headline : Headline
            Reported estimates of the record.
        record : Record
            Record with the delays that its file states.
        """
        return cls(
            name=f"the model (type {headline.name})"
            if headline.modal is None
            else "the modal model",
            modal=headline.modal,
            beam_fit=headline.fit,
            modes=shown_modes(headline),
            stated_delay_s=record.torque_delay_s - record.angle_delay_s,
        )

    @property
    def transfer_function(self) -> Plant | ModalModel:
        """Transfer function from angle to torque: the modal model, or the beam's plant."""
        return self.beam_fit.plant if self.modal is None else self.modal.model

    @property
    def residual(self) -> NDArray[np.complex128]:
        """Whitened residual of the displayed model, shape (K,)."""
        return self.beam_fit.residual if self.modal is None else self.modal.residual

    @property
    def delay_s(self) -> float:
        """Delay of the torque channel in s, which is removed from the displayed response.

        For a beam model it was fitted, for a modal model it is the one that the file states.
        """
        return self.beam_fit.parameters["delay_s"] if self.modal is None else self.stated_delay_s

    def band(self, frequency_hz: RealArray) -> ResponseBand:
        """Return the model's response without the delay, with its 95 % band.

        Parameters
        ----------
        frequency_hz : ndarray, shape (n,)
            Frequencies, positive.
        """
        if self.modal is None:
            return response_band(self.beam_fit, frequency_hz)
        return modal_response_band(self.modal, frequency_hz, self.delay_s)

    def analysis_of_residual(self, analysis: RecordAnalysis) -> RecordAnalysis:
        """Return a record's analysis in which noise and bins are those of this model's residual.

        Parameters
        ----------
        analysis : RecordAnalysis
            Analysis of the record.
        """
        if self.modal is None:
            return analysis
        return RecordAnalysis.from_fits(analysis.fits, self.modal.noise, analysis.comparison)

    def fit_percent(self, analysis: RecordAnalysis) -> float:
        """Return how well the model reproduces the measured torque in the band (100 % = exact).

        Parameters
        ----------
        analysis : RecordAnalysis
            Analysis of the record.
        """
        fit = self.beam_fit if self.modal is None else self.modal
        return self.analysis_of_residual(analysis).fit_percent(fit)


def shown_modes(headline: Headline) -> tuple[ModeEstimate, ...]:
    """Return the reported modes that are visible in the record, each with its uncertainties."""
    return tuple(
        ModeEstimate(
            number=mode.number,
            frequency_hz=mode.frequency_hz.value,
            frequency_std_hz=mode.frequency_hz.std or 0.0,
            damping_ratio=mode.damping_ratio.value,
            damping_ratio_std=mode.damping_ratio.std or 0.0,
        )
        for mode in headline.modes
        if mode.shown
    )
