"""Response from measured angle to measured torque: the beam, its clamp and the instruments' delay.

::

    H(s) = (R(s) + J_tool s²) Q(s) exp(-s tau),    R = G' / (1 + kappa G'),    G' = G + sum_i G_i

G is Eq. 25. A real link is not quite uniform, which moves its modes one by one: G_i replaces mode i
of the sum that G is (`rigd.beam.modes`) by one of another stiffness. With p the inertial and c the
elastic factor, ``p = rho/EI s² + gamma s^lambda``, ``c = 1 + zeta s^alpha``, k⁴ the mode's
stiffness and d its offset::

    G_i = a² EI p² c k⁴ d / ((c k⁴ (1 + d) + p) (c k⁴ + p))

kappa is the clamp's compliance, between tool and beam; with a tip mass G is that of
`rigd.beam.tip_mass`. Q holds the low-pass filters of the torque's channel,
``1 / (1 + tau_1 s)`` and ``1 / (1 + sqrt(2) tau_2 s + tau_2² s²)``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rigd.beam import PARAMETERS, TransferGrid, clamped_free_eigenvalues, loaded_response

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from analysis.whole_record.plant import Plant

_FILTERS: Final = ("filter_time_constant_s", "second_order_filter_time_constant_s")
_BUTTERWORTH: Final = 2**0.5

FIRST_OFFSET: Final = 2
"""Mode whose offset comes first: that of mode 1 is 0, its frequency is what rho/EI says."""


def offset_name(mode: int) -> str:
    """Name of a mode's offset among the parameters."""
    return f"stiffness_offset_{mode}"


@lru_cache(maxsize=16)
def eigenvalues(count: int) -> NDArray[np.float64]:
    """First roots of ``1 + cos z cosh z = 0``, shape (count,), kept: every evaluation needs them.

    Not to be written to.
    """
    z = clamped_free_eigenvalues(count)
    z.flags.writeable = False
    return z


def torque_channel(
    plant: Plant, s: NDArray[np.complexfloating[Any, Any]]
) -> NDArray[np.complex128]:
    """Give what the torque's channel makes of a torque: delay and filters, of the shape of `s`.

    Parameters
    ----------
    plant : Plant
    s : ndarray of complex
        In rad/s.
    """
    at = s.astype(np.complex128, copy=False)
    through: NDArray[np.complex128] = np.exp(-plant.delay_s * at)
    for name in _FILTERS:
        constant_s = plant.extras[name]
        if constant_s:
            through /= _divisor(name, constant_s, at)
    return through


