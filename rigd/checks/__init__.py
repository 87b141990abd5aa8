"""``rigd check``: all checks of a rig that need no torque, in rows.

Offers the whole check (`check_rig`) and the part that every session runs (`run_offline_checks`). In
this order: what profile and EDS file show (module `offline`, listed in `_offline_checks`),
this computer (`machine`), the devices (`devices`). Each check gives a list of `CheckRow`, each row
with its verdict. No torque is ever commanded.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
