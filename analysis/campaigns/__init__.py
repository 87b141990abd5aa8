"""Many sessions of one specimen together: statistics, nominal models, pooled estimate, validation.

`campaign` analyses the files in parallel (`SessionTask`, `process_pool`) and returns a
`CampaignResult`: what each session gives, the pooled estimate of every structure, whether the
sessions are of one specimen, and a verdict. It computes only; tables, pages and files are made by
`analysis.report`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
