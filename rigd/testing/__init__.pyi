from ._device_checks import DEVICE_CHECKS as DEVICE_CHECKS
from ._profiles import write_profile as write_profile
from ._sessions import PAPER_BEAM as PAPER_BEAM
from ._sessions import PAPER_DAMPING as PAPER_DAMPING
from ._sessions import Signals as Signals
from ._sessions import beam_torque as beam_torque
from ._sessions import chirp_signals as chirp_signals
from ._sessions import write_session as write_session
