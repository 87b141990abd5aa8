"""CAN bus for the drivers: frames, ports to send and receive frames, and the cyclic exchange.

A port (`adapters.open_port`) sends and receives frames in the layout of the kernel's ``struct
can_frame`` without blocking. It is a CAN socket if the kernel has CAN sockets, a Unix socket with
the same 16 bytes for the bus of ``rigd simulate``, and python-can for every other adapter. The
drivers see no difference: `CanExchange` routes frames to them, `ReplyPairing` assigns replies to
requests, `bus_load` and `check_identifiers` check a profile before anything is connected.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
