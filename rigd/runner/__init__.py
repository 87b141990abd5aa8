"""The supervisor, which plans sessions, and starts, monitors and ends the processes of a rig.

The package offers the process group (`ProcessGroup`), the rig (`Rig`), series of sessions
(`Series`), the sessions of `rigd run` (`run_in_foreground`) and their text on a terminal
(`plan_lines`, `ProgressLine`, `result_line`). The public modules are the prediction of a session
(`planning`), the preparation of a session and its file (`request`), the supervision of one session
(`session`), the quick looks after a session (`quick_looks`), and the status and signals of a
running session (`status`, `signal_blocks`). The supervisor does not control the motor: if `session`
detects a dead or hung process, it requests a stop from the control process, which switches the
torque off (`rigd.engine.control_process`).
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
