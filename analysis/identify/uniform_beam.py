"""Test of a uniform beam against the modal constants, and estimate of its parameters.

A plain uniform beam with both dampings predicts frequency, damping ratio and residue of every mode
from seven parameters. Chi-square of the constants measured against those predicted is the test. No
antenna is uniform to the precision at which frequencies are measured, so parameters are estimated
with a stated tolerance: each ln f has that standard deviation, each ln of a residue three times as
much, in addition to the noise.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from analysis.identify._altered_beam import Alteration, mode_terms
from analysis.identify._modal_model import CONSTANTS
from analysis.identify._plant import LOGARITHMIC
from analysis.identify._predictor import torque_channel
from analysis.optimizer import Box, NormalEquations, descend
from analysis.statistics import NORMAL_95, chi_square_p_value
from rigd.beam import Beam, Damping, clamped_free_eigenvalues
from rigd.session import BeamUniformity

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify._altered_beam import ModeTerms
    from analysis.identify._modal_model import ModalEstimate
    from analysis.identify._plant import Plant
    from analysis.optimizer import Minimum

PARAMETERS: Final = (
    "zeta",
    "alpha",
    "gamma",
    "lambda",
    "density_over_stiffness",
    "bending_stiffness_n_m2",
    "delay_s",
)
"""Those of a uniform beam that its modal constants depend on."""

_ORDERS: Final = (0.4, 1.0, 1.6)
_ORDER_RANGE: Final = (0.02, 1.98)
_LN_LOSS_RANGE: Final = (-18.0, 2.0)
"""Range of the logarithm of what a damping adds to stiffness or inertia at its reference
frequency."""

_LN_RANGE: Final = 2.0
"""Largest distance of ratio and stiffness from the start of the search, in logarithms."""

_DELAY_UNIT_S: Final = 0.01
_LARGEST_DELAY: Final = 1.0
_RENEWALS: Final = 4
"""Number of times that the shapes of a loaded or tilted beam are computed, each with the current
beam."""

_STEP: Final = 1e-5
_NEWTON_STEPS: Final = 6
_EXACT: Final = 1e-13
_TOLERANCE: Final = 1e-4
_MANY: Final = 80

Status = Literal["passed", "refused", "not tested"]
Basis = Literal["geometry", "losses", "none"]

REFUSED_BELOW: Final = 0.01
"""p-value below which a beam does not predict the constants."""

_PLAUSIBLE: Final = 0.3
"""p-value from which the stated tolerance suffices: a beam that is more uneven reaches a lower one,
since orders compensate a part of the excess."""

_PLAUSIBLE_WIDER: Final = 0.1

_WIDER: Final = 3e-3
"""Tolerance that is tested if the stated one does not suffice."""

_LOOSE: Final = 0.05
"""Tolerance with which frequencies and residues have almost no weight."""

_FEWEST_MODES: Final = 2
_NO_EFFECT: Final = 1e-4
"""Curvature of chi-square by an unknown that does nothing."""

_COEFFICIENTS: Final = ("zeta", "gamma")
_PROFILED: Final = ("zeta", "alpha", "gamma", "lambda")
_PROFILE_STEPS: Final = 8
_CLOSE: Final = 0.05
_LONGEST_STEP: Final = 3.0
_LARGEST_LN: Final = 300.0


class ConstantsProblem:
    """Deviations of a uniform beam's modal constants from those measured.

    Unknowns are the contribution of internal damping to the stiffness at the highest visible mode
    (``ln zeta omega^alpha``) and external damping to the inertia at the lowest
    (``ln gamma omega^lambda / (rho/EI omega²)``), which depend little on the orders; alpha and
    lambda; the logarithms of rho/EI and EI; and the delay.

    Parameters
    ----------
    fit : ModalEstimate
    modes : sequence of int
        Visible modes.
    nominal : Plant
        Rig and specimen as the file states them; with a mass at the tip, if it states one.
    uniformity : float
        Relative standard deviation of each frequency, in addition to the noise.
    tilt_deg : float, optional
        Inclination of the plane of motion along the beam at rest as the file states it.
    """

    def __init__(
        self,
        fit: ModalEstimate,
        modes: Sequence[int],
        nominal: Plant,
        uniformity: float = 0.0,
        tilt_deg: float | None = None,
    ) -> None:
        rows = fit.rows(modes)
        count = len(modes)
        self.modes = tuple(modes)
        self.nominal = nominal
        self.uniformity = uniformity
        self.measured = fit.constants[rows]
        extra = np.zeros((count, len(CONSTANTS)))
        extra[:, CONSTANTS.index("ln_frequency")] = uniformity
        extra[:, CONSTANTS.index("ln_residue")] = 3 * uniformity
        self.covariance = fit.covariance[np.ix_(rows, rows)] + np.diag(extra.ravel() ** 2)
        self.compared = count * len(CONSTANTS)
        self._whitener = np.linalg.inv(np.linalg.cholesky(self.covariance))
        length = nominal.beam.length_m
        z = clamped_free_eigenvalues(max(modes))[np.array(modes) - 1]
        self.stated = Alteration.stated(nominal, tilt_deg)
        self.terms = mode_terms(self.stated, nominal.beam, self.modes)
        constants = self.measured.reshape(-1, len(CONSTANTS))
        self._omega = 2 * np.pi * np.exp(constants[:, 0])
        self._ratios = np.exp(constants[:, 1])
        self._poles = self._omega * (1j - self._ratios)
        # Where the search begins: the mean of all modes.
        mass = self.terms.mass + self.terms.lump
        self._ln_ratio = float(np.mean(np.log((z / length) ** 4 / mass) - 2 * np.log(self._omega)))
        ln_stiffness = constants[:, 2] - np.log(self._omega) + np.log(length / 2)
        self._ln_stiffness = float(np.mean(ln_stiffness))
        low, high = _LN_LOSS_RANGE
        self.lower = np.array([
            low, _ORDER_RANGE[0], low, _ORDER_RANGE[0],
            self._ln_ratio - _LN_RANGE, self._ln_stiffness - _LN_RANGE, -_LARGEST_DELAY,
        ])  # fmt: skip
        self.upper = np.array([
            high, _ORDER_RANGE[1], high, _ORDER_RANGE[1],
            self._ln_ratio + _LN_RANGE, self._ln_stiffness + _LN_RANGE, _LARGEST_DELAY,
        ])  # fmt: skip
        # From the unknowns to `PARAMETERS`, those of `LOGARITHMIC` by their logarithms
        first, last = math.log(self._omega[0]), math.log(self._omega[-1])
        self.transform = np.eye(len(PARAMETERS))
        self.transform[0, 1] = -last
        self.transform[2, 3] = -first
        self.transform[2, 4] = 1.0
        self.transform[6, 6] = _DELAY_UNIT_S
        self._offset = np.zeros(len(PARAMETERS))
        self._offset[2] = 2 * first

    def parameters(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `PARAMETERS` for unknowns, shape (..., 7); `LOGARITHMIC` ones as logarithms."""
        return x @ self.transform.T + self._offset

    def plant(self, x: NDArray[np.float64]) -> Plant:
        """Return the plant of a vector of unknowns."""
        zeta, alpha, gamma, lambda_, ratio, stiffness, delay_s = self.parameters(x).tolist()
        bending = math.exp(stiffness)
        return replace(
            self.nominal,
            beam=Beam(
                length_m=self.nominal.beam.length_m,
                density_kg_per_m=math.exp(ratio) * bending,
                bending_stiffness_n_m2=bending,
            ),
            damping=Damping(
                zeta=math.exp(zeta), alpha=alpha, gamma=math.exp(gamma), lambda_=lambda_
            ),
            delay_s=delay_s,
        )

    def constants(
        self, x: NDArray[np.float64], terms: ModeTerms | None = None
    ) -> NDArray[np.float64]:
        """Return the modal constants of beams, (m, 4 n), for unknowns of shape (m, 7).

        Parameters
        ----------
        x : ndarray of float
            Vector of unknowns.
        terms : ModeTerms, optional
            Terms of a beam other than the stated one.
        """
        terms = self.terms if terms is None else terms
        zeta, alpha, gamma, lambda_, ratio, stiffness, delay = self.parameters(x).T[..., None]
        zeta, gamma = np.exp(zeta), np.exp(gamma)
        lighter = 1.0
        if terms.density_kg_per_m is not None:
            lighter = terms.density_kg_per_m * np.exp(-ratio - stiffness)
        ratio = np.exp(ratio)
        mass, arm = terms.mass + lighter * terms.lump, terms.mass_arm + lighter * terms.lump_arm
        rest = terms.stiffness + terms.clamp + ratio * terms.tension
        strength, time_s = terms.alteration.relaxation
        s = np.broadcast_to(self._poles, (len(x), self._poles.size))
        for _ in range(_NEWTON_STEPS):
            log_s = np.log(s)
            internal = zeta * np.exp(alpha * log_s) * terms.stiffness
            external = gamma * np.exp(lambda_ * log_s)
            inertia = ratio * s * s
            slope = (alpha * internal + lambda_ * external) / s + 2 * ratio * s * mass
            total = rest + internal + inertia * mass + external
            if strength:
                relaxed = strength * time_s / (1 + time_s * s) * terms.stiffness
                total = total + relaxed * s
                slope = slope + relaxed / (1 + time_s * s)
            step = total / slope
            s = s - step
            if np.abs(step).max() < _EXACT * np.abs(s).max():
                break
        s = np.where((s.imag > 0) & (s.real < 0), s, complex(np.nan, np.nan))
        channel = torque_channel(replace(self.nominal, delay_s=0.0), s) * np.exp(-delay * s)
        channel = channel * terms.alteration.channel(s)
        turned = external * terms.turn_by_medium
        turned = turned + internal / terms.stiffness * terms.turn_by_internal
        pushed = inertia * (arm + turned)
        pushed = pushed + external * terms.medium_arm + ratio * terms.tension_arm
        volume = self.nominal.beam.length_m**3
        log_residues = np.log(1j * volume * pushed**2 / slope * channel) + stiffness
        rows = (
            np.log(s.imag / (2 * np.pi)),
            np.log(-s.real / np.abs(s)),
            log_residues.real,
            log_residues.imag,
        )
        return np.stack(rows, axis=-1).reshape(len(x), -1)

    def differences(
        self, x: NDArray[np.float64], terms: ModeTerms | None = None
    ) -> NDArray[np.float64]:
        """Return the differences from the measured constants, (m, 4 n).

        Parameters
        ----------
        x : ndarray of float
            Vector of unknowns.
        terms : ModeTerms, optional
            Terms of a beam other than the stated one.
        """
        with np.errstate(all="ignore"):  # a mode without a pole gives NaN
            off = self.constants(x, terms) - self.measured
        phases = off[:, CONSTANTS.index("residue_phase_rad") :: len(CONSTANTS)]
        phases -= 2 * np.pi * np.round(phases / (2 * np.pi))
        return off

    def _deviations(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.nan_to_num(self.differences(x) @ self._whitener.T, nan=1e6)

    def equations(self, x: NDArray[np.float64]) -> NormalEquations:
        """Return chi-square at a point and its derivatives, by central differences."""
        steps = _STEP * np.eye(x.size)
        every = self._deviations(np.concatenate([x[None], x + steps, x - steps]))
        deviation = every[0]
        jacobian = (every[1 : 1 + x.size] - every[1 + x.size :]) / (2 * _STEP)
        return NormalEquations(
            float(deviation @ deviation), jacobian @ deviation, jacobian @ jacobian.T
        )

    def starts(self) -> list[NDArray[np.float64]]:
        """Return beams of several orders, with the losses that fit best."""
        omega, first, last = self._omega, self._omega[0], self._omega[-1]
        found = []
        for alpha, lambda_ in itertools.product(_ORDERS, repeat=2):
            internal = (omega / last) ** alpha * math.sin(alpha * math.pi / 2)
            external = (omega / first) ** lambda_ * math.sin(lambda_ * math.pi / 2)
            external *= (first / omega) ** 2
            columns = np.array([internal, external]).T / (2 * self._ratios)[:, None]
            sizes, *_ = np.linalg.lstsq(columns, np.ones(omega.size), rcond=None)
            most = np.min(2 * self._ratios / np.array([internal, external]), axis=1)
            losses = np.log(np.clip(sizes, 0.02 * most, most))
            delay = self.nominal.delay_s / _DELAY_UNIT_S
            found.append(
                np.array([losses[0], alpha, losses[1], lambda_, self._ln_ratio, self._ln_stiffness,
                          delay])
            )  # fmt: skip
        return found

    def minimum(self, x: NDArray[np.float64]) -> Minimum:
        """Descend from a point."""
        return _descend(self.equations, x, self.lower, self.upper)

    def minima(self) -> list[Minimum]:
        """Return the minima from all starts, the lowest first."""
        found = self._minima(self.starts())
        for _ in range(_RENEWALS if self.stated != Alteration() else 0):
            self.terms = mode_terms(self.stated, self.plant(found[0].x).beam, self.modes)
            found = self._minima([each.x for each in found])
        return found

    def _minima(self, starts: Sequence[NDArray[np.float64]]) -> list[Minimum]:
        return sorted((self.minimum(x) for x in starts), key=lambda each: each.cost)

    def held_at_edge(self, index: int, x: NDArray[np.float64]) -> Minimum:
        """Descend from `x` with a damping at the lower edge of its size, where it has no effect.

        Parameters
        ----------
        index : int
            Index of its coefficient among `PARAMETERS`.
        x : ndarray of float
            Vector of unknowns.
        """
        high = self.upper.copy()
        high[index] = self.lower[index]
        return _descend(self.equations, x, self.lower, high)

    def held(self, index: int, value: float, x: NDArray[np.float64]) -> Minimum:
        """Descend from `x` with one of `PARAMETERS` held; the result's `x` are the unknowns.

        Parameters
        ----------
        index : int
            Index among `PARAMETERS`.
        value : float
            Value at which it is held, as in `parameters`.
        x : ndarray of float
            Vector of unknowns to begin with.
        """
        # The parameter replaces the unknown that contributes to it with factor 1.
        forward = np.eye(x.size)
        forward[index] = self.transform[index] / self.transform[index, index]
        backward = np.linalg.inv(forward)
        low, high = self.lower.copy(), self.upper.copy()
        low[index] = high[index] = (value - self._offset[index]) / self.transform[index, index]

        def equations(y: NDArray[np.float64]) -> NormalEquations:
            found = self.equations(backward @ y)
            return NormalEquations(
                found.cost, backward.T @ found.gradient, backward.T @ found.hessian @ backward
            )

        found = _descend(equations, forward @ x, low, high)
        return replace(found, x=backward @ found.x)


def _descend(
    equations: Callable[[NDArray[np.float64]], NormalEquations],
    x: NDArray[np.float64],
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
) -> Minimum:
    """Descend between bounds."""
    return descend(
        equations,
        x,
        Box(lower, upper),
        relative_tolerance=_TOLERANCE,
        max_evaluations=_MANY,
    )


@dataclass(frozen=True, slots=True)
class UniformBeamTest:
    """Test of whether a plain uniform beam predicts the modal constants of a record.

    Attributes
    ----------
    status : str
        "passed", "refused", or "not tested" without degrees of freedom.
    chi_square : float
    degrees_of_freedom : int
    p_value : float or None
        Probability of such a chi-square by chance; None without degrees of freedom.
    modes : tuple of int
        Modes compared.
    measured, predicted, std : ndarray, shape (4 n,)
        `CONSTANTS` of each mode in turn, and the standard deviation of those measured.
    """

    status: Status
    chi_square: float
    degrees_of_freedom: int
    p_value: float | None
    modes: tuple[int, ...]
    measured: NDArray[np.float64]
    predicted: NDArray[np.float64]
    std: NDArray[np.float64]

    @property
    def summary(self) -> BeamUniformity:
        """Return status and p-value with the sentence."""
        return BeamUniformity(self.status, self.p_value)

    def as_json(self) -> dict[str, Any]:
        """Return the test as `json.dumps` takes it; numbers may be not finite."""
        return {
            **self.summary.as_json(),
            "chi_square": self.chi_square,
            "degrees_of_freedom": self.degrees_of_freedom,
            "constants": [
                {
                    "mode": self.modes[index // len(CONSTANTS)],
                    "name": CONSTANTS[index % len(CONSTANTS)],
                    "measured": measured,
                    "std": std,
                    "predicted": predicted,
                }
                for index, (measured, std, predicted) in enumerate(
                    zip(
                        self.measured.tolist(),
                        self.std.tolist(),
                        self.predicted.tolist(),
                        strict=True,
                    )
                )
            ],
        }


@dataclass(frozen=True, slots=True)
class TolerantEstimate:
    """Parameters of a nearly uniform beam, from the modal constants with a tolerance of geometry.

    Attributes
    ----------
    basis : str
        "geometry": frequencies and residues of all modes within the tolerance; "losses": damping
        ratios and residue phases alone; "none": no beam with two dampings of one order each
        explains even these.
    uniformity : float
        Assumed relative standard deviation of each frequency.
    p_value : float or None
    plant : Plant
    values, std : mapping of str to float
        By the names of `PARAMETERS`.
    interval : mapping of str to (float, float)
        95 %, by the profile of chi-square; an end is infinite, or the edge of the range, where the
        modes do not bound it.
    covariance : ndarray, shape (7, 7)
        Covariance of `PARAMETERS`; `LOGARITHMIC` ones by their logarithms.
    first_rad_s : float
        Frequency of the first visible mode.
    deviance_of_one : mapping of str to float
        Increase of chi-square of damping ratios and residue phases alone with order 1, by order; 0
        where the interval holds 1.
    deviance_without : mapping of str to float
        Increase of chi-square without a damping, by its coefficient.
    """

    basis: Basis
    uniformity: float
    p_value: float | None
    plant: Plant
    values: Mapping[str, float]
    std: Mapping[str, float]
    interval: Mapping[str, tuple[float, float]]
    covariance: NDArray[np.float64]
    first_rad_s: float
    deviance_of_one: dict[str, float]
    deviance_without: dict[str, float]

    def covariance_json(self) -> dict[str, Any]:
        """Return the covariance of the parameters as `json.dumps` takes it."""
        names = [f"ln_{name}" if name in LOGARITHMIC else name for name in PARAMETERS]
        return {"names": names, "matrix": self.covariance.tolist()}


def uniform_beam_test(
    fit: ModalEstimate, nominal: Plant, tilt_deg: float | None = None
) -> UniformBeamTest:
    """Test whether a uniform beam with both dampings predicts the constants of the visible modes.

    Parameters
    ----------
    fit : ModalEstimate
    nominal : Plant
        Rig and specimen as the file states them; with a mass at the tip, if it states one.
    tilt_deg : float, optional
        Inclination of the plane of motion along the beam at rest as the file states it.
    """
    modes = fit.visible
    rows = fit.rows(modes)
    measured, std = fit.constants[rows], np.sqrt(np.diag(fit.covariance)[rows])
    freedom = len(rows) - len(PARAMETERS)
    if freedom <= 0:
        none = np.full(measured.size, np.nan)
        return UniformBeamTest("not tested", math.nan, 0, None, modes, measured, none, std)
    problem = ConstantsProblem(fit, modes, nominal, tilt_deg=tilt_deg)
    best = problem.minima()[0]
    freedom += _idle(problem, best)
    p_value = float(chi_square_p_value(best.cost, freedom))
    return UniformBeamTest(
        status="passed" if p_value >= REFUSED_BELOW else "refused",
        chi_square=best.cost,
        degrees_of_freedom=freedom,
        p_value=p_value,
        modes=modes,
        measured=measured,
        predicted=problem.constants(best.x[None])[0],
        std=std,
    )


def tolerant_estimate(
    fit: ModalEstimate, nominal: Plant, uniformity: float, tilt_deg: float | None = None
) -> TolerantEstimate | None:
    """Estimate damping and beam with a tolerance of the geometry.

    If a uniform beam with the stated tolerance does not predict the constants, a wider tolerance is
    used; if that fails too, losses and phases alone.

    Parameters
    ----------
    fit : ModalEstimate
    nominal : Plant
        Rig and specimen as the file states them.
    uniformity : float
        Stated relative standard deviation of each frequency.
    tilt_deg : float, optional
        Inclination of the plane of motion along the beam at rest as the file states it.

    Returns
    -------
    TolerantEstimate or None
        None with fewer than two visible modes.
    """
    modes = fit.visible
    if len(modes) < _FEWEST_MODES:
        return None
    wider = max(_WIDER, uniformity)
    attempts: tuple[tuple[Basis, float, float], ...] = (
        ("geometry", uniformity, _PLAUSIBLE),
        ("geometry", wider, _PLAUSIBLE_WIDER),
        ("losses", _LOOSE, REFUSED_BELOW),
    )
    for basis, tolerance, least in attempts:
        problem = ConstantsProblem(fit, modes, nominal, tolerance, tilt_deg)
        minima = problem.minima()
        # With a loose geometry frequencies and residues count as compared no longer.
        compared = problem.compared // (2 if basis == "losses" else 1)
        freedom = compared - (len(PARAMETERS) if basis == "geometry" else len(PARAMETERS) - 2)
        freedom += _idle(problem, minima[0])
        p_value = float(chi_square_p_value(minima[0].cost, freedom)) if freedom > 0 else None
        if p_value is None or p_value >= least:
            break
    else:
        basis = "none"
    found = _estimate(problem, minima, basis, p_value)
    away = [
        order for order in ("alpha", "lambda")
        if not found.interval[order][0] <= 1 <= found.interval[order][1]
    ]  # fmt: skip
    if not away:
        return found
    if basis == "geometry":
        problem = ConstantsProblem(fit, modes, nominal, _LOOSE, tilt_deg)
        minima = problem.minima()
    best = minima[0]
    rises = {
        order: problem.held(PARAMETERS.index(order), 1.0, best.x).cost - best.cost for order in away
    }
    return replace(found, deviance_of_one=found.deviance_of_one | rises)


def _idle(problem: ConstantsProblem, best: Minimum) -> int:
    """Count the unknowns without effect at a minimum: those of an absent damping."""
    spread = np.diag(best.equations.hessian)
    held = best.equations.held(best.x, problem.lower, problem.upper)
    return int(np.count_nonzero(held | (spread < _NO_EFFECT)))


def _estimate(
    problem: ConstantsProblem, minima: Sequence[Minimum], basis: Basis, p_value: float | None
) -> TolerantEstimate:
    """Return values, deviations and intervals at a minimum."""
    best = minima[0]
    plant = problem.plant(best.x)
    hessian = best.equations.hessian + np.diag(1 / (problem.upper - problem.lower) ** 2)
    covariance = problem.transform @ np.linalg.inv(hessian) @ problem.transform.T
    values = problem.parameters(best.x)
    spreads = np.sqrt(np.diag(covariance))
    without = {
        name: problem.held_at_edge(PARAMETERS.index(name), best.x).cost - best.cost
        for name in _COEFFICIENTS
    }
    near = [each for each in minima if each.cost - best.cost < NORMAL_95**2]
    ends: dict[str, tuple[float, float]] = {}
    std: dict[str, float] = {}
    for index, name in enumerate(PARAMETERS):
        value, spread = float(values[index]), float(spreads[index])
        if name in _PROFILED:
            low, high = (_end(problem, index, best, side * spread) for side in (-1.0, 1.0))
            others = [float(problem.parameters(each.x)[index]) for each in near]
            low, high = min(low, *others), max(high, *others)
        else:
            low, high = value - NORMAL_95 * spread, value + NORMAL_95 * spread
        if name in LOGARITHMIC:
            value, spread = math.exp(value), math.exp(value) * spread
            low, high = math.exp(low), math.exp(min(high, _LARGEST_LN))
        ends[name], std[name] = (low, high), spread
    return TolerantEstimate(
        basis=basis,
        uniformity=problem.uniformity,
        p_value=p_value,
        plant=plant,
        values=plant.parameters,
        std=std,
        interval=ends,
        covariance=covariance,
        first_rad_s=float(2 * np.pi * np.exp(problem.measured[0])),
        deviance_of_one={"alpha": 0.0, "lambda": 0.0},
        deviance_without=without,
    )


def _end(problem: ConstantsProblem, index: int, best: Minimum, spread: float) -> float:
    """Return the end of a 95 % interval, where the profile of chi-square has risen by 3.84.

    It is the edge of the range of an order if chi-square does not rise so far. `index` and `spread`
    are the parameter and its standard deviation with the side as sign.
    """
    centre = float(problem.parameters(best.x)[index])
    edge = math.copysign(math.inf, spread)
    if PARAMETERS[index] in ("alpha", "lambda"):
        edge = _ORDER_RANGE[0 if spread < 0 else 1]
    inside, rise, x = centre, 0.0, best.x
    trial = centre + NORMAL_95 * spread
    outside: float | None = None
    for _ in range(_PROFILE_STEPS):
        trial = max(trial, edge) if spread < 0 else min(trial, edge)
        found = problem.held(index, trial, x)
        root = math.sqrt(max(found.cost - best.cost, 0.0))
        if abs(root - NORMAL_95) < _CLOSE:
            return trial
        if root < NORMAL_95:
            inside, rise, x = trial, root, found.x
            if trial == edge:
                return edge
        else:
            outside, above = trial, root
        if outside is None:
            step = (inside - centre) * min(NORMAL_95 / max(rise, 0.2), _LONGEST_STEP)
            trial = centre + step
        else:
            trial = inside + (outside - inside) * (NORMAL_95 - rise) / (above - rise)
    return trial if outside is not None else edge
