"""Output-error estimation on whole records: the exact model against every sample in the band."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
