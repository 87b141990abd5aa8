"""The supervisor: plans sessions, starts the processes of a rig, has them run, and ends them.

Offers planning (`plan_session`, `predict_session`, `largest_amplitude`, `LoopPreview`), a request
and its file (`Order`, `load_rig`), the processes (`ProcessGroup`), the rig on which sessions are
run (`Rig`), sessions that follow each other (`Series`) and those in the foreground
(`run_in_foreground`). It moves nothing itself: a dead or hung process is noticed in `session`,
which asks the control process to stop; that switches the torque off
(`rigd.engine.control_process`).
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
