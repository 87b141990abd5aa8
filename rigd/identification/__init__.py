"""Identification of the motor from recorded sessions: experiments, estimate, proposal.

Offers the sessions that identify a motor (`trial_session`, `multisine_session`, `speeds_session`),
the estimate of inertia, friction, torque scale and delay (`estimate_motor`) and what it proposes
for the profile (`propose`). It runs no session: ``rigd identify`` does. The beam is identified by
the analyser, from other sessions.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
