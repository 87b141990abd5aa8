from ._proposal import Proposal as Proposal
from ._proposal import propose as propose
from ._proposal import with_cautious_controller as with_cautious_controller
from ._proposal import with_tuned_controller as with_tuned_controller
from ._records import read_recording as read_recording
