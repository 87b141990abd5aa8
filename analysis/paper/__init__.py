"""Welch method of the reference paper: Welch's estimate, fits of Eq. (26), and indices.

`analyse` does all of it to a record, `estimate` the response alone, `fit_frf` and `fit_many` the
fits alone; `fit_indices` and `peak_deviation` are Eqs. (28) to (32). It contains no corrections: it
serves for comparison, and is independent of `analysis.identify`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
