"""What a search is said to have come to, once the whole record is fitted."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from rigd.engine import FitTold, SearchEnded
from rigd.excitation import parse_target
from rigd.runner._online_fit import OnlineFit

REACHED = SearchEnded(True, "Reached: damping of mode 1 0.009, standard deviation 8e-05.", {})
NOT_REACHED = SearchEnded(False, "Not reached within 20 s (--at-most).", {})


def of_whole_record(std: float) -> FitTold:
    damping = {"value": 0.01, "std": std, "flag": None, "std_any_rig": None}
    mode = {
        "mode": 1,
        "frequency_hz": damping | {"value": 2.5},
        "damping_ratio": damping,
        "shown": True,
    }
    return FitTold({"modes": [mode], "parameters": {}, "text": []}, final=True)


@pytest.mark.parametrize(
    ("ended", "std", "reached", "reason"),
    [
        (REACHED, 0.9e-4, True, "Reached: damping of mode 1 0.009, standard deviation 8e-05."),
        (REACHED, 2e-4, False, "Reached on the way, but not by the whole record. So far: damping"),
        (NOT_REACHED, 0.9e-4, True, "Reached by the fit of the whole record."),
        (NOT_REACHED, 2e-4, False, "Not reached within 20 s (--at-most). So far: damping of mode"),
        (None, 2e-4, False, "So far: damping of mode 1 0.01"),
    ],
)
def test_reason_and_result_agree(ended, std, reached, reason):
    group = MagicMock()
    told = [each for each in (ended, of_whole_record(std)) if each is not None]
    group.__getitem__().messages.return_value = told
    search = SimpleNamespace(targets=(parse_target("damping", "1%"),))
    fit = OnlineFit(group, MagicMock(), MagicMock(), search)
    fit.begin(MagicMock())
    found = fit.finish(9000, lambda: None)["search"]
    assert found["reached"] == reached
    assert found["reason"].startswith(reason)
    assert (fit.shortcoming == "") == reached
