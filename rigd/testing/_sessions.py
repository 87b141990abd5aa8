"""Records of a beam with known parameters, as arrays and as session files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.beam import Beam, Damping, transfer
from rigd.session import SessionWriter
from rigd.session.layout import encode_samples

PAPER_BEAM = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
"""Antenna of the reference paper (Table 1)."""
PAPER_DAMPING = Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594)
"""Best model of the reference paper: type VI with frequency-dependent weights (Table 3)."""

_MOTOR_LOOP_POLE_RAD_S = 80.0
"""Both poles of the simulated motor control loop, in rad/s."""
_START_UTC_NS = 1_700_000_000_000_000_000
"""Start time of the written sessions, in ns since 1970."""


@dataclass(frozen=True)
class Signals:
    """Signals of a session, with one value per tick, and the segments of the session.

    Attributes
    ----------
    reference_rad, angle_rad, torque_nm : array (n,)
        Reference angle, motor angle, and coupling torque on the motor's shaft.
    segments : dict of str to (int, int)
        First tick and end (exclusive) of ``rest``, ``sweep`` and ``ring_down``.
    rate_hz : float
        Sampling rate.
    metadata : dict of str to str
        Metadata on the excitation for the session file.
    """

    reference_rad: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    segments: dict[str, tuple[int, int]]
    rate_hz: float = 1000.0
    metadata: dict[str, str] = field(default_factory=dict)

    def part(self, sample_selection: slice | NDArray[np.generic]) -> "Signals":
        """Return selected samples, by NumPy's indexing; segments and rate are unchanged."""
        return replace(
            self,
            reference_rad=self.reference_rad[sample_selection],
            angle_rad=self.angle_rad[sample_selection],
            torque_nm=self.torque_nm[sample_selection],
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
    """Return the coupling torque in N·m that the exact beam model gives for a motor motion.

    Parameters
    ----------
    angle_rad : array (n,)
        Angle of the motor, at rest before the first sample.
    rate_hz : float
        Sampling rate.
    beam, damping
        Parameters of the beam. Default: those of the reference paper.
    tool_inertia_kg_m2 : float
        Inertia between the sensor and the beam.
    delay_s : float
        Delay of the torque channel.

    Returns
    -------
    array (n,)
        Coupling torque in N·m.

    Notes
    -----
    Eq. 25 is evaluated on a line ``s = sigma + j omega``. The factor ``exp(-sigma t)`` prevents the
    end of the record, where the beam still rings, from leaking into the beginning.

    Examples
    --------
    A stiff beam that turns slowly acts almost like a rigid inertia.

    >>> import numpy as np
    >>> from rigd.beam import Beam
    >>> from rigd.testing import beam_torque
    >>> stiff = Beam(length_m=0.5, density_kg_per_m=0.03, bending_stiffness_n_m2=100.0)
    >>> t = np.arange(4000) / 1000
    >>> torque_nm = beam_torque(0.1 * np.sin(2 * np.pi * t) ** 3, 1000.0, beam=stiff)
    >>> torque_nm.shape
    (4000,)
    """
    return _causal_response(
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
    """Return the signals of a chirp through a simulated motor loop and the exact beam.

    Parameters
    ----------
    rest_s, sweep_s, ring_down_s : float
        Durations of the segments.
    rate_hz : float
        Sampling rate.
    amplitude_rad, start_hz, stop_hz : float
        Amplitude and first and last frequency of the reference. Default: those of the reference
        paper.
    beam, damping, tool_inertia_kg_m2
        As for :func:`beam_torque`.
    angle_delay_s, torque_delay_s : float
        Delay of the angle's and of the torque's channel.
    noise_nm : float
        Standard deviation of the white noise in the torque.
    quantum_rad : float
        Resolution of the encoder; 0 for an ideal encoder.
    seed : int
        Seed of the random noise.

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
    rest_samples, sweep_samples, ring_down_samples = (
        round(duration_s * rate_hz) for duration_s in (rest_s, sweep_s, ring_down_s)
    )
    t = np.arange(sweep_samples) / rate_hz
    chirp_phase_rad = 2 * np.pi * (start_hz * t + (stop_hz - start_hz) * t**2 / (2 * sweep_s))
    chirp_reference_rad = np.zeros(rest_samples + sweep_samples + ring_down_samples)
    chirp_reference_rad[rest_samples : rest_samples + sweep_samples] = amplitude_rad * np.sin(
        chirp_phase_rad
    )

    def motor_response(s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return 1 / (1 + s / _MOTOR_LOOP_POLE_RAD_S) ** 2

    def torque_response(s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        beam_response = transfer(s, beam, damping) + tool_inertia_kg_m2 * s**2
        return np.asarray(beam_response * motor_response(s) * np.exp(-s * torque_delay_s))

    measured_angle_rad = _causal_response(
        chirp_reference_rad, rate_hz, lambda s: motor_response(s) * np.exp(-s * angle_delay_s)
    )
    if quantum_rad:
        measured_angle_rad = quantum_rad * np.round(measured_angle_rad / quantum_rad)
    torque_noise_nm = noise_nm * np.random.default_rng(seed).standard_normal(
        chirp_reference_rad.size
    )
    segments = {
        "rest": (0, rest_samples),
        "sweep": (rest_samples, rest_samples + sweep_samples),
        "ring_down": (rest_samples + sweep_samples, chirp_reference_rad.size),
    }
    coupling_torque_nm = (
        _causal_response(chirp_reference_rad, rate_hz, torque_response) + torque_noise_nm
    )
    metadata = {"excitation": "chirp", "start_hz": repr(start_hz), "stop_hz": repr(stop_hz)}
    return Signals(
        chirp_reference_rad, measured_angle_rad, coupling_torque_nm, segments, rate_hz, metadata
    )


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
    """Write signals as a session file in rigd's format, and return its path.

    Parameters
    ----------
    path : Path
        New file. An existing file is not overwritten.
    signals : Signals
        Signals to write.
    beam : Beam
        Beam whose parameters the file states.
    metadata : mapping of str to str, optional
        Additional metadata, or replaced values of the default metadata.
    segments : mapping, optional
        Segments to state instead of those of the signals.
    ticks, t_ns, status : array (n,), optional
        Ticks, times in ns, and status bits. Default: no tick is missing, and no status bit is set.
    outcome : str
        Outcome that the file states.

    Returns
    -------
    Path
        Path of the file.

    Raises
    ------
    rigd.session.SessionExistsError
        If a file of that name exists.

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
    sample_ticks = np.arange(len(signals.angle_rad)) if ticks is None else np.asarray(ticks)
    sample_columns = {
        "tick": sample_ticks,
        "t_ns": np.rint(sample_ticks * (1e9 / signals.rate_hz)) if t_ns is None else t_ns,
        "angle_reference_rad": signals.reference_rad,
        "angle_rad": signals.angle_rad,
        "coupling_torque_nm": signals.torque_nm,
        "status": status,
    }
    default_metadata = {
        "rate_hz": repr(signals.rate_hz),
        "beam_length_m": repr(beam.length_m),
        "beam_density_kg_per_m": repr(beam.density_kg_per_m),
        "beam_bending_stiffness_n_m2": repr(beam.bending_stiffness_n_m2),
    }
    session_writer = SessionWriter(path)
    session_writer.begin(
        _START_UTC_NS,
        default_metadata | signals.metadata | dict(metadata or {}),
        dict(signals.segments if segments is None else segments),
        {},
    )
    session_writer.write_samples(encode_samples(sample_columns))
    return session_writer.close({"outcome": outcome})


def _causal_response(
    input_values: NDArray[np.float64],
    rate_hz: float,
    transfer_function: Callable[[NDArray[np.complex128]], NDArray[np.complex128]],
) -> NDArray[np.float64]:
    """Return the causal response (n,) of a transfer function to values that begin at rest.

    It does not use `rigd.beam.CausalTransform`, so that tests with these signals verify that class.
    """
    sample_count = len(input_values)
    padded_length = 1 << (4 * sample_count).bit_length()
    sigma_per_s = rate_hz / sample_count
    decay_factors = np.exp(-sigma_per_s * np.arange(sample_count) / rate_hz)
    s = np.asarray(
        sigma_per_s + 2j * np.pi * np.fft.rfftfreq(padded_length, 1 / rate_hz), np.complex128
    )
    output_spectrum = np.multiply(
        np.fft.rfft(input_values * decay_factors, padded_length), transfer_function(s)
    )
    return np.asarray(np.fft.irfft(output_spectrum, padded_length)[:sample_count] / decay_factors)
