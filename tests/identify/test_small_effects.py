"""Effects in addition to a linear antenna for which the first order in their size suffices."""

import numpy as np
import pytest
from cases import further

from analysis.identify import select
from rigd.beam import modes

pytestmark = pytest.mark.fit

RATE_HZ = 1000.0
NOISE_NM = 5e-3


def rubbed(made, friction_nm, sliding_rad_s):
    """Return the session with dry friction between sensor and beam."""
    speed_rad_s = np.gradient(made.angle_rad) * RATE_HZ
    torque_nm = made.torque_nm + friction_nm * np.tanh(speed_rad_s / sliding_rad_s)
    return type(made)(made.angle_rad, torque_nm)


@pytest.mark.parametrize("sliding_rad_s", [0.003, further(0.03)])
def test_dry_friction_is_reported_without_bias_of_modes(sessions, plants, link, sliding_rad_s):
    """A torque of known sign that grows with nothing: no harmonic, no order, no stiffness."""
    selection = select(rubbed(sessions("III"), 0.01, sliding_rad_s).measured(NOISE_NM, 3))
    (finding,) = selection.verdict.findings
    assert finding.kind == "friction"
    assert (finding.value, finding.interval) == (None, None)
    headline = selection.headline
    assert headline.is_explained
    assert headline.uniform_beam.status == "passed"
    for mode, true in zip(headline.modes, modes(link, plants["III"], 3), strict=True):
        for found, expected in (
            (mode.frequency_hz, true.frequency_hz),
            (mode.damping_ratio, true.damping_ratio),
        ):
            assert found.flag is None
            assert abs(found.value - expected) < 4 * found.std
    assert selection.verdict.alpha.status == "compatible"
