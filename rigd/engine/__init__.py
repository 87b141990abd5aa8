"""The control process and the recorder process, and the shared memory between them.

The public modules are the table of child processes (`workers`), the client of a child process and
its connection to the supervisor (`processes`), the messages between processes (`messages`), their
shared memory (`shared_state`, `channels`, `reference`, and `Ring` and `RingObserver` of this
package), one tick of the loop (`cycle`), clocks (`timing`) and real-time settings (`realtime`). The
programs
are `control_process`, which alone talks to the devices and switches the torque off, `recorder` and
`touch_estimator`. The table states what happens if a child process dies; `rigd.runner` monitors
the processes of a rig and requests the stop.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
