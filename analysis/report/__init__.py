"""What people and programs are shown of an analysis: tables, figures, a JSON document."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
