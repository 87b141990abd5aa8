from ._dynamics import LinearModelError as LinearModelError
from ._exported import DEFAULT_POSTERIOR_SAMPLES as DEFAULT_POSTERIOR_SAMPLES
from ._exported import LinearModel as LinearModel
from ._exported import ModelOptions as ModelOptions
from ._exported import linear_model as linear_model
from ._identified import identify_session as identify_session
from ._identified import read_identified_model as read_identified_model
from ._pole_fit import INPUT_KINDS as INPUT_KINDS
