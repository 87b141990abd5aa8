"""What the loop talks to: contracts, their parameters, and the registry of drivers."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
