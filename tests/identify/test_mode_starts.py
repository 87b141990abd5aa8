"""Where the search for each mode starts: at the mode of the best beam, or where it would lie."""

from types import SimpleNamespace

import numpy as np
import pytest

from analysis.identify import ModeEstimate
from analysis.identify._record_model import fit_modal_model


def test_a_mode_that_is_overdamped_in_the_best_beam_is_searched_at_a_uniform_beam_s(monkeypatch):
    monkeypatch.setattr(
        "analysis.identify._record_model.fit_modes", lambda _data, _noise, starts, _spectra: starts
    )
    modes = (
        ModeEstimate(1, 0.0, 0.0, 1.3, 0.1),
        ModeEstimate(2, 16.0, 1e-3, 4e-3, 1e-4),
        ModeEstimate(3, 45.0, 1e-3, 9e-3, 1e-4),
    )
    candidates = SimpleNamespace(
        misread_findings=False, likeliest_fit=SimpleNamespace(modes=modes), noise=None,
        effect_spectra=np.empty((0, 3)), comparison=SimpleNamespace(drag=None),
    )  # fmt: skip
    (number, frequency_hz, damping_ratio), *others = fit_modal_model(candidates)
    assert number == 1
    assert frequency_hz == pytest.approx(16.0 * (1.87510 / 4.69409) ** 2, rel=1e-5)
    assert 0 < damping_ratio < 0.1
    assert others == [(2, 16.0, 4e-3), (3, 45.0, 9e-3)]
