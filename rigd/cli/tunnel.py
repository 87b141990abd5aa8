"""How a view of this computer is looked at from another one."""

import platform
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigd.live.address import LiveAddress


def tunnel_advice(view: "LiveAddress") -> str:
    """Return what to type on the other computer."""
    page, grpc = view.page_port, view.grpc_port
    return (
        f"From another computer: ssh -L {page}:127.0.0.1:{page} -L {grpc}:127.0.0.1:{grpc} "
        f"{platform.node()}, and open http://127.0.0.1:{page} there."
    )
