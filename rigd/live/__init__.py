"""The live view: a process that shows the samples in Rerun and that nothing waits for."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
