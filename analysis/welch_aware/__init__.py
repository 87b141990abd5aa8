"""Fits to a Welch estimate that know what Welch's windows do to it.

For data of which only the frequency response and the input are left: the model is put through the
same estimator before it is compared.
"""

from analysis.welch_aware.estimator import WelchAwareError
from analysis.welch_aware.fit import fit_welch_aware
from analysis.welch_aware.of_record import fit_record_welch_aware
from analysis.welch_aware.result import WelchAwareFit

__all__ = ["WelchAwareError", "WelchAwareFit", "fit_record_welch_aware", "fit_welch_aware"]
