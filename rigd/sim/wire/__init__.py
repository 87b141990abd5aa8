"""The simulated rig on the wire: nodes that speak CANopen, NETCANOEM and Modbus RTU.

Offers the process of ``rigd simulate`` (`run_simulator`), its options (`SimulatorOptions`) and
faults to inject while it runs (`parse_fault`, `inject`). Protocols are implemented again here, not
shared with the drivers, so that an error in one shows against the other.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
