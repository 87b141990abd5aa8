"""Short sessions of a beam with a little damping of both kinds, at 250 Hz to spare time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.campaigns._estimates import RecordEstimate, WelchFit
from analysis.campaigns._experiment import Experiment
from analysis.campaigns._session import SessionResult
from analysis.identify import ModeEstimate, Plant
from analysis.models import STRUCTURES, WelchSettings
from analysis.paper._route import Indices, Peak
from rigd.beam import Beam, Damping, transfer
from rigd.session import SessionWriter
from rigd.session._format import SAMPLE_SIZE, pack_sample_into

RATE_HZ = 250.0
LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
PLANT = Damping(zeta=3e-4, alpha=1.0, gamma=0.2, lambda_=1.0)
NOISE_NM = 1e-3
SETTINGS = WelchSettings(
    types=("I", "III"), segment_length=2000, overlap=300, nfft=8000, band_hz=(1.0, 50.0)
)


def short_session(path, seed, beam=LINK, damping=PLANT, **stated):
    """One second of rest, 0.5-50 Hz in 30 s, 5 s after it."""
    t = np.arange(round(36 * RATE_HZ)) / RATE_HZ - 1.0
    phase = 2 * np.pi * (0.5 * t + (50 - 0.5) * t**2 / 60)
    reference = np.where((t >= 0) & (t < 30), 0.025 * np.sin(phase), 0.0)
    n = t.size
    decay = np.exp(-5.0 * np.arange(n) / n)
    s = 5.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1 / RATE_HZ)
    spectrum = np.fft.rfft(reference * decay, 4 * n) / (1 + s / 80) ** 2
    angle, torque = (
        np.fft.irfft(x, 4 * n)[:n] / decay
        for x in (spectrum, spectrum * transfer(s, beam, damping))
    )
    torque = torque + np.random.default_rng(seed).normal(scale=NOISE_NM, size=n)
    block = bytearray(n * SAMPLE_SIZE)
    for tick in range(n):
        pack_sample_into(
            block, tick * SAMPLE_SIZE, tick * 4_000_000, tick, reference[tick], angle[tick], 0.0,
            torque[tick], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0,
        )  # fmt: skip
    writer = SessionWriter(path)
    metadata = {
        "rate_hz": repr(RATE_HZ),
        "beam_length_m": repr(beam.length_m),
        "beam_density_kg_per_m": repr(beam.density_kg_per_m),
        "beam_bending_stiffness_n_m2": repr(beam.bending_stiffness_n_m2),
        **stated,
    }
    ends = round(RATE_HZ), round(31 * RATE_HZ)
    writer.begin(1_700_000_000_000_000_000, metadata, {"rest": (0, ends[0]), "sweep": ends}, {})
    writer.write_samples(block)
    return writer.close({"outcome": "complete"})


@pytest.fixture(scope="session")
def make_file():
    return short_session


@pytest.fixture(scope="session")
def short_sessions(tmp_path_factory):
    """Four that agree."""
    folder = tmp_path_factory.mktemp("campaign")
    return [short_session(folder / f"{seed}.mcap", seed) for seed in range(4)]


@pytest.fixture(scope="session")
def other_beam(tmp_path_factory):
    return short_session(
        tmp_path_factory.mktemp("other") / "longer.mcap", 9, replace(LINK, length_m=1.0)
    )


@pytest.fixture(scope="session")
def settings():
    return SETTINGS


@pytest.fixture(scope="session")
def truth():
    return LINK, PLANT


def welch_fit(structure, weighting, at_bounds=(), **free):
    values = {**STRUCTURES[structure].fixed, **{k.rstrip("_"): v for k, v in free.items()}}
    damping = STRUCTURES[structure].damping(values)
    return WelchFit(structure, weighting, damping, values, 1.0, at_bounds)


def record_estimate(
    structure, values, covariance, determined, at_bounds=(), cost=100.0, uniform=True, bic=0.0
):
    """Estimate with the link's own settings where `values` says nothing."""
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
        tuple(value for name, value in every.items() if name.startswith("stiffness_offset")),
    )
    return RecordEstimate(
        structure=structure, uniform=uniform, beam="" if uniform else ", modes free", plant=plant,
        parameters=every,
        std=dict.fromkeys(every, 0.0), determined=tuple(determined),
        covariance=np.asarray(covariance), at_bounds=at_bounds,
        modes=(ModeEstimate(1, 2.5, 1e-4, 0.01, 1e-5),), cost=cost, degrees_of_freedom=100,
        deviance=cost, bic=bic, values=100, indices=Indices(1.0, 1.0, 1.0),
    )  # fmt: skip


def experiment(name="a.mcap", sweep_s=30.0, **facts):
    return Experiment({"beam_length_m": 0.98, **facts}, sweep_s, (name,))


def session_result(
    name="a.mcap", fits=(), estimates=(), peaks=(), response=(1 + 0j, 2 + 0j), verdict=None
):
    response = np.array(response)
    return SessionResult(
        path=Path(name),
        experiment=experiment(name),
        beam=LINK,
        tool_inertia_kg_m2=0.0,
        delay_s=0.0,
        frequency_hz=1.0 + np.arange(response.size),
        response=response,
        peaks=tuple(Peak(*each) if each else None for each in peaks),
        welch_fits=tuple(fits),
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
