from ._dynamics import LinearModelError as LinearModelError
from ._exported import DEFAULT_SAMPLES as DEFAULT_SAMPLES
from ._exported import LinearModel as LinearModel
from ._exported import ModelOptions as ModelOptions
from ._exported import linear_model as linear_model
from ._identified import identified_in_document as identified_in_document
from ._identified import identified_in_session as identified_in_session
from ._pole_fit import INPUT_KINDS as INPUT_KINDS
