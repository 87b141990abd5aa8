"""Identification of the motor from recorded sessions: experiments, estimate, proposal."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
