"""p-values and quantiles of the analyzer's test distributions; the fit in per cent.

They use `scipy.special`, since `scipy.stats` takes four times as long to import. It is imported on
first use, since a command that prints its help needs none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

NORMAL_95: Final = 1.959963984540054
"""Two-sided 95 % point of the standard normal distribution."""
KOLMOGOROV_95: Final = 1.3581
"""95 % point of the Kolmogorov statistic times the root of the count."""

_SMALLEST: Final = 1e-290
"""Tail probability below which its logarithm is taken from the tail's asymptotic expansion."""


def chi_square_p_value(value: ArrayLike, degrees_of_freedom: float) -> NDArray[np.float64]:
    """Return the probability that a chi-square is at least `value`, of the shape of `value`.

    Parameters
    ----------
    value : array_like
        Chi-square, not negative.
    degrees_of_freedom : float
        Above 0.

    Examples
    --------
    >>> from analysis.statistics import chi_square_p_value
    >>> print(chi_square_p_value([3.841, 10.83], 1).round(4))
    [0.05  0.001]
    """
    from scipy.special import chdtrc

    p_value: NDArray[np.float64] = chdtrc(degrees_of_freedom, value)
    return p_value


def chi_square_deviate(value: float, degrees_of_freedom: float) -> float:
    """Return the standard normal deviate with the tail probability of a chi-square.

    It is finite for any `value`, also where the probability underflows.

    Parameters
    ----------
    value : float
        Chi-square, not negative.
    degrees_of_freedom : float
        Above 0.

    Examples
    --------
    >>> from analysis.statistics import chi_square_deviate
    >>> round(chi_square_deviate(3.841, 1), 3)
    1.645
    """
    from scipy.special import chdtr, chdtrc, gammaln, ndtri_exp

    a, x = degrees_of_freedom / 2, max(value / 2, np.finfo(float).tiny)
    above = x > a
    tail = float((chdtrc if above else chdtr)(2 * a, 2 * x))
    if tail > _SMALLEST:
        log_tail = np.log(tail)
    elif above:
        # Leading terms of the incomplete gamma functions far from their middle, summed as geometric
        # series (NIST DLMF 8.11.2 and 8.11.4): the deviate is off by less than 1e-4 there.
        log_tail = (a - 1) * np.log(x) - x - np.log1p(-(a - 1) / x) - gammaln(a)
    else:
        log_tail = a * np.log(x) - x - np.log1p(-x / (a + 1)) - gammaln(a + 1)
    deviate = float(ndtri_exp(log_tail))
    return -deviate if above else deviate


def kolmogorov_p_value(statistic: float) -> float:
    """Return the p-value of the Kolmogorov statistic times the root of the count.

    Examples
    --------
    >>> from analysis.statistics import kolmogorov_p_value
    >>> round(kolmogorov_p_value(1.3581), 4)
    0.05
    """
    from scipy.special import kolmogorov

    return float(kolmogorov(statistic))


def student_t_quantile(level: float, degrees_of_freedom: float) -> float:
    """Return the two-sided quantile of Student's t: ± it holds a fraction `level`.

    Parameters
    ----------
    level : float
        Fraction, 0 to 1.
    degrees_of_freedom : float
        Above 0.

    Examples
    --------
    >>> from analysis.statistics import student_t_quantile
    >>> round(student_t_quantile(0.95, 9), 3)
    2.262
    """
    from scipy.special import stdtrit

    return float(stdtrit(degrees_of_freedom, (1 + level) / 2))


def nrmse_percent(residual: NDArray[Any], measured: NDArray[Any]) -> float:
    """Return the fit in %, as ``compare`` of MATLAB's System Identification Toolbox defines it.

    ``100 (1 - |residual| / |measured - its mean|)``: 100 for a perfect model, 0 for one that is no
    better than the mean, below 0 for one that is worse.

    Parameters
    ----------
    residual : ndarray, shape (n,)
        Measured less modelled, real or complex.
    measured : ndarray, shape (n,)
        The mean already taken out, such as the part of a spectrum without its first bin.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.statistics import nrmse_percent
    >>> measured = np.array([3.0, -4.0])
    >>> nrmse_percent(0.1 * measured, measured)
    90.0
    """
    return 100 * (1 - float(np.linalg.norm(residual)) / float(np.linalg.norm(measured) or np.nan))
