"""Records of a beam whose parameters are known, as arrays and as session files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.beam import Beam, Damping, transfer
from rigd.session import SessionWriter
from rigd.session.layout import encode_samples

PAPER_BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
"""The paper's antenna (Table 1)."""
PAPER_DAMPING = Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)
"""The paper's best model: type VI with frequency-dependent weights (Table 3)."""

_POLE_RAD_S = 80.0
"""Both poles of the motor loop."""
_START_UTC_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Signals:
    """Signals of a session, one value per tick, and the segments they fall into.

    Attributes
    ----------
    reference_rad, angle_rad, torque_nm : array (n,)
        Reference, motor angle, and coupling torque on the motor's shaft.
    segments : dict of str to (int, int)
        First tick and end of ``rest``, ``sweep`` and ``ring_down``.
    rate_hz : float
        Sampling rate.
    metadata : dict of str to str
        What a file is to state of the excitation.
    """

    reference_rad: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    segments: dict[str, tuple[int, int]]
    rate_hz: float = 1000.0
    metadata: dict[str, str] = field(default_factory=dict)

    def part(self, selected: slice | NDArray[np.generic]) -> "Signals":
        """Return some of the samples, by numpy's indexing; segments and rate stay as they are."""
        return replace(
            self,
            reference_rad=self.reference_rad[selected],
            angle_rad=self.angle_rad[selected],
            torque_nm=self.torque_nm[selected],
        )


def beam_torque(
    angle_rad: ArrayLike,
    rate_hz: float,
    *,
    beam: Beam = PAPER_BEAM,
    damping: Damping = PAPER_DAMPING,
    tool_inertia_kg_m2: float = 0.0,
    delay_s: float = 0.0,
) -> NDArray[np.float64]:
    """Compute the coupling torque that the exact model answers to a motion of the motor.

    Parameters
    ----------
    angle_rad : array (n,)
        Angle of the motor, at rest before the first sample.
    rate_hz : float
    beam, damping
        Parameters of the beam; those of the paper by default.
    tool_inertia_kg_m2 : float
        Inertia between sensor and beam.
    delay_s : float
        Delay of the torque channel.

    Returns
    -------
    array (n,)
        Torque in N·m.

    Notes
    -----
    Eq. 25 on a line ``s = sigma + j omega``, whose ``exp(-sigma t)`` preserves the record's end,
    where the beam still rings, from leaking into its beginning.

    Examples
    --------
    A stiff beam that turns slowly has little but its inertia.

    >>> import numpy as np
    >>> from rigd.beam import Beam
    >>> from rigd.testing import beam_torque
    >>> stiff = Beam(length_m=0.5, density_kg_per_m=0.03, bending_stiffness_n_m2=100.0)
    >>> t = np.arange(4000) / 1000
    >>> torque_nm = beam_torque(0.1 * np.sin(2 * np.pi * t) ** 3, 1000.0, beam=stiff)
    >>> torque_nm.shape
    (4000,)
    """
    return _answered(
        np.asarray(angle_rad, dtype=float),
        rate_hz,
        lambda s: (transfer(s, beam, damping) + tool_inertia_kg_m2 * s**2) * np.exp(-s * delay_s),
    )


