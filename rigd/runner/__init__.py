"""The supervisor: plans sessions, starts the processes of a rig, has them run, and ends them.

Offers the processes (`ProcessGroup`), the rig on which sessions are run (`Rig`), sessions that
follow each other (`Series`), those in the foreground (`run_in_foreground`) and what a terminal
shows of them (`plan_lines`, `ProgressLine`, `result_line`). The public modules are what a session
will do (`planning`), its request and its file (`request`), one session and its result (`session`),
the quick looks that follow (`quick_looks`), and what is seen of a running one (`status`,
`signal_blocks`). Nothing is moved here: a dead or hung process is noticed in `session`, which asks
the control process to stop; that switches the torque off (`rigd.engine.control_process`).
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
