"""The CAN bus under the drivers: frames, ports to send and receive them, and the exchange.

A port carries frames of the kernel's ``struct can_frame`` without blocking. Where the kernel has
CAN sockets it is one of those; the bus of ``rigd simulate`` is a Unix socket that carries the same
16 bytes; every other adapter goes through python-can. The drivers see no difference.
"""

from rigd.devices.canbus.exchange import CanExchange, CanLink
from rigd.devices.canbus.port import (
    BUS_OFF_FRAME,
    FRAME_SIZE,
    CanPort,
    open_port,
    pack_frame,
    unpack_frame,
)

__all__ = [
    "BUS_OFF_FRAME",
    "FRAME_SIZE",
    "CanExchange",
    "CanLink",
    "CanPort",
    "open_port",
    "pack_frame",
    "unpack_frame",
]
