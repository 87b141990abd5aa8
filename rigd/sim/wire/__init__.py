"""Simulated rig on a CAN bus and serial line, with nodes for CANopen, NETCANOEM and Modbus RTU.

`run_simulator` is the process of ``rigd simulate``, `SimulatorOptions` its options; `parse_fault`
and `inject` inject faults while it runs. The protocols are implemented independently of the
drivers, so that an error in one implementation is found by the other.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
