"""Torque predicted from the measured angle: response of beam, clamp and instruments.

The response from measured angle to measured torque is::

    H(s) = (R(s) + J_tool s²) Q(s) exp(-s tau),    R = G / (1 + kappa G)

G is the exact fractional-order beam (Eq. 25 of the reference paper). With a tip mass, or with
deviating stiffness of single modes, G is that of `rigd.beam._tip_mass`. kappa is the clamp's
compliance, between tool and beam. Q holds the low-pass filters of the torque's channel, ``1 / (1 +
tau_1 s)`` and ``1 / (1 + sqrt(2) tau_2 s + tau_2² s²)`` (Butterworth), and tau is the delay of the
torque's channel relative to the angle's.

The angle is convolved with H causally, over the whole record, on ``s = sigma + j omega``: see
`TorquePredictor`.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify._data import fast_length
from analysis.identify._modal_model import ModalModel
from analysis.identify._plant import Plant
from rigd.beam import PARAMETERS, TransferGrid, clamped_free_eigenvalues, differentiated_response

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray


# Response


@lru_cache(maxsize=16)
def eigenvalues(count: int) -> NDArray[np.float64]:
    """Return the first roots of ``1 + cos z cosh z = 0``, shape (count,); cached and read-only."""
    z = clamped_free_eigenvalues(count)
    z.flags.writeable = False
    return z


_FILTERS: Final = ("filter_time_constant_s", "second_order_filter_time_constant_s")
_BUTTERWORTH: Final = 2**0.5


def torque_channel(
    plant: Plant, s: NDArray[np.complexfloating[Any, Any]]
) -> NDArray[np.complex128]:
    """Return the factor of delay and filters of the torque channel, of the shape of `s`.

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
    """Return the denominator of a filter."""
    if name == "filter_time_constant_s":
        return 1 + constant_s * s
    return 1 + constant_s * (_BUTTERWORTH * s + constant_s * s * s)


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
        """Return the grid, shape (n,)."""
        return self._s

    def evaluate(
        self,
        plant: Plant,
        wrt: Sequence[str] = (),
        angle: NDArray[np.complex128] | float = 1.0,
    ) -> NDArray[np.complex128]:
        """Return the torque for an angle, and its derivatives.

        Parameters
        ----------
        plant : Plant
            Where to evaluate.
        wrt : sequence of str
            Names from `rigd.beam.PARAMETERS`, "delay_s" and "tool_inertia_kg_m2"; for each
            derivative all others are constant.
        angle : ndarray of complex, shape (n,), or float
            Transform of the angle.

        Returns
        -------
        ndarray of complex, shape (1 + k, n)
            The torque's transform, then the derivatives in the order of `wrt`.
        """
        response, rows = self._of_beam(plant, wrt)
        if plant.root_compliance_rad_per_nm:
            softened = 1 / (1 + plant.root_compliance_rad_per_nm * response)
            for name in rows:
                rows[name] = rows[name] * softened**2
            response = response * softened
        response += plant.tool_inertia_kg_m2 * self._s_squared
        rows["tool_inertia_kg_m2"] = self._s_squared
        late = torque_channel(plant, self._s) * angle
        if "delay_s" in wrt:
            rows["delay_s"] = -self._s * response
        found = np.empty((1 + len(wrt), late.size), dtype=np.complex128)
        for out, row in zip(found, [response, *(rows[name] for name in wrt)], strict=True):
            np.multiply(row, late, out=out)
        return found

    def _of_beam(
        self, plant: Plant, wrt: Sequence[str]
    ) -> tuple[NDArray[np.complex128], dict[str, NDArray[np.complex128]]]:
        """Return G on a rigid clamp, and its derivatives by the names in `wrt` that affect it."""
        of_beam = [name for name in wrt if name in PARAMETERS]
        if plant.tip_mass_kg or plant.stiffness_offsets:
            found, slopes = differentiated_response(
                self._log_s,
                self._s_squared,
                plant.beam,
                plant.damping,
                plant.tip_mass_kg,
                plant.stiffness_offsets,
            )
            return found.response, {name: slopes[name]() for name in of_beam}
        if not of_beam:
            return self._beam.evaluate(plant.beam, plant.damping), {}
        response, gradient = self._beam.evaluate_with_gradient(plant.beam, plant.damping, of_beam)
        return response, dict(zip(of_beam, gradient, strict=True))


# Prediction

_PADDED: Final = 1.1
_DECAY: Final = 6.6
"""sigma times the padded duration. What wraps round shrinks by exp(-6.6), to 1e-3 of what a beam
still does after a whole record, and is a free decay, of which no fit takes notice; rounding and
what the decimation left beyond the band grow by exp(6.6 / 1.1) = 400."""


