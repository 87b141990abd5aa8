"""The daemon of `rigd serve`, which stays connected to a rig and is operated through a socket.

The public interface is the daemon itself (`run_daemon`), the client side (module `client`), the
address of its socket (module `address`), and the stop of all sessions of a user, with or without a
daemon (`stop_all`). `_states` contains the states and their transitions, `_protocol` the requests,
and `_server` the sockets. `_service` controls the rig. The sessions are run by `rigd.runner`, as
for `rigd run`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
