"""The CAN bus under the drivers: frames, ports to send and receive them, and the exchange.

A port (`port.open_port`) carries frames of the kernel's ``struct can_frame`` without blocking.
Where the kernel has CAN sockets it is one of those; the bus of ``rigd simulate`` is a Unix socket
that carries the same 16 bytes; every other adapter goes through python-can. The drivers see no
difference: `CanExchange` routes frames to them, `ReplyPairing` assigns replies to requests,
`bus_load` and `check_identifiers` check a profile before anything is connected.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