class TorquePredictor:
    """Prediction of the torque from one angle, with derivatives by the parameters.

    A finite convolution by discrete transforms wraps around, and a lightly damped beam rings longer
    than any padding. So the angle is multiplied with exp(-sigma t) before the transform, which
    gives its Laplace transform on s = sigma + j omega. It is multiplied with the response there,
    and after the inverse transform the exponential is removed: the part that wrapped around has
    decayed.

    Parameters
    ----------
    angle_rad : ndarray, shape (n,)
        From rest, band-limited: nothing left at half the rate.
    rate_hz : float
    retained : slice
        Retained samples of the prediction.
    """

    __slots__ = (
        "_decay",
        "_growth",
        "_length",
        "_response",
        "_retained",
        "_sigma",
        "_spectrum",
        "rate_hz",
    )

    def __init__(self, angle_rad: NDArray[np.float64], rate_hz: float, retained: slice) -> None:
        self.rate_hz = rate_hz
        self._retained = retained
        self._length = fast_length(int(np.ceil(_PADDED * angle_rad.size)))
        self._sigma = sigma = _DECAY * rate_hz / self._length
        time_s = np.arange(angle_rad.size) / rate_hz
        bins = np.arange(self._length // 2 + 1)
        self._response = ResponseGrid(sigma + 2j * np.pi * rate_hz / self._length * bins)
        self._decay = np.exp(-sigma * time_s)
        self._spectrum = np.fft.rfft(angle_rad * self._decay, self._length)
        self._growth = np.exp(sigma * time_s[retained])

    def of_other(self, angle_rad: NDArray[np.float64]) -> TorquePredictor:
        """Return the prediction from another angle of the same length, shape (n,)."""
        other = copy(self)
        other._spectrum = np.fft.rfft(angle_rad * self._decay, self._length)
        return other

    @property
    def s(self) -> NDArray[np.complex128]:
        """Return the grid of the Laplace variable for responses, in rad/s."""
        return self._response.s

    def in_time(self, responses: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the torque of any responses to the angle at the retained samples, (..., m).

        Parameters
        ----------
        responses : ndarray of complex, shape (..., n)
            On `s`.
        """
        spectra = responses * self._spectrum
        torque: NDArray[np.float64] = np.fft.irfft(spectra, self._length)[..., self._retained]
        return torque * self._growth

    def torque(
        self, plant: Plant | ModalModel, wrt: Sequence[str] = ()
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the torque in N·m at the retained samples, and its derivatives.

        Parameters
        ----------
        plant : Plant or ModalModel
            Where to evaluate.
        wrt : sequence of str
            Names as for `ResponseGrid.evaluate`; none for a modal model.

        Returns
        -------
        torque : ndarray, shape (m,)
        gradient : ndarray, shape (k, m)
        """
        spectra = self._spectra(plant, wrt)
        in_time = np.fft.irfft(spectra, self._length)[:, self._retained] * self._growth
        return in_time[0], in_time[1:]

    def _spectra(self, plant: Plant | ModalModel, wrt: Sequence[str]) -> NDArray[np.complex128]:
        """Return the transform of the torque and its derivatives, shape (1 + k, n)."""
        if isinstance(plant, ModalModel):
            return (plant.response(self.s) * self._spectrum)[None]
        return self._response.evaluate(plant, wrt, self._spectrum)

    def torque_between(
        self,
        plant: Plant | ModalModel,
        factor: int,
        indices: NDArray[np.intp],
        wrt: Sequence[str] = (),
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the torque at single indices of a multiple of the rate, and its derivatives.

        Parameters
        ----------
        plant : Plant or ModalModel
            Beam and rig.
        wrt : sequence of str
            Names of the derivatives, k of them.
        factor : int
            Rate, in multiples of `rate_hz`.
        indices : ndarray of int, shape (p,)
            Samples of that rate, from the angle's first sample on.

        Returns
        -------
        torque : ndarray, shape (p,)
        gradient : ndarray, shape (k, p)
        """
        growth = np.exp(self._sigma * indices / (factor * self.rate_hz))
        spectra = self._spectra(plant, wrt)
        # As many short transforms, each of them shifted by a tick, as the factor says: they stay
        # in the cache, and take less than half the time of a long one.
        shifts = np.ones((factor, spectra.shape[1]), dtype=np.complex128)
        shifts[1:] = np.exp(2j * np.pi / (factor * self._length) * np.arange(spectra.shape[1]))
        np.cumprod(shifts, axis=0, out=shifts)
        if self._length % 2 == 0:
            shifts[:, -1] *= 2  # at the longer length this bin and its mirror image are two
        at = np.empty((len(spectra), indices.size))
        for row, spectrum in zip(at, spectra, strict=True):
            row[:] = np.fft.irfft(shifts * spectrum, self._length).T.ravel()[indices]
        at *= growth
        return at[0], at[1:]
