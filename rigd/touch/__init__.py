"""Detection and estimation of touches of the beam, from its torque and base shear.

Offers the innovations of the free beam (`observed_beam`, `InnovationFilter`), which the control
loop computes in each tick, and the detector that tests them (`detector_model`, `TouchDetector`).

`TouchEstimator` estimates one touch after another with one model of the beam (`TouchModel`, from an
analysis or from the profile). It estimates position, instant, force and stiffness with intervals,
and the kind of obstacle (`TouchEstimate`). Its input is a `TouchRecord`: angle, torque and base
shear from 0.3 s or more before the touch (`samples.touch_record`). The touch estimator's process
and the analyser use it in the same way. The package depends on no rig, and on no file except the
analyser's document.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
