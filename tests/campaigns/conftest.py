"""Short sessions of a beam with a little damping of both kinds, at 250 Hz to spare time."""

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from analysis.campaigns import (
    RecordEstimate,
    SessionAnalysis,
    analyse_session,
    campaign,
)
from analysis.campaigns._experiment import Experiment
from analysis.identify import ModeEstimate, RecordFit, Ringing
from analysis.models import STRUCTURES, WelchSettings
from analysis.paper import FrfFit
from analysis.paper.welch_analysis import FitIndices, FittedModel, Peak
from analysis.record import load_record
from analysis.record_part import RecordSource
from rigd.beam import Beam, Damping, Plant
from rigd.testing import PAPER_BEAM, chirp_signals, write_session

CAMPAIGN = "analysis.campaigns._campaign"
RATE_HZ = 250.0
LINK = PAPER_BEAM
PLANT = Damping(zeta=3e-4, alpha=1.0, gamma=0.2, lambda_=1.0)
NOISE_NM = 1e-3
SETTINGS = WelchSettings(
    types=("I", "III"), segment_length=2000, overlap=300, nfft=8000, band_hz=(1.0, 50.0)
)


def short_session(path, seed, beam=LINK, damping=PLANT, **stated):
    """One second of rest, 0.5-50 Hz in 20 s, 4 s after it."""
    signals = chirp_signals(
        sweep_s=20.0, ring_down_s=4.0, rate_hz=RATE_HZ, start_hz=0.5, amplitude_rad=0.028,
        beam=beam, damping=damping, noise_nm=NOISE_NM, quantum_rad=0.0, seed=seed,
    )  # fmt: skip
    segments = {name: signals.segments[name] for name in ("rest", "sweep")}
    return write_session(
        path, replace(signals, metadata={}), beam=beam, metadata=stated, segments=segments
    )


@pytest.fixture(scope="session")
def make_file():
    return short_session


@pytest.fixture(scope="session")
def short_sessions(made_once):
    """Four that agree."""

    def make(folder):
        for seed in range(4):
            short_session(folder / f"{seed}.mcap", seed)

    return sorted(made_once("campaign_sessions", make).iterdir())


@pytest.fixture(scope="session")
def other_beam(made_once):
    def make(folder):
        short_session(folder / "longer.mcap", 9, replace(LINK, length_m=1.0))

    return made_once("campaign_other_beam", make) / "longer.mcap"


@pytest.fixture(scope="session")
def settings():
    return SETTINGS


@pytest.fixture(scope="session")
def truth():
    return LINK, PLANT


@pytest.fixture(scope="session")
def done(short_sessions, other_beam, settings, tmp_path_factory, computed_once):
    """The campaign of four that agree and two files that do not belong to it; its progress."""

    class Workers(Here):
        """Workers that need not analyse the other beam: its result is excluded."""

        def run(self, function, tasks, on_done):
            if function is not analyse_session:
                return super().run(function, tasks, on_done)
            *to_analyse, (source, _) = tasks
            assert source.path == other_beam
            found = super().run(function, to_analyse, on_done)
            on_done(len(to_analyse))
            experiment = Experiment.from_record(load_record(other_beam))
            return [*found, replace(found[0], source=source, experiment=experiment)]

    def compute():
        torn = tmp_path_factory.mktemp("torn") / "torn.mcap"
        torn.write_bytes(short_sessions[0].read_bytes()[:5000])
        paths = [short_sessions[0], torn, *short_sessions[1:], other_beam]
        progress = []
        found = campaign(
            paths, settings, structures=("I", "III"), workers=Workers(),
            on_progress=lambda *step: progress.append(step),
        )  # fmt: skip
        return found, progress

    return computed_once("campaign", compute)


class Here:
    """Workers of this process."""

    def run(self, function, tasks, on_done):
        found = []
        for number, task in enumerate(tasks):
            found.append(function(*task))
            on_done(number)
        return found


