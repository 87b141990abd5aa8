"""Identification of the motor from recorded sessions: experiments, estimate, proposal.

Offers the reading of recorded sessions (`read_recording`) and the proposal for the profile
(`propose`). Public modules: `experiments` (the sessions that identify a motor) and `estimate`
(inertia, friction, torque scale and delay). It runs no session: ``rigd identify`` does. The beam is
identified by the analyser, from other sessions.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
