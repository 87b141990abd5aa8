from ._beam_prediction import BeamPrediction as BeamPrediction
from ._encoder_monitor import ENCODER_FAILURE_S as ENCODER_FAILURE_S
from ._encoder_monitor import EncoderMonitor as EncoderMonitor
from ._limit_monitor import SLOW_CHECK_TICKS as SLOW_CHECK_TICKS
from ._limit_monitor import LimitMonitor as LimitMonitor
from ._scale_monitor import ScaleMonitor as ScaleMonitor
from ._sensor_monitor import SensorMonitor as SensorMonitor
