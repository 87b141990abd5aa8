"""The daemon: a rig that stays connected, and the socket over which it is operated.

Offers the daemon itself (`run_daemon`), its clients (module `client`), where its socket is (module
`address`), and the stop of all that runs for a user, without a daemon too (`stop_all`). The states
and what leads from one to another are in `_states`, requests in `_protocol`, sockets in `_server`;
`_service` owns the rig. Sessions are run by `rigd.runner`, as in the foreground.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
