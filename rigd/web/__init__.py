"""The operator's page: a server on loopback, in a separate process.

It uses only the daemon's public control socket (docs/control_socket.md) and reads session files.
Loop, recorder and daemon do not depend on it. `run_page` is its program. `_server` has the routes,
`_access` the permissions, and `_link` the connection to the daemon. `_live` sends messages to the
open pages, `_signals` prepares the signals, and `_library` serves sessions, downloads and reports.
Folder `static` has the page itself.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
