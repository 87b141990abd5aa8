"""One session with everything a report can be of, and its report."""

from datetime import UTC, datetime

import pytest

from analysis.identify import Measurement, fit_record, of_fit
from analysis.models import STRUCTURES, WelchSettings
from analysis.paper._route import analyse
from analysis.record import load_record
from analysis.report._write import write_html_report
from analysis.results import Subject, Verdict

TYPES = ("I", "III", "VI", "VII")
HOSTILE = "<script>alert('note')</script> & \"quotes\" $x^2$"
MADE_AT = datetime(2026, 11, 20, 12, 0, tzinfo=UTC)


@pytest.fixture(scope="session")
def hostile_note():
    return HOSTILE


@pytest.fixture(scope="session")
def record_subject(make_signals, write_session, tmp_path_factory):
    signals = make_signals(sweep_s=60.0, ring_down_s=10.0, tool_inertia_kg_m2=1e-5)
    path = write_session(
        tmp_path_factory.mktemp("html") / "a <b> & $c$.mcap",
        signals,
        metadata={"note": HOSTILE, "operator": "<i>Rossi</i>", "specimen": "</td>"},
    )
    record = load_record(path)
    analysis = fit_record(Measurement.of_record(record), [STRUCTURES[name] for name in TYPES])
    return Subject(
        record=record,
        analysis=analysis,
        fits={fit.structure.name: fit for fit in analysis.fits},
        headline=of_fit("VI", analysis.fits[TYPES.index("VI")], (1, 2, 3)),
        verdict=Verdict(
            sentences=("Both orders are fractional.", "Less than noise <b> remains."),
            experiments=("Sweep round mode 1 & 2.",),
            delta_bic=dict(zip(TYPES, (4e4, 2e4, 0.0, 12.5), strict=True)),
        ),
        band_hz=(0.0, 50.0),
        welch=analyse(record, WelchSettings(types=("III", "VI"))),
    )


@pytest.fixture(scope="session")
def report(record_subject, tmp_path_factory):
    """Folder of the written report."""
    folder = tmp_path_factory.mktemp("reports") / "report"
    folder.mkdir()
    write_html_report(record_subject, folder, made_at=MADE_AT)
    return folder
