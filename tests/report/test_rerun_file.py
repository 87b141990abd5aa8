"""`analyze --rerun`: the session as `rigd replay` shows it, and the fits on charts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import further
from rerun_files import batches
from typer.testing import CliRunner

from analysis.cli.app import app
from analysis.decimation import fast_fft_length
from analysis.models import WelchSettings
from analysis.paper.welch_analysis import analyse
from analysis.record import load_record
from analysis.report import write_rerun_file
from analysis.report.folder import OutputError
from analysis.results import RecordResult
from rigd.beam import ResponseGrid
from rigd.cli.app import app as rigd
from rigd.session import read_session
from rigd.spectral import fft_response

pytestmark = pytest.mark.fit

BAND = (0.5875, 50.0)


def value(batches: list, name: str):
    """Return the one value of a component that stays as it is."""
    (found,) = [b.column(name).to_pylist()[0] for b in batches if name in b.schema.names]
    return found


SAMPLES = 10_000


@pytest.fixture(scope="module")
def brief_sessions():
    """Have ten seconds of each session drawn, instead of two minutes."""

    def read(path):
        session = read_session(path)
        return replace(session, samples=session.samples[:SAMPLES])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.report._rerun_file.read_session", read)
        yield


@pytest.fixture(scope="module")
def written(paper_analysis, tmp_path_factory, brief_sessions):
    path = tmp_path_factory.mktemp("rerun") / "paper.rrd"
    write_rerun_file(RecordResult(paper_analysis.record, welch=paper_analysis), path)
    return batches(path), path


class Canvas:
    """Positions of values by the tick labels of a chart: read from the file, not computed."""

    def __init__(self, chunks, entity):
        labels = [str(text) for text in value(chunks[f"{entity}/labels"], "Points2D:labels")]
        positions = np.array(value(chunks[f"{entity}/labels"], "Points2D:positions"))
        frame = np.array(value(chunks[f"{entity}/frame"], "LineStrips2D:strips")[0])
        (self.left, self.top), (self.right, self.bottom) = frame.min(axis=0), frame.max(axis=0)
        numbers = {
            text: position
            for text, position in zip(labels, positions, strict=True)
            if text.replace("−", "").replace(".", "").isdigit()
        }
        # Next to the frame are the ticks of the vertical axis, below it those of the other.
        upright = {t: p for t, p in numbers.items() if p[0] < self.left}
        across = {t: p for t, p in numbers.items() if p[1] > self.bottom - 5 and p[0] >= self.left}
        self.hz = np.array([[float(t), p[0]] for t, p in across.items()])
        self.values = np.array([[float(t.replace("−", "-")), p[1]] for t, p in upright.items()])

    def points(self, strips):
        """Return frequencies in Hz and values (n, 2) from the drawing."""
        drawn = np.concatenate([np.asarray(strip, dtype=float) for strip in strips])
        inside = (drawn[:, 1] > self.top + 0.01) & (drawn[:, 1] < self.bottom - 0.01)
        drawn = drawn[inside]
        order = np.argsort(self.hz[:, 1])
        slope, offset = np.polyfit(self.hz[order, 1], np.log(self.hz[order, 0]), 1)
        rise, base = np.polyfit(self.values[:, 1], self.values[:, 0], 1)
        # Labels stand a little above the middle of their ticks, each by as much.
        lift = self.values[np.argmin(self.values[:, 0]), 1] - self.bottom
        return np.exp(slope * drawn[:, 0] + offset), rise * (drawn[:, 1] + lift) + base


def assert_on_curve(chunks, entity, name, grid_hz, expected, tolerance, *, component=None):
    """Check that all that is drawn lies on a curve, and that it spans the band."""
    component = component or "LineStrips2D:strips"
    strips = value(chunks[f"{entity}/{name}"], component)
    strips = [strips] if component.startswith("Points2D") else strips
    frequency_hz, values = Canvas(chunks, entity).points(strips)
    assert len(values) > 300
    index = np.abs(grid_hz[:, None] - frequency_hz).argmin(axis=0)
    assert frequency_hz == pytest.approx(grid_hz[index], rel=2e-3)
    # On steep flanks the neighbouring bin may be as near.
    near = np.stack([expected[np.clip(index + k, 0, grid_hz.size - 1)] for k in range(-4, 5)])
    assert np.abs(near - values).min(axis=0).max() < tolerance
    return frequency_hz


def decibels(values):
    return 20 * np.log10(np.abs(values))


def degrees(values):
    return np.degrees(np.angle(values * -1j)) + 90.0


@pytest.mark.parametrize("kind", [further("I"), further("III"), "VI"])
def test_models_and_residuals_lie_over_the_response(paper_analysis, written, kind):
    chunks, _ = written
    grid_hz, measured = paper_analysis.response.frequency_hz, paper_analysis.response.response
    entity = f"/fits/type_{kind}"
    models = [m for m in paper_analysis.models if m.fit.structure.name == kind]
    assert [model.fit.weighting for model in models] == ["const", "omega"]
    reached = assert_on_curve(
        chunks, f"{entity}/magnitude", "measured", grid_hz, decibels(measured), 0.2
    )
    assert (reached.min(), reached.max()) == pytest.approx(BAND, rel=5e-3)
    for model in models:
        name = f"model_{model.fit.weighting}"
        for page, values, tolerance in (
            ("magnitude", decibels(model.response), 0.2),
            ("phase", degrees(model.response), 1.0),
            ("residual", decibels(measured - model.response), 0.5),
        ):
            assert_on_curve(chunks, f"{entity}/{page}", name, grid_hz, values, tolerance)


@pytest.mark.parametrize("page", ["magnitude", "phase", "residual"])
def test_legends_have_the_colour_of_every_curve(written, page):
    chunks, _ = written
    entity = f"/fits/type_VI/{page}"
    curves = {"measured", "model_const", "model_omega"}
    colors = {value(chunks[f"{entity}/{name}"], name_of_colors(page, name))[0] for name in curves}
    assert len(colors) == 3
    assert set(value(chunks[f"{entity}/legend"], "LineStrips2D:colors")) == colors
    labels = value(chunks[f"{entity}/labels"], "Points2D:labels")
    assert {label.split()[-1] for label in labels[-3:]} in (
        {"measured", "const", "omega"},
        {"|measured|", "const", "omega"},
    )


def name_of_colors(page: str, curve: str) -> str:
    dotted = page == "phase" and curve == "measured"
    return "Points2D:colors" if dotted else "LineStrips2D:colors"


def test_the_estimate_of_the_fits_is_shown_with_its_coherence(paper_analysis, written):
    chunks, _ = written
    response = paper_analysis.response
    assert_on_curve(
        chunks, "/fits/measured/magnitude", "measured", response.frequency_hz,
        decibels(response.response), 0.2,
    )  # fmt: skip
    assert_on_curve(
        chunks, "/fits/measured/phase", "measured", response.frequency_hz,
        degrees(response.response), 1.0, component="Points2D:positions",
    )  # fmt: skip
    assert_on_curve(
        chunks, "/fits/measured/coherence", "coherence", response.frequency_hz,
        response.coherence, 0.01,
    )  # fmt: skip


def test_file_has_session_numbers_and_tabs(paper_analysis, written):
    chunks, path = written
    assert sum(b.num_rows for b in chunks["/signals"]) == SAMPLES
    text = value(chunks["/fits/tables"], "TextDocument:text")[0]
    best = next(
        m
        for m in paper_analysis.models
        if (m.fit.structure.name, m.fit.weighting) == ("VI", "omega")
    )
    assert f"{best.indices.wmse:.4g}" in text
    tabs = titles(path)
    assert {"Fits", "Measured", "Type I", "Type III", "Type VI", "Tables", "Overview"} <= tabs
    assert any(f"WMSE {best.indices.wmse:.3g}" in tab for tab in tabs)


@pytest.fixture(scope="module")
def from_record(record_result, tmp_path_factory, brief_sessions):
    path = tmp_path_factory.mktemp("rerun") / "record.rrd"
    write_rerun_file(replace(record_result, welch=None), path)
    return batches(path), path


def test_model_of_the_whole_record_lies_over_the_response(record_result, from_record):
    chunks, _ = from_record
    whole = record_result.whole
    angle = whole.record.angle_rad - (whole.record.rest_angle_rad or 0.0)
    size = fast_fft_length(len(angle))
    found = fft_response(angle, whole.record.torque_nm, whole.record.rate_hz, size)
    found = found.band(0.1, whole.band_hz[1])
    grid_hz, delay_s = found.frequency_hz, whole.fit.parameters["delay_s"]
    measured = found.response * np.exp(2j * np.pi * delay_s * grid_hz)
    plant = replace(whole.fit.plant, delay_s=0.0)
    model = ResponseGrid(2j * np.pi * grid_hz).evaluate(plant, ())[0]
    for chart, name, expected, tolerance in (
        ("magnitude", "measured", decibels(measured), 1.0),
        ("magnitude", "model", decibels(model), 0.2),
        ("phase", "model", degrees(model), 2.0),
        ("residual", "model", decibels(measured - model), 1.0),
    ):
        entity = f"/whole_record/response/{chart}"
        assert_on_curve(chunks, entity, name, grid_hz, expected, tolerance)


@pytest.mark.further  # as the response's
def test_torque_model_and_residual_run_over_the_session(record_result, from_record):
    chunks, _ = from_record
    record = record_result.record
    torque, residual = (
        np.concatenate(
            [b.column("Scalars:scalars").to_pylist() for b in chunks[f"/whole_record/{name}"]]
        )
        for name in ("torque", "residual")
    )
    assert torque.shape == (record.time_s.size, 2)
    np.testing.assert_allclose(residual[:, 0], 1e3 * (torque[:, 0] - torque[:, 1]), atol=1e-9)
    # Noise is left, and the model explains the rest.
    assert residual.std() < 0.1 * 1e3 * torque[:, 0].std()
    times = np.concatenate(
        [b.column("session_time").to_numpy() for b in chunks["/whole_record/torque"]]
    )
    np.testing.assert_allclose(times.astype(np.int64), 1e9 * record.time_s, atol=1)


def test_verdict_comes_first(record_result, from_record):
    chunks, path = from_record
    text = value(chunks["/whole_record/verdict"], "TextDocument:text")[0]
    for sentence in record_result.whole.verdict.sentences:
        assert sentence in text
    assert "Modes with locked hub" in text
    assert [name for name in titles(path) if name in ("Whole record", "Fits")] == ["Whole record"]


def titles(path):
    """Titles of tabs and views in the layout of a recording."""
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    found = set()
    for chunk in reader.stream(store=layout):
        batch = chunk.to_record_batch()
        for name in ("ContainerBlueprint:display_name", "ViewBlueprint:display_name"):
            if name in batch.schema.names:
                found |= {title for row in batch.column(name).to_pylist() for title in row or ()}
    return found


def test_user_weightings_and_estimate_without_coherence(session, tmp_path):
    settings = WelchSettings(
        estimator="fft", types=("III",), weightings=("omega", "omega^0.5", "omega^-0.5")
    )
    analysis = analyse(load_record(session), settings)
    assert analysis.response.coherence is None
    path = tmp_path / "own.rrd"
    write_rerun_file(RecordResult(analysis.record, welch=analysis), path)
    chunks = batches(path)
    names = {
        entity.rpartition("/")[2] for entity in chunks if "/type_III/magnitude/model" in entity
    }
    assert names == {"model_omega", "model_omega_0_5", "model_omega__0_5"}
    colors = {
        value(chunks[f"/fits/type_III/magnitude/{name}"], "LineStrips2D:colors")[0]
        for name in names
    }
    assert len(colors) == 3


@pytest.fixture
def session(write_session, short_signals, tmp_path):
    return write_session(tmp_path / "session.mcap", short_signals)


def test_unwritable_file_is_reported(paper_analysis, brief_sessions):
    with pytest.raises(OutputError, match=r"^/proc/fits.rrd cannot be written: [A-Z][^:]*\.$"):
        write_rerun_file(
            RecordResult(paper_analysis.record, welch=paper_analysis), Path("/proc/fits.rrd")
        )


def run(application, *arguments):
    return CliRunner().invoke(application, list(map(str, arguments)))


def test_command_never_overwrites_another_file(session, tmp_path, monkeypatch):
    # The figures take longer than all the rest, and are tested elsewhere.
    monkeypatch.setattr("analysis.report.record_report.write_report", lambda *_, **__: None)
    out = tmp_path / "new" / "fits.rrd"
    quick = ("--types", "I", "--weights", "const", "--method", "welch", "--segment", "1000")
    done = run(app, session, *quick, "--rerun", out)
    assert done.exit_code == 0, done.output
    printed = " ".join(done.stdout.split())
    assert f"Session and fits for Rerun: {out} (rigd replay {out})" in printed
    assert "/fits/type_I/magnitude/model_const" in batches(out)
    before = out.read_bytes()
    for options, words in (
        (("--rerun", out), "nothing is overwritten"),
        (("--rerun", tmp_path / "fits.txt"), ".rrd"),
        ((session, "--rerun", tmp_path / "two.rrd"), "2 files were given"),
    ):
        done = run(app, session, *quick, *options)
        assert done.exit_code == 2
        assert "--rerun" in done.stderr
        assert words in done.stderr
    assert out.read_bytes() == before
    # `rigd replay` recognises it.
    done = run(rigd, "replay", out, "--save", tmp_path / "copy.rrd")
    assert done.exit_code == 2
    assert "is a recording for Rerun already" in done.stderr
