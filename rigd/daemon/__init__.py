"""The daemon: a rig that stays connected, and the socket over which it is operated."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
