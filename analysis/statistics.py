"""p-values and quantiles of test statistics, thresholds of BIC differences, and fit in per cent.

They use `scipy.special`, since `scipy.stats` takes four times as long to import. It is imported on
first use, since a command that prints its help needs none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

NORMAL_95: Final = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""
KOLMOGOROV_95: Final = 1.3581
"""95 % quantile of the Kolmogorov statistic times the square root of the number of values."""

BIC_DECISIVE: Final = 10.0
"""Difference of BIC from which the worse structure may be dismissed (Kass and Raftery, J. American
Statistical Association 90 (1995) 773-795)."""
BIC_TIE: Final = 6.0
"""Difference of BIC below which the data do not distinguish two structures."""

_SMALLEST_TAIL_PROBABILITY: Final = 1e-290
"""Tail probability below which its logarithm is computed from an asymptotic expansion."""


def chi_square_p_value(chi_square: ArrayLike, degrees_of_freedom: float) -> NDArray[np.float64]:
    """Return the probability that a chi-square variable is at least `chi_square`.

    The result has the shape of `chi_square`.

    Parameters
    ----------
    chi_square : array_like
        Value of the chi-square variable, not negative.
    degrees_of_freedom : float
        Degrees of freedom, above 0.

    Examples
    --------
    >>> from analysis.statistics import chi_square_p_value
    >>> print(chi_square_p_value([3.841, 10.83], 1).round(4))
    [0.05  0.001]
    """
    from scipy.special import chdtrc

    p_value: NDArray[np.float64] = chdtrc(degrees_of_freedom, chi_square)
    return p_value


def chi_square_deviate(chi_square: float, degrees_of_freedom: float) -> float:
    """Return the standard normal deviate with the upper tail probability of a chi-square value.

    The deviate is finite for any `chi_square`, even if the probability underflows.

    Parameters
    ----------
    chi_square : float
        Value of the chi-square variable, not negative.
    degrees_of_freedom : float
        Degrees of freedom, above 0.

    Examples
    --------
    >>> from analysis.statistics import chi_square_deviate
    >>> round(chi_square_deviate(3.841, 1), 3)
    1.645
    """
    from scipy.special import chdtr, chdtrc, gammaln, ndtri_exp

    a, x = degrees_of_freedom / 2, max(chi_square / 2, np.finfo(float).tiny)
    is_in_upper_tail = x > a
    tail_probability = float((chdtrc if is_in_upper_tail else chdtr)(2 * a, 2 * x))
    if tail_probability > _SMALLEST_TAIL_PROBABILITY:
        log_tail_probability = np.log(tail_probability)
    elif is_in_upper_tail:
        # Leading terms of the incomplete gamma functions far from their middle, summed as geometric
        # series (NIST DLMF 8.11.2 and 8.11.4): the deviate is off by less than 1e-4 there.
        log_tail_probability = (a - 1) * np.log(x) - x - np.log1p(-(a - 1) / x) - gammaln(a)
    else:
        log_tail_probability = a * np.log(x) - x - np.log1p(-x / (a + 1)) - gammaln(a + 1)
    deviate = float(ndtri_exp(log_tail_probability))
    return -deviate if is_in_upper_tail else deviate


def kolmogorov_p_value(statistic: float) -> float:
    """Return the p-value of a Kolmogorov statistic that is scaled by the root of the sample size.

    Examples
    --------
    >>> from analysis.statistics import kolmogorov_p_value
    >>> round(kolmogorov_p_value(1.3581), 4)
    0.05
    """
    from scipy.special import kolmogorov

    return float(kolmogorov(statistic))


def student_t_quantile(confidence_level: float, degrees_of_freedom: float) -> float:
    """Return the half width of the central interval of Student's t at a confidence level.

    Parameters
    ----------
    confidence_level : float
        Probability of the interval, 0 to 1.
    degrees_of_freedom : float
        Degrees of freedom, above 0.

    Examples
    --------
    >>> from analysis.statistics import student_t_quantile
    >>> round(student_t_quantile(0.95, 9), 3)
    2.262
    """
    from scipy.special import stdtrit

    return float(stdtrit(degrees_of_freedom, (1 + confidence_level) / 2))


def student_t_p_value(statistic: float, degrees_of_freedom: float) -> float:
    """Return the probability that Student's t is at least as far from 0 as `statistic`.

    Parameters
    ----------
    statistic : float
        Value of the variable.
    degrees_of_freedom : float
        Degrees of freedom, above 0.

    Examples
    --------
    >>> from analysis.statistics import student_t_p_value
    >>> round(student_t_p_value(-2.262, 9), 3)
    0.05
    """
    from scipy.special import stdtr

    return 2 * float(stdtr(degrees_of_freedom, -abs(statistic)))


def nrmse_percent(residual: NDArray[Any], measured: NDArray[Any]) -> float:
    """Return the fit in %, as ``compare`` of MATLAB's System Identification Toolbox defines it.

    It is ``100 (1 - |residual| / |measured - mean|)``: 100 for a perfect model, 0 for a model that
    is as good as the mean, and negative for a worse model.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Measured minus modelled values, real or complex.
    measured : ndarray, shape (n,)
        Measured values without their mean, such as a spectrum without its first bin.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.statistics import nrmse_percent
    >>> measured = np.array([3.0, -4.0])
    >>> nrmse_percent(0.1 * measured, measured)
    90.0
    """
    return 100 * (1 - float(np.linalg.norm(residual)) / float(np.linalg.norm(measured) or np.nan))
