"""A CiA 402 servo drive over CANopen, in cyclic synchronous torque mode.

Offers the driver (`Cia402Drive`), the check of a drive's EDS file (`check_suitability`), and the
parser of the objects that a profile sets (`parse_assignment`).

Drives differ in what they support: the table in `requirements` lists what rigd needs; `objects` has
the indices of objects. Another package computes the torque that the driver commands.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
