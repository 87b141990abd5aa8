"""The daemon: a rig that stays connected, and the socket over which it is operated.

The public interface is the daemon itself (`run_daemon`), its clients (module `client`), the address
of its socket (module `address`), and the stop of everything that runs for a user, with or without a
daemon (`stop_all`). `_states` has the states and their transitions, `_protocol` the requests,
`_server` the sockets, and `_service` owns the rig. `rigd.runner` runs the sessions, as in the
foreground.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
