"""One session with everything a report can be of, and its report."""

from dataclasses import replace

import pytest
from rich.console import Console

from analysis.identify import Candidate, Measurement, Selection, fit_record, select
from analysis.identify.headline import headline_of_fit
from analysis.identify.verdict import OrderVerdict, Verdict
from analysis.models import STRUCTURES, WelchSettings
from analysis.paper.welch_analysis import analyse
from analysis.record import load_record
from analysis.report.record_report import write_report
from analysis.results import RecordResult, WholeRecord
from rigd.testing import chirp_signals, write_session

TYPES = ("I", "III", "VI", "VII")
HOSTILE = "<script>alert('note')</script> & \"quotes\" $x^2$"


@pytest.fixture(scope="session")
def hostile_note():
    return HOSTILE


def order(name, status="fractional", value=0.9, interval=(0.8, 1.0)):
    return OrderVerdict(name, status, value, interval, None, profile=None)


def verdict(*sentences, experiments=()):
    """Verdict on a record whose orders are both known."""
    return Verdict(
        name="session", structure="VI", rivals=(), parameters={}, adequate=True,
        alpha=order("alpha"), lambda_=order("lambda"), visible_modes=(1, 2, 3), findings=(),
        table=(), whiteness=None, input_relation=None, harmonics=(), sentences=sentences,
        experiments=experiments,
    )  # fmt: skip


@pytest.fixture(scope="session")
def record_result(computed_once, tmp_path_factory):
    return computed_once("record_result", lambda: fitted(tmp_path_factory.mktemp("html")))


def fitted(folder):
    signals = chirp_signals(sweep_s=60.0, ring_down_s=10.0, tool_inertia_kg_m2=1e-5)
    path = write_session(
        folder / "a <b> & $c$.mcap",
        signals,
        metadata={"note": HOSTILE, "operator": "<i>Rossi</i>", "specimen": "</td>"},
    )
    record = load_record(path)
    analysis = fit_record(Measurement.from_record(record), [STRUCTURES[name] for name in TYPES])
    candidates = [Candidate(fit.structure, fit) for fit in analysis.fits]
    selection = Selection(
        verdict(
            "Both orders are fractional.", "Less than noise <b> remains.",
            experiments=("Sweep round mode 1 & 2.",),
        ),
        headline_of_fit("VI", analysis.fits[TYPES.index("VI")], (1, 2, 3)),
        tuple(sorted(candidates, key=lambda each: each.bic)),
        analysis,
        tuple(candidates),
    )  # fmt: skip
    return RecordResult(
        record,
        WholeRecord(record, selection, (0.0, 50.0)),
        analyse(record, WelchSettings(types=("III", "VI"))),
    )


@pytest.fixture(scope="session")
def modal_result(record_result, computed_once):
    """Result of a record whose modes are those of the modal model."""
    record = record_result.record
    selection = computed_once("modal_result", lambda: select(Measurement.from_record(record)))
    return RecordResult(record, WholeRecord(record, selection, (0.0, 50.0)))


@pytest.fixture(scope="session")
def with_selection():
    """Replace parts of the selection of a record."""

    def made(result, **parts):
        selection = replace(result.whole.selection, **parts)
        return replace(result, whole=replace(result.whole, selection=selection))

    return made


@pytest.fixture(scope="session")
def as_text():
    """Return the output of a terminal of 120 columns as plain text."""

    def text(shown):
        console = Console(width=120, color_system=None, force_terminal=False)
        with console.capture() as capture:
            console.print(shown)
        return capture.get()

    return text


@pytest.fixture(scope="session")
def report(record_result, made_once):
    """Folder of the written page with its figures and tables."""
    return made_once("report", lambda folder: write_report(record_result, folder))
