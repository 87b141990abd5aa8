from .estimate import EstimateError as EstimateError
from .estimate import MotorEstimate as MotorEstimate
from .estimate import estimate_motor as estimate_motor
from .proposal import Proposal as Proposal
from .proposal import propose as propose
from .records import read_recording as read_recording
