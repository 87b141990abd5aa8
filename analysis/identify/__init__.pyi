from . import beam_uniformity as beam_uniformity
from . import drag_torque as drag_torque
from . import free_decay as free_decay
from . import headline as headline
from . import noise as noise
from . import parametrization as parametrization
from . import profile_likelihood as profile_likelihood
from . import residual_tests as residual_tests
from . import scales as scales
from . import sentences as sentences
from . import tolerant_estimate as tolerant_estimate
from . import uniform_beam as uniform_beam
from . import verdict as verdict
from ._candidate import Candidate as Candidate
from ._comparison import Comparison as Comparison
from ._data import Measurement as Measurement
from ._data import MeasurementError as MeasurementError
from ._estimates import DampingSize as DampingSize
from ._estimates import ModeEstimate as ModeEstimate
from ._finding import Finding as Finding
from ._fit import BAND_HZ as BAND_HZ
from ._fit import fit_record as fit_record
from ._headline_json import headline_json as headline_json
from ._modal_fit import ModalFit as ModalFit
from ._modal_headline import effective_reason as effective_reason
from ._modal_headline import (
    loss_factors_with_geometry_tolerance as loss_factors_with_geometry_tolerance,
)
from ._modal_headline import (
    order_status_with_geometry_tolerance as order_status_with_geometry_tolerance,
)
from ._modal_headline import replace_by_modal_model as replace_by_modal_model
from ._modal_headline import uniform_beam_refusal_reason as uniform_beam_refusal_reason
from ._modal_model import BACKGROUND_COEFFICIENTS as BACKGROUND_COEFFICIENTS
from ._modal_model import MODE_CONSTANT_NAMES as MODE_CONSTANT_NAMES
from ._modal_model import ModalEstimate as ModalEstimate
from ._modal_model import ModalModel as ModalModel
from ._predictor import TorquePredictor as TorquePredictor
from ._problem import Objective as Objective
from ._result import RecordAnalysis as RecordAnalysis
from ._result import RecordFit as RecordFit
from ._select import ORDER_ONE_STRUCTURE as ORDER_ONE_STRUCTURE
from ._select import Selection as Selection
from ._select import fit_freest_alone as fit_freest_alone
from ._select import select as select
from ._settings import SETTINGS as SETTINGS
from ._settings import Setting as Setting
from ._structure_fit import StructureFit as StructureFit
from ._structure_fit import fit_structure as fit_structure
from ._uncertainty import damping_size as damping_size
