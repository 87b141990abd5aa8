"""Detection and estimation of touches of the beam, from its torque and base shear.

Offers the innovations of the free beam (`observed_beam`, `InnovationFilter`), which the control
loop computes tick by tick, and the sequential test on them (`detector_model`, `TouchDetector`).

`TouchEstimator` estimates one touch after another with one model of the beam (`TouchModel`, from an
analysis or from the profile). It estimates point, instant, force and stiffness with intervals, and
the kind of obstacle (`TouchEstimate`). Its input is a `TouchRecord`: angle, torque and base shear
from 0.3 s or more before the touch (`samples.touch_record`). The touch estimator's process and the
analyser use it in the same way. It depends on no rig and no file but the analyser's
document.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
