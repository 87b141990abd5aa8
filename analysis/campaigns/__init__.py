"""Joint analysis of many sessions of one specimen: statistics, pooled estimates, validation.

`campaign` analyses the files in parallel (`SessionTask`, `process_pool`) and returns a
`CampaignResult`: the result of each session, the pooled estimate of each structure, whether the
sessions are of one specimen, and a verdict. The package only computes; `analysis.report` writes
tables, pages and files.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
