"""``rigd check``: everything that can be known of a rig before a torque acts, in rows.

Offers the whole check (`check_rig`), its part that every session asks for (`check_on_paper`), the
check of an EDS file alone (`eds_rows`), and the rows with their verdict (`Row`, `Verdict`,
`print_table`). In this order: what profile and EDS show (`_on_paper`, listed in `_gate`), this
computer (`_machine`), the devices (`_devices`). No torque is ever commanded.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
