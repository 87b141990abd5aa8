"""A finding is a fact only with a model that explains the record."""

import pytest

from analysis.identify._finding import MODEL_INDEPENDENT_KINDS, Finding, with_doubt
from analysis.identify._model_check import mark_doubtful_findings


@pytest.mark.parametrize(
    ("sentence", "without_interval"),
    [
        (
            "The torque comes 0.3 ms later than the file says (0.28 to 0.32 ms; 95 %): a delay.",
            "the torque comes 0.3 ms later than the file says: a delay.",
        ),
        (
            "The modes lie elsewhere: mode 2 +1.13 % (± 0.5 %), mode 3 -0.94 % (± 0.4 %).",
            "the modes lie elsewhere: mode 2 +1.13 %, mode 3 -0.94 %.",
        ),
        (
            "EI is 2.00 % higher (+1.90 to +2.10 %; 95 %), or the gain is.",
            "EI is 2.00 % higher, or the gain is.",
        ),
    ],
)
def test_doubtful_finding_is_no_fact_and_has_no_interval(sentence, without_interval):
    found = with_doubt(Finding("delay", sentence, 1.0, (0.9, 1.1), "s", "Look."), "it rains")
    assert found.sentence == f"Not established, because it rains: {without_interval}"
    assert (found.value, found.interval, found.remedy) == (1.0, None, "Look.")


@pytest.mark.parametrize("kind", sorted(MODEL_INDEPENDENT_KINDS))
def test_model_independent_finding_stays_a_fact(kind):
    found = Finding(kind, "It is there (1 to 2; 95 %).", 1.0, (1.0, 2.0), "1", "")
    assert with_doubt(found, "it rains") is found


def test_a_finding_on_a_flagged_parameter_is_no_fact():
    """Flags of the headline hold for the findings as well, for the same reason."""
    late, tool = (
        Finding(kind, "It is there (1 to 2; 95 %).", 1.0, (1.0, 2.0), parameters=(name,))
        for kind, name in (("delay", "delay_s"), ("tool inertia", "tool_inertia_kg_m2"))
    )
    first, second = mark_doubtful_findings(
        (late, tool),
        (),
        None,
        None,
        {"delay_s": "type VII fits as well"},
        only_harmonics_remain=True,
    )
    assert first.sentence == "Not established, because type VII fits as well: it is there."
    assert (first.interval, second) == (None, tool)
