"""Builders for tests of your own devices, excitations and analyses.

The package offers a profile with other values than a shipped one (`write_profile`), records of a
beam whose parameters are known (`chirp_signals`, `beam_torque`, `write_session`, with the reference
paper's `PAPER_BEAM` and `PAPER_DAMPING`), and checks of the behaviour that every drive and sensor
(`DEVICE_CHECKS`) and every controller (`CONTROLLER_CHECKS`) must have. No test framework is needed,
and none is imported.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
