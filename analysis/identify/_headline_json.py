"""Headline numbers of a record or a campaign as the content of the JSON document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION

if TYPE_CHECKING:
    from collections.abc import Iterable

    from analysis.identify._finding import Finding
    from analysis.identify.headline import Estimates
    from rigd.session import Validity


class OrderResult(Protocol):
    """Result for one damping order, from one record or from a campaign."""

    @property
    def order(self) -> str:
        """Return the name of the damping order: "alpha" or "lambda"."""

    @property
    def status(self) -> str:
        """Return the status of the damping order, as in `OrderVerdict`."""

    @property
    def interval(self) -> tuple[float, float] | None:
        """Return the 95 % interval of the damping order; None if it is not determined."""


def headline_json(
    file: str | None,
    estimates: Estimates,
    orders: Iterable[OrderResult],
    findings: Iterable[Finding],
    validity: Validity,
) -> dict[str, Any]:
    """Return the headline numbers of a record or campaign as the content of the JSON document.

    Parameters
    ----------
    file : str or None
        Path of the session file; None for the estimate of a whole campaign.
    estimates : Estimates
        Headline numbers.
    orders : iterable of OrderResult
        Results for the damping orders.
    findings : iterable of Finding
        Effects in addition to the linear beam.
    validity : Validity
        How exact the linear model is for the record.

    Returns
    -------
    dict
        Numbers may be infinite or NaN.
    """
    uniform_beam = None if estimates.uniform_beam is None else estimates.uniform_beam.as_json()
    return {
        "file": file,
        "type": estimates.name,
        "validity": {**validity.as_json(), "uniform_beam": uniform_beam},
        "parameters": {
            quantity_name: quantity.as_json()
            for quantity_name, quantity in estimates.parameters.items()
        },
        "drag_speed_m_s": estimates.drag_speed_m_s,
        "sizes": [
            {
                "damping": quantity.damping,
                "omega_rad_s": quantity.omega_rad_s,
                **quantity.size.as_json(),
            }
            for quantity in estimates.sizes
        ],
        "modes": [quantity.as_json() for quantity in estimates.modes],
        "uniformity_percent": None
        if estimates.tolerant is None
        else 100 * estimates.tolerant.uniformity,
        "basis": None if estimates.tolerant is None else estimates.tolerant.basis,
        "covariance": None if estimates.tolerant is None else estimates.tolerant.covariance_json(),
        "modal_model": None if estimates.modal is None else estimates.modal.as_json(),
        "exact_geometry": None if estimates.exact is None else _exact_json(estimates.exact),
        "structures": [
            {"type": quantity_name, "status": structure_status}
            for quantity_name, structure_status in estimates.structures
        ],
        "orders": {
            quantity.order: {
                "status": quantity.status,
                "interval_95": None if quantity.interval is None else list(quantity.interval),
            }
            for quantity in orders
        },
        "conditional": None
        if estimates.simpler is None
        else {
            "type": estimates.simpler.name,
            "on": dict(estimates.simpler.fixed),
            "parameters": {
                n: quantity.as_json() for n, quantity in estimates.simpler.parameters.items()
            },
        },
        "named": [
            {
                "what": quantity.kind,
                "value": quantity.value,
                "interval_95": None if quantity.interval is None else list(quantity.interval),
                "sentence": quantity.sentence,
            }
            for quantity in findings
        ],
    }


def _exact_json(exact_estimates: Estimates) -> dict[str, Any]:
    """Return the estimates for a beam that is uniform to 1e-5, for the JSON document."""
    return {
        "condition": EXACTLY_UNIFORM_CONDITION,
        "parameters": {
            quantity_name: quantity.as_json()
            for quantity_name, quantity in exact_estimates.parameters.items()
        },
        "modes": [quantity.as_json() for quantity in exact_estimates.modes],
    }
