"""Welch-aware fits to the record of a session file, to compare with the other methods on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.models import STRUCTURES
from analysis.paper import SettingsError, estimate, moving_reference_rad
from analysis.welch_aware.fit import fit_welch_aware

if TYPE_CHECKING:
    from collections.abc import Iterable

    from analysis.identify import Setting
    from analysis.models import WelchSettings
    from analysis.record import Record
    from analysis.welch_aware.result import WelchAwareFit


def fit_record_welch_aware(
    record: Record,
    settings: WelchSettings,
    *,
    fixed: Iterable[Setting] = (),
    uniform: bool = True,
) -> tuple[WelchAwareFit, ...]:
    """Estimate the frequency response of a record and fit the settings' types through it.

    Parameters
    ----------
    record : Record
    settings : WelchSettings
        Of the estimate, with H1 or Hiv; every type with every weighting is fitted.
    fixed, uniform
        As `fit_welch_aware` takes them. The delays that the file states are taken out of the
        response: what is found is what they leave.

    Returns
    -------
    tuple of WelchAwareFit
        By type, then by weighting, in the order of the settings.

    Raises
    ------
    EstimateError
        The estimate cannot be made, or is neither of these.
    WelchAwareError
        It cannot be used.
    """
    if settings.estimator not in ("h1", "iv"):
        raise SettingsError(
            f"A Welch-aware fit knows what H1 and Hiv do to a response, not "
            f"{settings.estimator!r}; choose --frf h1 or iv."
        )
    response, _ = estimate(record, settings)
    origin_rad = record.angle_rad[0] if record.rest_angle_rad is None else record.rest_angle_rad
    reference = moving_reference_rad(record) if settings.estimator == "iv" else None
    fixed = tuple(fixed)
    of_weightings = [
        fit_welch_aware(
            record.angle_rad - origin_rad,
            record.rate_hz,
            response.frequency_hz,
            response.response,
            settings.segmentation(record.rate_hz),
            record.beam,
            [STRUCTURES[name] for name in settings.types],
            weighting,
            fixed=fixed,
            tool_inertia_kg_m2=record.tool_inertia_kg_m2,
            estimated_from=record.sweep,
            uniform=uniform,
            reference_rad=reference,
        )
        for weighting in settings.weightings
    ]
    return tuple(fit for of_type in zip(*of_weightings, strict=True) for fit in of_type)
