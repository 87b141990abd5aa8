"""``rigd bench``: how punctual the loop is on this computer, and which rate it can hold."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
