"""The control process and the recorder process, and the shared memory between them.

Offers the memory (`Channels`, `SharedState`, `Ring`), the processes' table and messages
(`PROCESSES`, `Child`, `Parent`), one tick (`Cycle`), clocks and real-time settings (`obtain`). The
programs are `control_process`, which alone talks to the devices and switches the torque off, and
`recorder`.
`PROCESSES` says what follows when a process dies; `rigd.runner` watches them and asks for the stop.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
