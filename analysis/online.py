"""Online fit: the estimate of a session that still runs, from the samples recorded so far.

`OnlineEstimator` receives samples and fits them on request, by the functions of `analyze`, so that
the last estimate of a session equals that of its file. The fit process of rigd uses it in a session
(docs/online_fit.md).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rigd.session import Session, SessionError, Validity, segments_until

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from analysis.identify import Finding, RecordAnalysis, RecordFit, Selection
    from analysis.identify.headline import Headline
    from analysis.identify.verdict import OrderVerdict
    from analysis.record import Record
    from rigd.beam import Plant

_NOISE_SPECTRUM_POINTS: Final = 40
"""Number of frequencies at which the noise spectrum is reported."""
_FINDINGS_WITHOUT_MODES: Final = frozenset(
    {"sign", "unit", "clipping", "stop", "hum", "sensor drift"}
)
"""Kinds of findings that do not depend on a fitted beam."""


@dataclass(frozen=True, slots=True)
class OnlineEstimate:
    """Estimate of a running session, from the samples up to a tick.

    Attributes
    ----------
    tick : int
        First tick whose sample was not used any more.
    duration_s : float
        Duration of the record used.
    whole : bool
        Whether every structure was tested, as in `analysis.select`. If not, only the freest
        structure was fitted, with the same tests of its residual.
    computing_time_s : float
        Computing time in seconds.
    headline : Headline or None
        Reported estimates with flags; None without a fit.
    orders : tuple of OrderVerdict
        Verdicts on alpha and lambda; empty unless `whole`.
    findings : tuple of Finding
        Effects in the record that the beam does not explain, and reasons to doubt the estimates.
    analysis : RecordAnalysis or None
        Fits with the noise spectrum; None without a fit.
    warnings : tuple of str
        Sentences on missing, stale and saturated samples.
    problem : str
        Reason why there is no fit; empty with a fit.
    validity : Validity
        Validity of the linear model for the record.
    linear_fit : RecordFit or None
        Linear fit, from which the next excitation is planned, if the reported fit includes air
        drag. Its damping is valid at the amplitude of the record. None without air drag.
    """

    tick: int
    duration_s: float
    whole: bool
    computing_time_s: float
    headline: Headline | None = None
    orders: tuple[OrderVerdict, ...] = ()
    findings: tuple[Finding, ...] = ()
    analysis: RecordAnalysis | None = None
    warnings: tuple[str, ...] = ()
    problem: str = ""
    validity: Validity = field(default_factory=Validity)
    linear_fit: RecordFit | None = None

    @property
    def doubt(self) -> str | None:
        """Reason to doubt all estimates, or None if at least one has no flag.

        If there is no fit, it is `problem`.
        """
        headline = self.headline
        if headline is None:
            return self.problem
        reported_values = [
            *headline.parameters.values(),
            *(
                reported_value
                for reported_mode in headline.modes
                for reported_value in (reported_mode.frequency_hz, reported_mode.damping_ratio)
            ),
        ]
        value_flags = [reported_value.flag for reported_value in reported_values]
        return None if None in value_flags else value_flags[0]

    @property
    def predictive_fit(self) -> RecordFit | None:
        """Fit from which the next excitation is planned; None without a fit.

        The fit has internal and external damping. Damping has order 1 if it is insignificant, or if
        its order is not identifiable, so that it might be a stiffness or an inertia.
        """
        from analysis.identify import ORDER_ONE_STRUCTURE
        from rigd.beam import COEFFICIENT_OF

        headline, analysis = self.headline, self.analysis
        if headline is None or analysis is None:
            return None
        if self.linear_fit is not None:
            return self.linear_fit
        fit = headline.with_both
        flagged_orders = {
            order_name for order_name in COEFFICIENT_OF if order_name in headline.flags
        }
        if not flagged_orders or fit is not headline.fit:
            return fit
        return next(
            (
                candidate
                for candidate in analysis.fits
                if candidate.structure is ORDER_ONE_STRUCTURE
            ),
            fit,
        )

    @property
    def plant(self) -> Plant | None:
        """Model of beam and rig from which the next excitation is planned; None without a fit.

        It is the plant of `predictive_fit`. If a uniform beam does not predict the modal constants,
        each mode has its own measured stiffness.
        """
        headline, fit = self.headline, self.predictive_fit
        if headline is None or fit is None:
            return None
        beam_test = headline.uniform_beam
        if headline.modal is None or beam_test is None or beam_test.status == "passed":
            return fit.plant
        return headline.modal.plant_with_modal_frequencies(fit.plant)

    def as_json(self) -> dict[str, Any]:
        """Return the estimate as a JSON document (docs/online_fit.md)."""
        from analysis.identify import headline_json
        from analysis.results import finite_json

        json_content: dict[str, Any] = {
            "tick": self.tick,
            "duration_s": self.duration_s,
            "whole": self.whole,
            "took_s": round(self.computing_time_s, 3),
            "problem": self.problem,
            "doubt": self.doubt,
            "warnings": self.warnings,
            "findings": [finding.sentence for finding in self.findings],
            "with_air_drag": any(finding.kind == "air drag" for finding in self.findings),
            "modes": [],
        }
        headline, fit, plant = self.headline, self.predictive_fit, self.plant
        if headline and fit and plant and self.analysis:
            json_content |= headline_json(None, headline, self.orders, self.findings, self.validity)
            json_content |= {
                "predicting": fit.structure.name,
                "plant": plant.as_dict(),
                "covariance": {"names": fit.determined, "matrix": fit.covariance.tolist()},
                "noise": _noise_spectrum(self.analysis),
            }
            del json_content["file"]
        return dict(finite_json(json_content))


def _noise_spectrum(analysis: RecordAnalysis) -> dict[str, Any]:
    """Return frequencies in Hz and the noise spectrum in (N·m)²/Hz there, as a JSON document."""
    import numpy as np

    frequency_hz = analysis.frequency_hz
    points_hz = np.geomspace(frequency_hz[0], frequency_hz[-1], _NOISE_SPECTRUM_POINTS)
    noise_levels = np.exp(np.interp(points_hz, frequency_hz, np.log(analysis.noise_nm2_per_hz)))
    return {"frequency_hz": points_hz.tolist(), "nm2_per_hz": noise_levels.tolist()}


class OnlineEstimator:
    """Estimator that fits the recorded part of a running session.

    Parameters
    ----------
    metadata : mapping of str to str
        Metadata ``session`` of its file (docs/session_format.md): rate, beam, delays.
    segments : mapping of str to (int, int), optional
        First tick and end (exclusive) of the planned segments, by name.
    name : str
        Name of the session in messages.

    Examples
    --------
    >>> from analysis.online import OnlineEstimator
    >>> from rigd.session import read_session
    >>> session = read_session("session.mcap")
    >>> fit = OnlineEstimator(session.metadata, session.segments)
    >>> fit.feed(session.samples)
    >>> for tick in (400, 10_000):
    ...     estimate = fit.estimate(tick)
    ...     print(estimate.problem or estimate.headline.modes[0].shown)
    Nothing is excited yet.
    True
    """

    def __init__(
        self,
        metadata: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]] | None = None,
        name: str = "session",
    ) -> None:
        self._metadata = dict(metadata)
        self._segments = dict(segments or {})
        self._path = Path(name)
        self._blocks: list[NDArray[np.void]] = []
        self._sample_count = 0
        self._last_selection: Selection | None = None

    def feed(self, new_samples: NDArray[np.void]) -> None:
        """Append the next recorded samples of the running session.

        Parameters
        ----------
        new_samples : ndarray of `rigd.session.layout.SAMPLE_DTYPE`, shape (n,)
            Samples in the order of their ticks.
        """
        from analysis.record import MAX_SAMPLES, RECORD_FIELDS

        if self._sample_count <= MAX_SAMPLES:  # with more samples, `record` raises an error
            record_fields = new_samples[list(RECORD_FIELDS)]
            self._blocks.append(
                record_fields.astype(
                    [(field_name, record_fields.dtype[field_name]) for field_name in RECORD_FIELDS]
                )
            )
            self._sample_count += len(new_samples)

    def record(self, up_to_tick: int | None = None) -> Record:
        """Return the record of the samples so far, as `analysis.load` returns it for a file.

        Parameters
        ----------
        up_to_tick : int, optional
            Samples from this tick on are excluded.

        Raises
        ------
        SessionError, RecordError
            There are no samples, or they cannot be analysed.
        """
        import numpy as np

        from analysis.record import RecordError, record_of

        if len(self._blocks) > 1:
            self._blocks = [np.concatenate(self._blocks)]
        past_samples = self._blocks[0] if self._blocks else np.zeros(0, [("tick", "<u4")])
        if up_to_tick is not None:
            past_samples = past_samples[: np.searchsorted(past_samples["tick"], max(up_to_tick, 0))]
        end_tick = int(past_samples["tick"][-1]) + 1 if len(past_samples) else 0
        # Segments after the last sample are still to come, and do not count as cut short.
        past_segments = segments_until(self._segments, end_tick)
        if not end_tick or ("sweep" in self._segments and "sweep" not in past_segments):
            raise RecordError("Nothing is excited yet.")
        return record_of(
            Session(
                path=self._path,
                samples=past_samples,
                start_utc_ns=0,
                metadata=self._metadata,
                segments=past_segments,
                outcome=None,
                events=[],
                attachments={},
            )
        )

    def estimate(
        self, up_to_tick: int | None = None, *, whole: bool = False, from_last: bool = False
    ) -> OnlineEstimate:
        """Return the estimate from the samples recorded so far.

        Parameters
        ----------
        up_to_tick : int, optional
            Samples from this tick on are excluded.
        whole : bool
            Whether every structure is tested, as in `analysis.select`, which takes four times as
            long.
        from_last : bool
            Whether an estimate with `whole` may start from the last one, if the last one explains
            the new samples. This takes a third of the time, but may miss one of several minima.

        Returns
        -------
        OnlineEstimate
            Estimate, or the reason why no fit is possible.
        """
        from analysis.applicability import record_band_hz
        from analysis.identify import (
            ORDER_ONE_STRUCTURE,
            Measurement,
            MeasurementError,
            fit_freest_alone,
            select,
        )
        from analysis.record import RecordError
        from analysis.results import whole_record
        from analysis.validity import record_validity

        started_s = time.monotonic()
        end_tick, duration_s = up_to_tick or 0, 0.0
        try:
            record = self.record(up_to_tick)
            end_tick = round((record.time_s[-1]) * record.rate_hz) + 1
            duration_s = record.time_s.size / record.rate_hz
            measurement, band_hz = Measurement.from_record(record), record_band_hz(record)
            order_verdicts: tuple[OrderVerdict, ...] = ()
            linear_fit = None
            if whole:
                if from_last:
                    selection = select(measurement, band_hz=band_hz, earlier=self._last_selection)
                else:
                    # The user's cache keeps it for the quick look and reports of the session.
                    selection = whole_record(record).selection
                self._last_selection = selection
                headline, analysis = selection.headline, selection.analysis
                findings = selection.verdict.findings
                order_verdicts = (selection.verdict.alpha, selection.verdict.lambda_)
                if any(finding.kind == "air drag" for finding in findings):
                    # A record that contradicts its file has only one candidate.
                    linear_fit = next(
                        (
                            candidate.fit
                            for candidate in selection.linear_candidates
                            if candidate.structure is ORDER_ONE_STRUCTURE
                        ),
                        None,
                    )
            else:
                headline, findings, analysis = fit_freest_alone(measurement, band_hz)
        except (SessionError, RecordError, ArithmeticError, ValueError) as error:
            # A running session receives the reason and continues, as later samples may suffice.
            is_expected = isinstance(error, SessionError | RecordError | MeasurementError)
            problem_text = f"The record so far cannot be fitted ({error!r})."
            problem_text = (
                str(error).removeprefix(f"{self._path}: ") if is_expected else problem_text
            )
            computing_time_s = time.monotonic() - started_s
            return OnlineEstimate(
                end_tick, duration_s, whole, computing_time_s, problem=problem_text
            )
        has_modes = bool(headline.visible_modes)
        plant = headline.fit.plant
        return OnlineEstimate(
            tick=end_tick,
            duration_s=duration_s,
            whole=whole,
            computing_time_s=time.monotonic() - started_s,
            headline=headline if has_modes else None,
            orders=order_verdicts if has_modes else (),
            findings=findings
            if has_modes
            else tuple(finding for finding in findings if finding.kind in _FINDINGS_WITHOUT_MODES),
            analysis=analysis if has_modes else None,
            warnings=record.warnings,
            problem="" if has_modes else "No mode has been excited enough yet.",
            linear_fit=linear_fit if has_modes else None,
            validity=record_validity(record.metadata, record.angle_rad, record.rate_hz, plant),
        )
