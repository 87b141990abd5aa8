"""The supervisor: starts the processes of a rig, has them run sessions, and ends them."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