class Prepared(Here):
    """Workers of this process that have results of sessions already, in the order of the paths."""

    def __init__(self, results):
        self._results = results

    def run(self, function, tasks, on_done=lambda _number: None):
        if function is analyse_session:
            return list(self._results)
        return super().run(function, tasks, on_done)


@pytest.fixture(scope="session")
def campaign_of():
    """Make the campaign of invented results, without files to predict."""

    def made(results, *, validated=False, **options):
        with pytest.MonkeyPatch.context() as patch:
            if not validated:
                patch.setattr(f"{CAMPAIGN}.validate", lambda *_: ((), ()))
            return campaign([each.path for each in results], workers=Prepared(results), **options)

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
def in_this_process():
    """A context in which campaigns start no workers, for tests of other behaviour."""

    @contextmanager
    def pool(_count):
        yield Here()

    @contextmanager
    def entered():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(f"{CAMPAIGN}.process_pool", pool)
            yield

    return entered


def welch_fit(structure, weighting, at_bounds=(), **free):
    values = {**STRUCTURES[structure].fixed, **{k.rstrip("_"): v for k, v in free.items()}}
    damping = STRUCTURES[structure].damping(values)
    fit = FrfFit(STRUCTURES[structure], weighting, damping, values, None, 1.0, at_bounds)
    no_response, indices = np.empty(0, complex), FitIndices(1.0, 1.0, 1.0)
    return FittedModel(
        fit, no_response, indices, modes=(), are_near_undamped=(), peaks=(), deviations=()
    )


def record_estimate(structure, values, covariance, determined, at_bounds=(), cost=100.0, bic=0.0):
    """Estimate with the link's own settings where `values` has no entry."""
    every = Plant(LINK, Damping()).parameters | dict(STRUCTURES[structure].fixed) | values
    beam = Beam(
        LINK.length_m,
        every["density_over_stiffness"] * every["bending_stiffness_n_m2"],
        every["bending_stiffness_n_m2"],
    )
    plant = Plant(
        beam,
        Damping(every["zeta"], every["alpha"], every["gamma"], every["lambda"]),
        every["delay_s"],
        every["tool_inertia_kg_m2"],
    )
    fit = RecordFit(
        structure=STRUCTURES[structure], plant=plant, parameters=every,
        std=dict.fromkeys(every, 0.0), interval=dict.fromkeys((*determined, *at_bounds)),
        determined=tuple(determined),
        covariance=np.asarray(covariance), at_bounds=at_bounds, internal=None, external=None,
        modes=(ModeEstimate(1, 2.5, 1e-4, 0.01, 1e-5),), ringing=Ringing((), 0.0, 0), cost=cost,
        degrees_of_freedom=100, residual=np.empty(0, complex),
    )  # fmt: skip
    return RecordEstimate(
        fit, deviance=cost, bic=bic, compared_values=100, indices=FitIndices(1.0, 1.0, 1.0)
    )


def experiment(name="a.mcap", sweep_s=30.0, **facts):
    return Experiment({"beam_length_m": 0.98, **facts}, sweep_s, (name,))


def session_result(
    name="a.mcap", fits=(), estimates=(), peaks=(), response=(1 + 0j, 2 + 0j), verdict=None
):
    response = np.array(response)
    return SessionAnalysis(
        source=RecordSource(Path(name)),
        experiment=experiment(name),
        beam=LINK,
        tool_inertia_kg_m2=0.0,
        delay_s=0.0,
        frequency_hz=1.0 + np.arange(response.size),
        response=response,
        peaks=tuple(Peak(*each) if each else None for each in peaks),
        welch_models=tuple(fits),
        record_estimates=tuple(estimates),
        verdict=verdict,
        warnings=(),
    )


@pytest.fixture(scope="session")
def make_fit():
    return welch_fit


@pytest.fixture(scope="session")
def make_estimate():
    return record_estimate


@pytest.fixture(scope="session")
def make_session():
    return session_result


@pytest.fixture(scope="session")
def make_experiment():
    return experiment
