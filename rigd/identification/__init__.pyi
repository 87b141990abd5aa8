from ._proposal import Proposal as Proposal
from ._proposal import cautious as cautious
from ._proposal import propose as propose
from ._proposal import tuned as tuned
from ._records import read_recording as read_recording
