"""Many sessions together: statistics, nominal models, pooled estimate, validation."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