def _divisor(name: str, constant_s: float, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Denominator of a filter."""
    if name == "filter_time_constant_s":
        return 1 + constant_s * s
    return 1 + constant_s * (_BUTTERWORTH * s + constant_s * s * s)


def _divisor_slope(
    name: str, constant_s: float, s: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Differentiate it by the constant."""
    if name == "filter_time_constant_s":
        return s
    return _BUTTERWORTH * s + 2 * constant_s * s * s


class ResponseGrid:
    """H and its derivatives on one grid of s.

    Parameters
    ----------
    s : array_like of complex, shape (n,)
        Laplace variable in rad/s, not 0.
    """

    __slots__ = ("_beam", "_log_s", "_s", "_s_squared")

    def __init__(self, s: ArrayLike) -> None:
        self._s = np.asarray(s, dtype=np.complex128)
        self._s_squared = self._s * self._s
        self._log_s = np.log(self._s)
        self._beam = TransferGrid(self._s)

    @property
    def s(self) -> NDArray[np.complex128]:
        """The grid, shape (n,)."""
        return self._s

    def evaluate(
        self,
        plant: Plant,
        wrt: Sequence[str] = (),
        angle: NDArray[np.complex128] | float = 1.0,
    ) -> NDArray[np.complex128]:
        """Torque for an angle, and its derivatives.

        Parameters
        ----------
        plant : Plant
            Where to evaluate.
        wrt : sequence of str
            Names from `rigd.beam.PARAMETERS`, "delay_s", "tool_inertia_kg_m2", those of offsets and
            `EXTRAS` but the clocks' difference; each derivative holds all others constant.
        angle : ndarray of complex, shape (n,), or float
            Transform of the angle.

        Returns
        -------
        ndarray of complex, shape (1 + k, n)
            The torque's transform, then the derivatives in the order of `wrt`.
        """
        response, rows = self._of_beam(plant, wrt)
        if plant.stiffness_offsets:
            response += self._offset_modes(plant, rows)
        if plant.root_compliance_rad_per_nm or "root_compliance_rad_per_nm" in wrt:
            softened = 1 / (1 + plant.root_compliance_rad_per_nm * response)
            for name in rows:
                rows[name] = rows[name] * softened**2
            response = response * softened
            rows["root_compliance_rad_per_nm"] = -response * response
        response += plant.tool_inertia_kg_m2 * self._s_squared
        rows["tool_inertia_kg_m2"] = self._s_squared
        late = torque_channel(plant, self._s) * angle
        if "delay_s" in wrt:
            rows["delay_s"] = -self._s * response
        for name in _FILTERS:
            if name in wrt:
                at = plant.extras[name], self._s
                rows[name] = -(_divisor_slope(name, *at) / _divisor(name, *at)) * response
        found = np.empty((1 + len(wrt), late.size), dtype=np.complex128)
        for out, row in zip(found, [response, *(rows[name] for name in wrt)], strict=True):
            np.multiply(row, late, out=out)
        return found

    def _of_beam(
        self, plant: Plant, wrt: Sequence[str]
    ) -> tuple[NDArray[np.complex128], dict[str, NDArray[np.complex128]]]:
        """G on a rigid clamp, and its derivatives by what of `wrt` it depends on."""
        if plant.tip_mass_kg or "tip_mass_kg" in wrt:
            return self._with_tip_mass(plant, wrt)
        of_beam = [name for name in wrt if name in PARAMETERS]
        if not of_beam:
            return self._beam.evaluate(plant.beam, plant.damping), {}
        response, gradient = self._beam.evaluate_with_gradient(plant.beam, plant.damping, of_beam)
        return response, dict(zip(of_beam, gradient, strict=True))

    def _with_tip_mass(
        self, plant: Plant, wrt: Sequence[str]
    ) -> tuple[NDArray[np.complex128], dict[str, NDArray[np.complex128]]]:
        """Compute the same with a mass at the tip."""
        damping = plant.damping
        inertia = plant.beam.density_over_stiffness * self._s_squared
        s_alpha = np.exp(damping.alpha * self._log_s).astype(np.complex128)
        s_lambda = np.exp(damping.lambda_ * self._log_s).astype(np.complex128)
        elastic, inertial = 1 + damping.zeta * s_alpha, inertia + damping.gamma * s_lambda
        found = loaded_response(self._s_squared, elastic, inertial, plant.beam, plant.tip_mass_kg)
        slopes: dict[str, Callable[[], NDArray[np.complex128]]] = {
            "zeta": lambda: found.by_elastic * s_alpha,
            "alpha": lambda: found.by_elastic * (damping.zeta * self._log_s * s_alpha),
            "gamma": lambda: found.by_inertial * s_lambda,
            "lambda": lambda: found.by_inertial * (damping.gamma * self._log_s * s_lambda),
            "ln_density_over_stiffness": lambda: found.by_inertial * inertia,
            "ln_stiffness": lambda: found.response - plant.tip_mass_kg * found.by_mass,
            "tip_mass_kg": lambda: found.by_mass,
        }
        return found.response, {name: slopes[name]() for name in wrt if name in slopes}

    def _offset_modes(
        self, plant: Plant, rows: dict[str, NDArray[np.complex128]]
    ) -> NDArray[np.complex128]:
        """Sum of all G_i, shape (n,); their derivatives are added to `rows`."""
        damping, ratio = plant.damping, plant.beam.density_over_stiffness
        stiffness = plant.beam.bending_stiffness_n_m2
        s_alpha = np.exp(damping.alpha * self._log_s)
        s_lambda = np.exp(damping.lambda_ * self._log_s)
        c = 1 + damping.zeta * s_alpha
        p = ratio * self._s_squared + damping.gamma * s_lambda
        total, by_p, by_c = np.zeros((3, self._s.size), dtype=np.complex128)
        last = FIRST_OFFSET + len(plant.stiffness_offsets) - 1
        of_modes = (eigenvalues(last)[FIRST_OFFSET - 1 :] / plant.beam.length_m) ** 4
        shares = 4 * stiffness / (plant.beam.length_m * of_modes)
        for i, (share, k, offset) in enumerate(
            zip(shares, of_modes, plant.stiffness_offsets, strict=True)
        ):
            before, after = 1 / (c * k + p), 1 / (c * (k * (1 + offset)) + p)
            by_offset = (share * k) * p * p * c * after
            total += by_offset * before * offset
            rows[offset_name(FIRST_OFFSET + i)] = by_offset * after
            by_p += (share * k * k) * (((1 + offset) * after) ** 2 - before**2)
            by_c += (share * k) * ((1 + offset) * after**2 - before**2)
        by_p *= c * c
        by_c *= p * p
        slopes = {
            "zeta": lambda: by_c * s_alpha,
            "alpha": lambda: by_c * (damping.zeta * self._log_s * s_alpha),
            "gamma": lambda: by_p * s_lambda,
            "lambda": lambda: by_p * (damping.gamma * self._log_s * s_lambda),
            "ln_density_over_stiffness": lambda: by_p * (ratio * self._s_squared),
            "ln_stiffness": lambda: total,
        }
        for name in slopes.keys() & rows.keys():
            rows[name] = rows[name] + slopes[name]()
        return total
