"""Output-error identification of one record: the exact model against every sample in the band.

`Measurement` holds the data of a record; `fit_record` fits structures to it, and `select` chooses
the one that the data support, with a `Verdict` in words and a `Headline` in numbers. It knows
nothing of other sessions, of report pages, or of how a record came into its file.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
