"""``rigd bench``: how punctual the loop is on this computer, and which rate it can hold.

Offers the programme of measurements (`Bench`), their results (`Results`), one measurement and its
figures (module `measure`), and the report (`report_lines`, `as_json`). Real sessions are run on a
simulated rig, with cyclictest as the peer; no hardware is touched, and nothing is changed on this
computer.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
