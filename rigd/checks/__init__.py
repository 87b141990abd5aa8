"""``rigd check``: everything that can be known of a rig before a torque acts, in rows."""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
