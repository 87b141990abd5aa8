"""Shift of the parameters of a uniform beam, fitted to the modes of a rig with a defect.

The true modal constants of a rig (logarithms of frequency and damping ratio, logarithm and phase of
the residue) are fitted by those of Eq. 25, weighted by the analyzer's standard deviations of the
modes, without noise. The shift is the largest difference between a fitted parameter and the true
one, over the standard deviation of the parameter by the same weights. A tolerance of the geometry,
as in headlines, is added to the standard deviation of each logarithm of a frequency, and three
times of it to that of each logarithm of a residue.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from defect_records import DENSITY_KG_PER_M, STIFFNESS_N_M2
from independent_records import Real, Truth

_FITTED = (
    "zeta", "alpha", "gamma", "lambda", "density_over_stiffness", "bending_stiffness_n_m2",
    "delay_s",
)  # fmt: skip
_ADDITIVE = frozenset({"alpha", "lambda", "delay_s"})
_SCALES = np.array([0.1, 0.05, 0.1, 0.05, 1e-3, 1e-2, 1e-4])
"""Steps of the derivatives times 100: of a logarithm, except for additive parameters."""
_ITERATIONS = 40


def headline_shift(
    truth: dict[str, Any], headline: dict[str, Any], uniformity: float
) -> float | None:
    """Return the largest shift of a parameter in standard deviations.

    Parameters
    ----------
    truth : dict
        Document of `DefectRecord.truth`.
    headline : dict
        Document of the analyzer, for the standard deviations of its modes.
    uniformity : float
        Tolerance of the geometry; 0: exact geometry.

    Returns
    -------
    float or None
        Infinite if no uniform beam has such modes; None if the rig is not linear and constant, or
        if fewer than two modes have standard deviations.
    """
    if not truth["linear_constant"]:
        return None
    modes, weights = [], []
    for mode in truth["modes"]:
        stds = _relative_stds(mode, headline)
        if mode["visible"] and stds is not None:
            modes.append(mode)
            frequency, loss = math.hypot(stds[0], uniformity), stds[1]
            weights.append(
                [1 / frequency, 1 / loss, 1 / math.hypot(loss, 3 * uniformity), 1 / loss]
            )
    if len(modes) < 2:
        return None
    measured = np.array([_constants(_frequency(m), m["damping_ratio"], _residue(m)) for m in modes])
    numbers = [mode["mode"] for mode in modes]
    weight = np.array(weights)
    known = {name: truth["parameters"].get(name) for name in _FITTED}
    start = {
        "zeta": 7e-5, "alpha": 0.95, "gamma": 0.03, "lambda": 0.8,
        "density_over_stiffness": DENSITY_KG_PER_M / STIFFNESS_N_M2,
        "bending_stiffness_n_m2": STIFFNESS_N_M2, "delay_s": 0.0,
    }  # fmt: skip
    start |= {name: value for name, value in known.items() if value is not None}
    unknowns = np.array(
        [start[name] if name in _ADDITIVE else math.log(start[name]) for name in _FITTED]
    )

    def residual(at: Real) -> Real:
        difference = measured - _predicted(at, numbers)
        difference[:, 3] = (difference[:, 3] + math.pi) % (2 * math.pi) - math.pi
        found: Real = (weight * difference).ravel()
        return found

    began, damping, here = unknowns.copy(), 1e-3, residual(unknowns)
    jacobian = np.empty((here.size, unknowns.size))
    for _ in range(_ITERATIONS):
        for i, scale in enumerate(_SCALES):
            step = np.zeros(unknowns.size)
            step[i] = 1e-2 * scale
            jacobian[:, i] = (residual(unknowns - step) - residual(unknowns + step)) / 2e-2
        change = np.linalg.lstsq(
            np.vstack([jacobian, damping * np.diag(np.linalg.norm(jacobian, axis=0))]),
            np.concatenate([here, np.zeros(unknowns.size)]),
            rcond=None,
        )[0]
        candidate = unknowns + _SCALES * np.clip(change, -3, 3)
        try:
            there = residual(candidate)
        except (ArithmeticError, ValueError):
            damping = max(10 * damping, 1e-6)
            continue
        if there @ there < here @ here:
            gained = here @ here - there @ there
            unknowns, here, damping = candidate, there, damping / 10
            if gained < 1e-4:
                break
        else:
            damping = max(10 * damping, 1e-6)
            if damping > 1e6:
                break
    if here @ here > _EXCLUDED:
        return math.inf
    stds = _SCALES * np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)))
    true = [known[name] is not None for name in _FITTED]
    shifts = np.abs(unknowns - began) / stds
    return float(shifts[true].max()) if any(true) else math.inf


_EXCLUDED = 200.0
"""Weighted sum of squares, without noise, above which no uniform beam has such modes."""


def _predicted(at: Real, numbers: list[int]) -> Real:
    values = [
        value if name in _ADDITIVE else math.exp(value)
        for name, value in zip(_FITTED, at.tolist(), strict=True)
    ]
    zeta, alpha, gamma, lambda_, over, stiffness, delay_s = values
    beam = Truth(zeta, alpha, gamma, lambda_, over, stiffness)
    rows = []
    for number in numbers:
        pole = beam.pole(number)
        # The response is nearly R / (s - pole) here; the mean over four points cancels the rest.
        circle = pole + 1e-4 * abs(pole) * np.array([1, 1j, -1, -1j])
        near = beam.torque_per_angle(circle) * (circle - pole)
        residue = complex(np.mean(near)) * np.exp(-pole * delay_s)
        rows.append(_constants(pole.imag / (2 * math.pi), -pole.real / abs(pole), residue))
    return np.array(rows)


def _constants(frequency_hz: float, damping_ratio: float, residue: complex) -> list[float]:
    return [
        math.log(frequency_hz),
        math.log(damping_ratio),
        math.log(abs(residue)),
        math.atan2(residue.imag, residue.real),
    ]


def _frequency(mode: dict[str, Any]) -> float:
    return float(mode["frequency_hz"])


def _residue(mode: dict[str, Any]) -> complex:
    return complex(*mode["residue"])


def _relative_stds(mode: dict[str, Any], headline: dict[str, Any]) -> tuple[float, float] | None:
    """Return the analyzer's relative standard deviations of frequency and damping ratio."""
    for entry in headline["modes"]:
        pair = (entry["frequency_hz"], entry["damping_ratio"])
        if entry["mode"] == mode["mode"] and all(each["std"] and each["value"] for each in pair):
            return pair[0]["std"] / pair[0]["value"], abs(pair[1]["std"] / pair[1]["value"])
    return None
