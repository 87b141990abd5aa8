"""Welch method of the reference paper: Welch's estimate, fits of Eq. (26), and indices.

Module `welch_analysis` runs the whole method on a record (`analyse`), and has the fit indices and
peak deviations of Eqs. (28) to (32). `estimate` only estimates the response, `fit_frf` and
`fit_many` only fit models to a response.
The package follows the paper without corrections, for comparison, and is independent of
`analysis.identify`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
