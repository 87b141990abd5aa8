"""Output of an analysis for people and programs: tables, figures, pages and JSON documents.

Each table is defined once, as a `Table` (in the modules ``_…_tables``), and rendered for the
terminal, for a page, as CSV and as JSON. The pages are the files in ``templates``, which are filled
by `_page`. No other module of this package uses them.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
