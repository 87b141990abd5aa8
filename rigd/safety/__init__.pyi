from ._beam_prediction import BeamPrediction as BeamPrediction
from ._encoder_watch import ENCODER_FAILURE_S as ENCODER_FAILURE_S
from ._encoder_watch import EncoderWatch as EncoderWatch
from ._monitor import SLOW_CHECK_TICKS as SLOW_CHECK_TICKS
from ._monitor import LimitWatch as LimitWatch
from ._scale_watch import ScaleWatch as ScaleWatch
from ._sensor_watch import SensorWatch as SensorWatch
