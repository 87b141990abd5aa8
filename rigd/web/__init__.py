"""The operator's page: a server on loopback, in its own process beside the daemon.

It speaks to the daemon by the public control socket only (docs/control_socket.md) and reads session
files; loop, recorder and daemon do not depend on it. `run_page` is its program: `_server` puts the
routes together, `_access` says who may do what, `_link` follows the daemon, `_live` sends to the
pages that are open what `_signals` makes of the signals, `_library` serves sessions, downloads and
reports. The page itself is in `static`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
