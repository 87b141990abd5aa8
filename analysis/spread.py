"""Covariance of the unknowns of a weighted least-squares fit of a frequency response.

It reads every deviation of the model from the measurement as chance. What that is worth, measured
on simulated sessions with type VI:

* errors that are independent from bin to bin: within 20 % of the scatter of repeated fits;
* errors shared by the nine neighbours that zero padding makes alike: half of that scatter, since
  a resonance is then narrower than one error and the fit absorbs most of it;
* Welch's estimate of a chirp: leakage, not noise, is what remains, and the standard deviations
  are 3 to 50 times the scatter between sessions. The bias itself is 1 to 7 times as large as
  they are, and 4 to 20 times if the structure is wrong.

So they rank parameters by how well the response determines them and are no confidence intervals.
"""

import numpy as np
from numpy.typing import NDArray


def sandwich_covariance(
    deviation: NDArray[np.complex128],
    jacobian: NDArray[np.complex128],
    weights: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """Covariance of the unknowns, ``A⁻¹ B A⁻¹``, from the deviations that remain.

    A is the Gauss-Newton Hessian and B the covariance of the gradient, summed over neighbouring
    bins as well as each bin alone (Newey and West, "A simple, positive semi-definite,
    heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 55 (1987)
    703-708): zero padding and the window make neighbours much alike.

    Parameters
    ----------
    deviation : ndarray of complex, shape (n,)
        Model minus measurement at the minimum.
    jacobian : ndarray of complex, shape (k, n)
    weights : ndarray, shape (n,)

    Returns
    -------
    ndarray, shape (k, k), or None
        None if the data do not determine the unknowns.
    """
    hessian = ((jacobian.conj() * weights) @ jacobian.T).real
    scale = np.sqrt(np.diag(hessian))
    if not (np.isfinite(hessian).all() and (scale > 0).all()):
        return None
    scaled = hessian / np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e12:
        return None
    scores = (jacobian.conj() * (weights * deviation)).real
    span = _alike(np.sqrt(weights) * deviation)
    # Bartlett's kernel over `span` bins is the mean square of sums over as many neighbours.
    reached = np.cumsum(np.pad(scores, ((0, 0), (span, span - 1))), axis=1)
    sums = reached[:, span:] - reached[:, :-span]
    middle = sums @ sums.T / span
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale)
    covariance: NDArray[np.float64] = inverse @ middle @ inverse
    return covariance


def _alike(deviation: NDArray[np.complex128]) -> int:
    """Count the neighbouring bins that deviate alike: twice the lag of half the correlation."""
    half = 0.5 * np.vdot(deviation, deviation).real
    # A few lags, so not by transforms: those would cost as much as the model on every point.
    for lag in range(1, deviation.size):
        if np.vdot(deviation[:-lag], deviation[lag:]).real < half:
            return 1 + 2 * lag
    return 1
