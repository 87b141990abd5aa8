"""What Rerun shows of a session: its layout, and what becomes of samples, events and health in it.

Rerun takes half a second to import, so it is imported by the functions that need it.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
