"""The paper's method: Welch estimate, fits of Eq. (26) with two weightings, indices."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
