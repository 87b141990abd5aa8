"""The result of a search after the fit of the whole record."""

from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from rigd.engine.messages import FitReport, SearchEnded
from rigd.engine.processes import ChildError
from rigd.engine.shared_state import StateField, StopReason
from rigd.excitation.targets import parse_target
from rigd.runner._online_fit import FitClient

REACHED = SearchEnded(True, "Reached: damping of mode 1 0.009, standard deviation 8e-05.", {})
NOT_REACHED = SearchEnded(False, "Not reached within 20 s (--at-most).", {})


def fit_of_record(std: float, *, final: bool = True) -> FitReport:
    damping = {"value": 0.01, "std": std, "flag": None}
    mode = {
        "mode": 1,
        "frequency_hz": damping | {"value": 2.5},
        "damping_ratio": damping,
        "shown": True,
    }
    return FitReport({"modes": [mode], "parameters": {}, "text": []}, final=final)


@pytest.mark.parametrize(
    ("ended", "std", "reached", "reason"),
    [
        (REACHED, 0.9e-4, True, "Reached: damping of mode 1 0.009, standard deviation 8e-05."),
        (REACHED, 2e-4, False, "Reached during the session, but not by the whole record."),
        (NOT_REACHED, 0.9e-4, True, "Reached by the fit of the whole record."),
        (NOT_REACHED, 2e-4, False, "Not reached within 20 s (--at-most). So far: damping of mode"),
        (None, 2e-4, False, "So far: damping of mode 1 0.01"),
    ],
)
def test_reason_and_result_agree(ended, std, reached, reason):
    group = MagicMock()
    messages = [each for each in (ended, fit_of_record(std)) if each is not None]
    group.__getitem__().messages.return_value = messages
    search = SimpleNamespace(targets=(parse_target("damping", "1%"),))
    fit = FitClient(group, MagicMock(), MagicMock(), search)
    fit.begin_fits(MagicMock())
    found = fit.finish(9000, lambda: None)["search"]
    assert found["reached"] is reached
    assert found["reason"].startswith(reason)
    assert (fit.unmet_reason == "") == reached


STOPPED = {StateField.STOP_REASON: StopReason.OPERATOR}
ON_THE_WAY = fit_of_record(0.9e-4, final=False)
FAILED = FitReport({"problem": "The sensor stands still.", "modes": [], "text": []}, final=True)
NOT_A_NUMBER = fit_of_record(float("nan"))


@pytest.mark.parametrize(
    ("messages", "state", "reached", "words"),
    [
        ((REACHED, ON_THE_WAY), STOPPED, None,
         ("Reached during the session. Not known", "A stop skipped", "Last estimate: damping")),
        ((ON_THE_WAY,), STOPPED, None, ("Not known", "A stop skipped", "Last estimate: damping")),
        ((REACHED,), STOPPED, None, ("Reached during the session. Not known", "A stop skipped")),
        ((REACHED, ON_THE_WAY, ChildError("The fit process was killed.")), {}, None,
         ("Reached during the session. Not known", "was killed.", "Last estimate: damping")),
        ((ON_THE_WAY, ChildError("The fit process was killed.")), {}, None,
         ("Not known", "was killed.", "Last estimate")),
        ((REACHED, FAILED), {}, None,
         ("Reached during the session. Not known", "The sensor stands still")),
        ((REACHED, NOT_A_NUMBER), {}, False, ("not by the whole record. So far: damping of mode",)),
    ],
)  # fmt: skip
def test_result_is_unknown_without_a_fit_of_the_record(
    messages, state, reached, words, monkeypatch
):
    monkeypatch.setattr("rigd.runner._worker_client._STOPPED_RESULTS_TIMEOUT_S", 0.0)
    group = MagicMock()
    group.channels.shared_state.__getitem__.side_effect = lambda word: state.get(word, 0)

    def read_messages(_):
        for message in messages:
            if isinstance(message, ChildError):
                raise message
            yield message

    group.__getitem__().messages.side_effect = read_messages
    search = SimpleNamespace(targets=(parse_target("damping", "1%"),))
    fit = FitClient(group, MagicMock(), MagicMock(), search)
    fit.begin_fits(MagicMock())
    found = fit.finish(9000, lambda: None)["search"]
    assert found["reached"] is reached
    assert found["reason"] == fit.unmet_reason
    assert all(each in fit.unmet_reason for each in words), fit.unmet_reason
    assert "So far: ." not in fit.unmet_reason
    assert fit.unmet_reason.count("was killed.") <= 1
