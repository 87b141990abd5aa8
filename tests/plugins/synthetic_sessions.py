"""Synthetic sessions: the paper's chirp through a motor loop and the exact model."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from analysis.models import WelchSettings
from analysis.paper._route import analyse
from analysis.record import load_record
from rigd.beam import Beam, Damping, transfer
from rigd.session import SessionWriter
from rigd.session._format import SAMPLE_SIZE, pack_sample_into

RATE_HZ = 1000.0
BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=1.15e11 * 7.85e-13)
TYPE_VI_OMEGA = Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)
POLE_RAD_S = 80.0


def chirp_rad(rest_s, sweep_s, ring_down_s, amplitude_rad=0.025, start_hz=0.05, stop_hz=50.0):
    t = np.arange(round(sweep_s * RATE_HZ)) / RATE_HZ
    phase = 2 * np.pi * (start_hz * t + (stop_hz - start_hz) * t**2 / (2 * sweep_s))
    rest, ring_down = (np.zeros(round(d * RATE_HZ)) for d in (rest_s, ring_down_s))
    return np.concatenate((rest, amplitude_rad * np.sin(phase), ring_down))


def convolve(values, transfer_of_s):
    """Causal response, by a transform on s = sigma + j omega of the record and four of padding."""
    n = len(values)
    padded = 1 << (4 * n).bit_length()
    sigma = 1.0 / (n / RATE_HZ)
    decay = np.exp(-sigma * np.arange(n) / RATE_HZ)
    s = sigma + 2j * np.pi * np.fft.rfftfreq(padded, 1 / RATE_HZ)
    spectrum = np.fft.rfft(values * decay, padded) * transfer_of_s(s)
    return np.fft.irfft(spectrum, padded)[:n] / decay


@dataclass(frozen=True)
class Signals:
    """Arrays of a session and the segments they fall into."""

    reference_rad: np.ndarray
    angle_rad: np.ndarray
    torque_nm: np.ndarray
    segments: dict

    def decimated(self, keep):
        return replace(
            self,
            reference_rad=self.reference_rad[keep],
            angle_rad=self.angle_rad[keep],
            torque_nm=self.torque_nm[keep],
        )


def signals_of_chirp(
    rest_s=1.0,
    sweep_s=120.0,
    ring_down_s=15.0,
    damping=TYPE_VI_OMEGA,
    noise_nm=5e-3,
    quantum_rad=7e-5,
    tool_inertia_kg_m2=0.0,
    angle_delay_s=0.0,
    torque_delay_s=0.0,
    seed=1,
):
    rng = np.random.default_rng(seed)
    reference = chirp_rad(rest_s, sweep_s, ring_down_s)
    angle = convolve(reference, lambda s: 1 / (1 + s / POLE_RAD_S) ** 2)
    torque = convolve(
        reference,
        lambda s: (
            (transfer(s, BEAM, damping) + tool_inertia_kg_m2 * s**2)
            / (1 + s / POLE_RAD_S) ** 2
            * np.exp(-s * torque_delay_s)
        ),
    )
    if angle_delay_s:
        angle = convolve(angle, lambda s: np.exp(-s * angle_delay_s))
    if quantum_rad:
        angle = quantum_rad * np.round(angle / quantum_rad)
    first, last = round(rest_s * RATE_HZ), round((rest_s + sweep_s) * RATE_HZ)
    return Signals(
        reference,
        angle,
        torque + noise_nm * rng.standard_normal(len(torque)),
        {"rest": (0, first), "sweep": (first, last), "ring_down": (last, len(reference))},
    )


@pytest.fixture(scope="session")
def paper_signals():
    return signals_of_chirp()


METADATA = {
    "rate_hz": "1000.0",
    "beam_length_m": repr(BEAM.length_m),
    "beam_density_kg_per_m": repr(BEAM.density_kg_per_m),
    "beam_bending_stiffness_n_m2": repr(BEAM.bending_stiffness_n_m2),
    "excitation": "chirp",
    "start_hz": "0.05",
    "stop_hz": "50.0",
}


def write_session_file(
    path, signals, *, metadata=(), segments=None, status=None, ticks=None, t_ns=None,
    outcome="complete",
):  # fmt: skip
    """Write signals as a session; `ticks` and `status` default to all there and all well."""
    n = len(signals.angle_rad)
    ticks = np.arange(n) if ticks is None else ticks
    t_ns = np.asarray(ticks) * 1_000_000 if t_ns is None else t_ns
    status = np.zeros(n, int) if status is None else status
    block = bytearray(n * SAMPLE_SIZE)
    for i in range(n):
        pack_sample_into(
            block, i * SAMPLE_SIZE, int(t_ns[i]), int(ticks[i]),
            float(signals.reference_rad[i]), float(signals.angle_rad[i]), 0.0,
            float(signals.torque_nm[i]), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, int(status[i]), 0, 0,
        )  # fmt: skip
    writer = SessionWriter(path)
    writer.begin(
        1_700_000_000_000_000_000,
        {**METADATA, **dict(metadata)},
        signals.segments if segments is None else segments,
        {},
    )
    writer.write_samples(block)
    return writer.close({"outcome": outcome})


@pytest.fixture(scope="session")
def write_session():
    return write_session_file


@pytest.fixture(scope="session")
def signals_of():
    return Signals


@pytest.fixture(scope="session")
def make_signals():
    return signals_of_chirp


@pytest.fixture(scope="session")
def paper_file(paper_signals, tmp_path_factory):
    return write_session_file(tmp_path_factory.mktemp("sessions") / "paper.mcap", paper_signals)


@pytest.fixture(scope="session")
def paper_analysis(paper_file):
    """Three types of the paper's session, enough to show every kind of cell."""
    return analyse(load_record(paper_file), WelchSettings(types=("I", "III", "VI")))


@pytest.fixture
def short_signals():
    """Five seconds of a sine: what the record, not the estimate, is tested with."""
    n = 5000
    t = np.arange(n) / RATE_HZ
    return Signals(
        reference_rad=0.01 * np.sin(2 * np.pi * t),
        angle_rad=0.01 * np.sin(2 * np.pi * t - 0.1),
        torque_nm=0.02 * np.cos(2 * np.pi * t),
        segments={"rest": (0, 500), "sweep": (500, 4500), "ring_down": (4500, n)},
    )