def chirp_signals(
    *,
    rest_s: float = 1.0,
    sweep_s: float = 120.0,
    ring_down_s: float = 15.0,
    rate_hz: float = 1000.0,
    amplitude_rad: float = 0.025,
    start_hz: float = 0.05,
    stop_hz: float = 50.0,
    beam: Beam = PAPER_BEAM,
    damping: Damping = PAPER_DAMPING,
    tool_inertia_kg_m2: float = 0.0,
    angle_delay_s: float = 0.0,
    torque_delay_s: float = 0.0,
    noise_nm: float = 5e-3,
    quantum_rad: float = 7e-5,
    seed: int = 1,
) -> Signals:
    """Make the signals of a chirp: through a motor loop of 80 rad/s, and the exact beam.

    Parameters
    ----------
    rest_s, sweep_s, ring_down_s : float
        Lengths of the segments.
    rate_hz : float
        Sampling rate.
    amplitude_rad, start_hz, stop_hz : float
        Amplitude and frequencies of the reference; those of the paper by default.
    beam, damping, tool_inertia_kg_m2
        See :func:`beam_torque`.
    angle_delay_s, torque_delay_s : float
        Delay of either channel.
    noise_nm : float
        Standard deviation of the torque's white noise.
    quantum_rad : float
        Step of the encoder; 0 for none.
    seed : int
        Seed of the noise.

    Returns
    -------
    Signals

    Examples
    --------
    >>> from rigd.testing import chirp_signals
    >>> signals = chirp_signals(sweep_s=10.0, ring_down_s=2.0, noise_nm=0.0)
    >>> len(signals.torque_nm), signals.segments["sweep"]
    (13000, (1000, 11000))
    """
    rest, sweep, ring_down = (round(each * rate_hz) for each in (rest_s, sweep_s, ring_down_s))
    t = np.arange(sweep) / rate_hz
    phase = 2 * np.pi * (start_hz * t + (stop_hz - start_hz) * t**2 / (2 * sweep_s))
    reference = np.zeros(rest + sweep + ring_down)
    reference[rest : rest + sweep] = amplitude_rad * np.sin(phase)

    def motor(s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return 1 / (1 + s / _POLE_RAD_S) ** 2

    def torque_of(s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        answer = transfer(s, beam, damping) + tool_inertia_kg_m2 * s**2
        return np.asarray(answer * motor(s) * np.exp(-s * torque_delay_s))

    angle = _answered(reference, rate_hz, lambda s: motor(s) * np.exp(-s * angle_delay_s))
    if quantum_rad:
        angle = quantum_rad * np.round(angle / quantum_rad)
    noise = noise_nm * np.random.default_rng(seed).standard_normal(reference.size)
    segments = {
        "rest": (0, rest),
        "sweep": (rest, rest + sweep),
        "ring_down": (rest + sweep, reference.size),
    }
    torque = _answered(reference, rate_hz, torque_of) + noise
    stated = {"excitation": "chirp", "start_hz": repr(start_hz), "stop_hz": repr(stop_hz)}
    return Signals(reference, angle, torque, segments, rate_hz, stated)


def write_session(
    path: Path,
    signals: Signals,
    *,
    beam: Beam = PAPER_BEAM,
    metadata: Mapping[str, str] | None = None,
    segments: Mapping[str, tuple[int, int]] | None = None,
    ticks: ArrayLike | None = None,
    t_ns: ArrayLike | None = None,
    status: ArrayLike = 0,
    outcome: str = "complete",
) -> Path:
    """Write signals as a session file, of the format that rigd records.

    Parameters
    ----------
    path : Path
        File to write; one that exists is not overwritten.
    signals : Signals
    beam : Beam
        Beam that the file states.
    metadata : mapping of str to str, optional
        Further metadata, or other values of them.
    segments : mapping, optional
        Used instead of those of the signals.
    ticks, t_ns, status : array (n,), optional
        Ticks, times in ns, and status bits; by default no tick is missing, and nothing is amiss.
    outcome : str
        How the session ended.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    rigd.session.SessionExistsError
        If there is a file of that name.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from rigd.session import read_session
    >>> from rigd.testing import chirp_signals, write_session
    >>> with TemporaryDirectory() as folder:
    ...     signals = chirp_signals(sweep_s=10.0, ring_down_s=2.0)
    ...     session = read_session(write_session(Path(folder) / "known.mcap", signals))
    >>> len(session.samples), session.number("beam_length_m")
    (13000, 0.98)
    """
    at = np.arange(len(signals.angle_rad)) if ticks is None else np.asarray(ticks)
    samples = {
        "tick": at,
        "t_ns": np.rint(at * (1e9 / signals.rate_hz)) if t_ns is None else t_ns,
        "angle_reference_rad": signals.reference_rad,
        "angle_rad": signals.angle_rad,
        "coupling_torque_nm": signals.torque_nm,
        "status": status,
    }
    stated = {
        "rate_hz": repr(signals.rate_hz),
        "beam_length_m": repr(beam.length_m),
        "beam_density_kg_per_m": repr(beam.density_kg_per_m),
        "beam_bending_stiffness_n_m2": repr(beam.bending_stiffness_n_m2),
    }
    writer = SessionWriter(path)
    writer.begin(
        _START_UTC_NS,
        stated | signals.metadata | dict(metadata or {}),
        dict(signals.segments if segments is None else segments),
        {},
    )
    writer.write_samples(encode_samples(samples))
    return writer.close({"outcome": outcome})


def _answered(
    values: NDArray[np.float64],
    rate_hz: float,
    transfer_of_s: Callable[[NDArray[np.complex128]], NDArray[np.complex128]],
) -> NDArray[np.float64]:
    """Causal response (n,), by a transform on ``s = sigma + j omega`` of the record and zeros."""
    n = len(values)
    padded = 1 << (4 * n).bit_length()
    sigma = rate_hz / n
    decay = np.exp(-sigma * np.arange(n) / rate_hz)
    s = np.asarray(sigma + 2j * np.pi * np.fft.rfftfreq(padded, 1 / rate_hz), np.complex128)
    spectrum = np.multiply(np.fft.rfft(values * decay, padded), transfer_of_s(s))
    return np.asarray(np.fft.irfft(spectrum, padded)[:n] / decay)
