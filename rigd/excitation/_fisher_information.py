"""Fisher information of a record on the parameters of the beam, before or after it is recorded.

The torque that a motion of the motor causes is known but for the parameters; its derivatives,
whitened with the spectrum of the noise, tell how precisely a whole-record fit will determine them:
the inverse of their Gram matrix is the covariance that no unbiased estimate surpasses (Cramér and
Rao), and which the fit of `analysis` attains. What that fit projects out is projected out here as
well: free decay from before the record, offset and drift of the torque.

All of it happens in time, at a reduced rate: the derivatives of a record and of a piece after it
add up sample by sample, so that a piece costs no more than its own length, with the ringing of all
earlier ones counted.

References
----------
M. B. Zarrop, Optimal experiment design for dynamic system identification, Springer (1979).
L. Pronzato and A. Pázman, Design of experiments in nonlinear models, Springer (2013).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from math import isfinite, pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    Beam,
    Damping,
    LoadedBeam,
    clamped_free_eigenvalues,
    pole_gradient,
    poles_for_eigenvalues,
    tip_response,
    transfer,
    transfer_and_gradient,
)
from rigd.excitation._signals import ExcitationError

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating[Any, Any]]

BAND_HZ: Final = 50.0
"""Upper end of the band that the whole-record fit compares."""

OF_UNIFORM: Final = (
    "zeta",
    "alpha",
    "gamma",
    "lambda",
    "density_over_stiffness",
    "bending_stiffness_n_m2",
    "delay_s",
    "tool_inertia_kg_m2",
)
"""Parameters of the fit of a uniform beam on a rigid clamp."""

_OF_ENDS: Final = ("tip_mass_kg", "root_compliance_rad_per_nm")

PARAMETERS: Final = (*OF_UNIFORM, *_OF_ENDS)
"""Parameters of the fit; the `LOGARITHMIC` ones count by their logarithm."""

LOGARITHMIC: Final = frozenset(
    {"zeta", "gamma", "density_over_stiffness", "bending_stiffness_n_m2"}
)

_BY_PARAMETER: Final = {
    "density_over_stiffness": "ln_density_over_stiffness",
    "bending_stiffness_n_m2": "ln_stiffness",
}
"""Names by which the exact model is differentiated, where they differ."""

_OF_RIG: Final = ("delay_s", "tool_inertia_kg_m2", *_OF_ENDS)
"""Parameters beside beam and damping; 0 where nothing is said of them."""

_PRIOR_STD: Final = {
    "zeta": 3.0,
    "alpha": 1.0,
    "gamma": 3.0,
    "lambda": 1.0,
    "density_over_stiffness": 0.5,
    "bending_stiffness_n_m2": 0.5,
    "delay_s": 0.05,
}
"""What is known without any record: coefficients within a factor of 20, orders within (0, 2)."""

_TOLERATED: Final = {"ln_frequency": 1.0, "ln_residue": 3.0}
"""By what a mode of an antenna differs from that of the beam, with its standard deviation over the
uniformity, as the analyser has it. The number of the mode follows the name."""

_MODAL: Final = (*_TOLERATED, "ln_damping_ratio", "residue_phase_rad")
"""What a mode of the modal model is free in."""

_BACKGROUND: Final = 5
"""Terms of the modal model's background."""

_RATE_OVER_BAND: Final = 2.4
_TAPER: Final = 1.1
_DECAY: Final = 5.0
"""What wraps round in a transform of twice the length has decayed by exp(-5)."""


# What is known of the beam


@dataclass(frozen=True, slots=True)
class BeamEstimate:
    """The beam as a fit found it, with the noise that the torque had."""

    beam: Beam
    """Length as given, density and stiffness as estimated."""
    damping: Damping
    """Damping as estimated; a coefficient of 0 is a kind of damping that the structure has not."""
    names: tuple[str, ...]
    """Parameters that the fit leaves free, of `PARAMETERS`, and deviations of modes."""
    noise_frequency_hz: Real
    """Shape (m,), increasing: where the spectrum of the noise is given."""
    noise_nm2_per_hz: Real
    """Shape (m,): one-sided power spectral density of the torque's noise."""
    delay_s: float = 0.0
    """By how much the torque is older than the angle."""
    tool_inertia_kg_m2: float = 0.0
    """Inertia between torque sensor and beam."""
    tip_mass_kg: float = 0.0
    """Point mass at the tip."""
    root_compliance_rad_per_nm: float = 0.0
    """By how much the clamp turns for a torque."""
    stiffness_offsets: tuple[float, ...] = ()
    """Relative differences of the stiffness of modes 2, 3, … from the uniform beam's."""
    uniformity: float = 0.0
    """Relative standard deviation of each mode's frequency from that of the beam."""

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "BeamEstimate":
        """Take over an estimate from JSON.

        Parameters
        ----------
        document
            ``beam`` with the keys of `Beam`; ``damping`` with zeta, alpha, gamma and lambda;
            ``names``; ``noise`` with ``frequency_hz`` and ``nm2_per_hz``, one-sided; and perhaps
            ``delay_s``, ``tool_inertia_kg_m2``, ``tip_mass_kg``, ``root_compliance_rad_per_nm``
            and ``stiffness_offsets``. Other keys are ignored.

        Raises
        ------
        ExcitationError
            If a key is missing, or its value is of no use.
        """
        try:
            damping, noise = document["damping"], document["noise"]
            estimate = cls(
                beam=Beam(
                    **{
                        key: float(document["beam"][key])
                        for key in ("length_m", "density_kg_per_m", "bending_stiffness_n_m2")
                    }
                ),
                damping=Damping(
                    **{
                        key: float(damping[key.rstrip("_")])
                        for key in ("zeta", "alpha", "gamma", "lambda_")
                    }
                ),
                names=tuple(name for name in document["names"] if name in PARAMETERS),
                noise_frequency_hz=np.array(noise["frequency_hz"], dtype=np.float64),
                noise_nm2_per_hz=np.array(noise["nm2_per_hz"], dtype=np.float64),
                **{key: float(document.get(key, 0.0)) for key in _OF_RIG},
                stiffness_offsets=tuple(map(float, document.get("stiffness_offsets", ()))),
            )
        except KeyError as error:
            raise ExcitationError(f"The estimate of the beam has no key {error}.") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise ExcitationError(f"The estimate of the beam cannot be read: {error}.") from None
        estimate.check()
        return estimate

    @classmethod
    def stated(
        cls, beam: Beam, damping: Damping, noise_nm2_per_hz: float, tip_mass_kg: float = 0.0
    ) -> "BeamEstimate":
        """Return a beam that is known beforehand, all parameters of a uniform one free.

        Parameters
        ----------
        beam, damping
            As stated.
        noise_nm2_per_hz
            One-sided power spectral density of the torque's noise, white.
        tip_mass_kg
            Point mass at the tip, held.
        """
        absent = {
            *(() if damping.zeta else ("zeta", "alpha")),
            *(() if damping.gamma else ("gamma", "lambda")),
        }
        return cls(
            beam,
            damping,
            tuple(name for name in OF_UNIFORM if name not in absent),
            np.array([1.0]),
            np.array([noise_nm2_per_hz]),
            tip_mass_kg=tip_mass_kg,
        )

    def check(self) -> None:
        """Refuse what no record can be predicted from.

        Raises
        ------
        ExcitationError
            If a value is not finite or has no meaning, or nothing is free.
        """
        beam, damping = self.beam, self.damping
        for key, value, least, below in (
            ("beam.length_m", beam.length_m, 1e-6, np.inf),
            ("beam.density_kg_per_m", beam.density_kg_per_m, 1e-12, np.inf),
            ("beam.bending_stiffness_n_m2", beam.bending_stiffness_n_m2, 1e-12, np.inf),
            ("damping.zeta", damping.zeta, 0.0, np.inf),
            ("damping.alpha", damping.alpha, 0.0, 2.0),
            ("damping.gamma", damping.gamma, 0.0, np.inf),
            ("damping.lambda", damping.lambda_, 0.0, 2.0),
            *((key, getattr(self, key), -np.inf, np.inf) for key in _OF_RIG),
            *(("stiffness_offsets", each, -0.9, 10.0) for each in self.stiffness_offsets),
        ):
            if not (isfinite(value) and least <= value < below):
                raise ExcitationError(f"The estimate of the beam has {key} = {value}.")
        frequency_hz, density = self.noise_frequency_hz, self.noise_nm2_per_hz
        if not (
            frequency_hz.ndim == 1
            and frequency_hz.size > 0
            and density.shape == frequency_hz.shape
            and bool(np.all(np.diff(frequency_hz) > 0.0))
            and bool(np.all(np.isfinite(density) & (density > 0.0)))
        ):
            raise ExcitationError(
                "The estimate of the beam needs noise.frequency_hz, increasing, and as many "
                "positive noise.nm2_per_hz."
            )
        if not self.names:
            raise ExcitationError("The estimate of the beam has no free parameter in names.")

    def with_tolerance(self, uniformity: float) -> "BeamEstimate":
        """Leave the modes free within a tolerance of the geometry, and the orders of the damping.

        Parameters
        ----------
        uniformity
            Relative standard deviation of each mode's frequency; 0 changes nothing.
        """
        if not uniformity:
            return self
        orders = [name for name in ("alpha", "lambda") if name not in self.names]
        present = {"alpha": self.damping.zeta, "lambda": self.damping.gamma}
        modes = [mode.number for mode in self.modes()]
        deviations = [f"{name}_{number}" for number in modes for name in _TOLERATED]
        free = (*self.names, *(name for name in orders if present[name]), *deviations)
        return replace(self, names=free, uniformity=uniformity)

    def modal(self) -> "BeamEstimate":
        """Leave the constants of each mode free and a background, and nothing of the beam."""
        modes = [mode.number for mode in self.modes()]
        constants = [f"{name}_{number}" for number in modes for name in _MODAL]
        background = [f"background_{power}" for power in range(_BACKGROUND)]
        return replace(self, names=(*constants, *background), uniformity=1.0)

    @property
    def values(self) -> dict[str, float]:
        """Values of all `PARAMETERS` by name."""
        beam, damping = self.beam, self.damping
        return dict(
            zip(
                PARAMETERS,
                (
                    *(damping.zeta, damping.alpha, damping.gamma, damping.lambda_),
                    *(beam.density_over_stiffness, beam.bending_stiffness_n_m2),
                    *(getattr(self, key) for key in _OF_RIG),
                ),
                strict=True,
            )
        )

    @property
    def loaded(self) -> LoadedBeam | None:
        """The beam with what is at its ends; None if nothing is, and nothing of it is free."""
        at_ends = self.tip_mass_kg or self.root_compliance_rad_per_nm or any(self.stiffness_offsets)
        if not at_ends and set(_OF_ENDS).isdisjoint(self.names):
            return None
        return self.loaded_beam

    @property
    def loaded_beam(self) -> LoadedBeam:
        """The beam with what is at its ends."""
        return LoadedBeam(
            self.beam,
            self.damping,
            self.tip_mass_kg,
            self.root_compliance_rad_per_nm,
            self.stiffness_offsets,
        )

    def modes(self, highest_hz: float = BAND_HZ) -> tuple["EstimatedMode", ...]:
        """Modes that oscillate below a frequency, with what moves them.

        Parameters
        ----------
        highest_hz
            Upper end of the band.
        """
        count = 2
        while True:
            z = clamped_free_eigenvalues(count)
            reached = (z / self.beam.length_m) ** 2 > 2 * pi * highest_hz * np.sqrt(
                self.beam.density_over_stiffness
            )
            if reached[-1]:
                break
            count *= 2
        loaded = self.loaded
        pairs = (
            poles_for_eigenvalues(z, self.beam, self.damping) if loaded is None else loaded.poles(z)
        )
        parameters = [name for name in self.names if name in PARAMETERS]
        names = [_BY_PARAMETER.get(name, name) for name in parameters]
        shown = {
            number: pole
            for number, pole in enumerate(pairs[:, 0].tolist(), start=1)
            if np.isfinite(pole) and 0.0 < pole.imag < 2 * pi * highest_hz
        }
        if loaded is None:
            stiffness = (z / self.beam.length_m) ** 4
            moved: Iterable[Complex] = (
                pole_gradient(pole, float(stiffness[number - 1]), self.beam, self.damping, names)
                for number, pole in shown.items()
            )
        else:
            moved = loaded.pole_gradients(np.array([*shown.values()], dtype=np.complex128), names)
        scales = _scales(self)
        found = []
        for (number, pole), row in zip(shown.items(), moved, strict=True):
            gradient = np.zeros(len(self.names), dtype=np.complex128)
            gradient[: len(parameters)] = row * scales
            for place, name in enumerate(self.names):
                if name.endswith(f"_{number}"):
                    gradient[place] = _CHANGES[name.rpartition("_")[0]](pole, 0j)[0]
            found.append(EstimatedMode(number, pole, gradient))
        return tuple(found)


_CHANGES: Final[Mapping[str, Callable[[complex, complex], tuple[complex, complex]]]] = {
    "ln_frequency": lambda pole, _: (pole, 0j),
    "ln_damping_ratio": lambda pole, _: (complex(pole.real), 0j),
    "ln_residue": lambda _, residue: (0j, residue),
    "residue_phase_rad": lambda _, residue: (0j, 1j * residue),
    "background": lambda *_: (0j, 0j),
}
"""Derivatives of the pole and the residue of a mode by its constants."""


@dataclass(frozen=True, slots=True)
class EstimatedMode:
    """A mode of the estimated beam with locked hub."""

    number: int
    """From 1 on."""
    pole_rad_s: complex
    """Upper one of the pair."""
    gradient: Complex
    """Shape (k,): derivatives of the pole by the free parameters."""

    @property
    def frequency_hz(self) -> float:
        """Frequency of the free decay."""
        return self.pole_rad_s.imag / (2 * pi)

    @property
    def damping_ratio(self) -> float:
        """Share of the critical damping."""
        return -self.pole_rad_s.real / abs(self.pole_rad_s)

    @property
    def frequency_gradient_hz(self) -> Real:
        """Derivatives of the frequency, shape (k,)."""
        return np.asarray(self.gradient.imag / (2 * pi), dtype=np.float64)

    @property
    def damping_gradient(self) -> Real:
        """Derivatives of the damping ratio, shape (k,)."""
        p, size = self.pole_rad_s, abs(self.pole_rad_s)
        of_size = (p.conjugate() * self.gradient).real / size
        slope = -self.gradient.real / size - self.damping_ratio * of_size / size
        return np.asarray(slope, dtype=np.float64)


def _scales(estimate: BeamEstimate) -> Real:
    """Return factors from derivatives of the exact model to those by the free parameters."""
    values = estimate.values
    names = [name for name in estimate.names if name in PARAMETERS]
    return np.array([values[name] if name in ("zeta", "gamma") else 1.0 for name in names])


# Whitened derivatives of the torque


@dataclass(frozen=True, slots=True, eq=False)
class TorqueModel:
    """The exact model on the frequencies of records of one length, ready for any motion."""

    estimate: BeamEstimate
    """What the torque is computed from."""
    rate_hz: float
    """Rate of the angle."""
    ticks: int
    """Length of the records, at that rate: a multiple of `factor`."""
    factor: int
    """One tick in so many is a sample."""
    sigma_per_s: float
    """Real part of the Laplace variable."""
    kernels: Complex
    """Shape (k, K): whitened derivatives of the response from angle to torque."""
    channels: Complex
    """Shape (2, K): responses from angle to torque in N·m/rad, and to the slope of the tip."""

    @classmethod
    def of(cls, estimate: BeamEstimate, rate_hz: float, ticks: int) -> "TorqueModel":
        """Evaluate the model for records of at least so many ticks.

        Parameters
        ----------
        estimate
            Beam, damping and noise.
        rate_hz
            Rate of the angle.
        ticks
            Least length.
        """
        factor = reduction(rate_hz)
        # Twice the length, and one of which a transform is quick.
        half = -(-ticks // factor)
        half = _quick(half)
        ticks = half * factor
        samples = 2 * half
        sample_hz = rate_hz / factor
        sigma = _DECAY * sample_hz / samples
        frequency_hz = np.fft.rfftfreq(samples, 1.0 / sample_hz)
        # What lies above is no part of the band, nor of any mode that is seen.
        frequency_hz = frequency_hz[frequency_hz <= _TAPER * BAND_HZ]
        s = sigma + 2j * pi * frequency_hz
        kernels = whitened_kernels(estimate, s, sample_hz)
        return cls(
            estimate, rate_hz, ticks, factor, sigma, kernels, np.stack(responses(estimate, s)[1:])
        )

    @property
    def sample_hz(self) -> float:
        """Rate of the samples."""
        return self.rate_hz / self.factor

    def spectrum(self, angle_rad: Real) -> Complex:
        """Transform of an angle from rest, (n,) with n at most `ticks`, in the band."""
        time_s = np.arange(angle_rad.size) / self.rate_hz
        faded = angle_rad * np.exp(-self.sigma_per_s * time_s)
        spectrum: Complex = np.fft.rfft(faded, 2 * self.ticks)[: self.kernels.shape[1]]
        return spectrum

    def rows(self, spectrum: Complex) -> Real:
        """Whitened derivatives of the torque by the parameters, shape (k, ticks / factor)."""
        return self._in_time(self.kernels * (spectrum / self.factor), self.ticks // self.factor, 1)

    def motion(self, spectrum: Complex) -> Real:
        """Torque (N·m) and slope of the tip (rad) at every tick, shape (2, ticks)."""
        return self._in_time(self.channels * spectrum, self.ticks, self.factor)

    def _in_time(self, spectra: Complex, samples: int, finer: int) -> Real:
        time_s = np.arange(samples) * (self.factor / finer / self.rate_hz)
        values = np.fft.irfft(spectra, 2 * samples)[:, :samples]
        values *= np.exp(self.sigma_per_s * time_s)
        return values


def responses(estimate: BeamEstimate, s: Complex) -> tuple[Complex, Complex, Complex]:
    """Responses from the angle to torques in N·m/rad, and to the slope of the tip.

    Parameters
    ----------
    estimate
        Beam, damping, tool inertia and delay.
    s
        Laplace variable in rad/s, of any shape.

    Returns
    -------
    of_beam, measured, slope
        Torque on the beam; as it is measured, tool inertia and delay included; slope of the tip
        against the root.
    """
    loaded = estimate.loaded
    if loaded is None:
        g = transfer(s, estimate.beam, estimate.damping)
        slope = tip_response(estimate.beam, estimate.damping, s)[1] - 1.0
    else:
        at = s.astype(np.complex128)
        g, slope = loaded.transfer(at), loaded.tip_slope(at)
    measured = (g + estimate.tool_inertia_kg_m2 * s * s) * np.exp(-s * estimate.delay_s)
    return g, measured, slope


def whitened_kernels(estimate: BeamEstimate, s: Complex, sample_hz: float) -> Complex:
    """Differentiate the response from angle to torque, in units of the noise; shape (k, K).

    Parameters
    ----------
    estimate
        Beam, damping, noise, and what is free.
    s
        Laplace variable in rad/s, shape (K,).
    sample_hz
        Rate of the samples whose noise is to have variance 1.
    """
    names = [name for name in estimate.names if name in PARAMETERS]
    wrt = [_BY_PARAMETER.get(n, n) for n in names if n not in ("delay_s", "tool_inertia_kg_m2")]
    loaded = estimate.loaded
    g = of_beam = np.zeros((0, s.size), dtype=np.complex128)
    if names:
        g, of_beam = (
            transfer_and_gradient(s, estimate.beam, estimate.damping, wrt)
            if loaded is None
            else loaded.transfer_and_gradient(s.astype(np.complex128), wrt)
        )
    late = np.exp(-s * estimate.delay_s)
    kernels: Complex = np.empty((len(estimate.names), s.size), dtype=np.complex128)
    kernels[len(names) :] = _by_constants(estimate, s) * late
    rows = iter(of_beam)
    for out, name, scale in zip(kernels[: len(names)], names, _scales(estimate), strict=True):
        if name == "delay_s":
            out[:] = -s * (g + estimate.tool_inertia_kg_m2 * s * s) * late
        elif name == "tool_inertia_kg_m2":
            out[:] = s * s * late
        else:
            out[:] = scale * next(rows) * late
    kernels *= _whitening(estimate, s.imag / (2 * pi), sample_hz)
    return kernels


def _by_constants(estimate: BeamEstimate, s: Complex) -> Complex:
    """Differentiate the response by the constants of modes that are free and the background."""
    poles = {mode.number: mode.pole_rad_s for mode in estimate.modes()}
    rows = []
    for name in estimate.names:
        if name in PARAMETERS:
            continue
        kind, _, number = name.rpartition("_")
        if kind == "background":
            rows.append((s / (2 * pi * BAND_HZ)) ** int(number))
            continue
        pole = poles[int(number)]
        residue = complex(estimate.loaded_beam.residues(np.array([pole]))[0]) * pole**2
        by_pole, by_residue = _CHANGES[kind](pole, residue)
        upper, lower = s - pole, s - pole.conjugate()
        row = residue * by_pole / upper**2 + by_residue / upper
        other = (residue * by_pole).conjugate() / lower**2 + by_residue.conjugate() / lower
        rows.append(row + other)
    return np.array(rows, dtype=np.complex128).reshape(-1, s.size)


def reduction(rate_hz: float) -> int:
    """Return how many ticks make a sample of the band."""
    return max(int(rate_hz / (_RATE_OVER_BAND * BAND_HZ)), 1)


def _whitening(
    estimate: BeamEstimate, frequency_hz: NDArray[np.floating[Any]], sample_hz: float
) -> Real:
    """Weight that gives the noise of a sample variance 1, fading at the end of the band."""
    density = np.interp(
        frequency_hz, estimate.noise_frequency_hz, np.log(estimate.noise_nm2_per_hz)
    )
    fade = np.clip((frequency_hz / BAND_HZ - 1.0) / (_TAPER - 1.0), 0.0, 1.0)
    weight: Real = np.exp(-0.5 * density) * np.sqrt(2.0 / sample_hz)
    weight *= 0.5 + 0.5 * np.cos(pi * fade)
    return weight


def _quick(least: int) -> int:
    """Length of which a transform is quick: at most an eighth more than the least one."""
    unit = 1 << max(0, least.bit_length() - 4)
    return -(-least // unit) * unit


# Information


@dataclass(frozen=True, slots=True, eq=False)
class RecordSoFar:
    """A record that goes on: its information, and what of it still rings."""

    estimate: BeamEstimate
    """What it was computed with."""
    before: Real
    """(k + m, k + m): Gram matrix of the derivatives and of m nuisance terms up to now."""
    ahead: Real
    """(k + m, samples): the same derivatives and terms from now on, the motor held."""
    ringing: Real
    """(2, ticks): torque (N·m) and slope of the tip (rad) from now on, the motor held."""

    @classmethod
    def of(
        cls, angle_rad: Real, estimate: BeamEstimate, rate_hz: float, ahead_s: float = 0.0
    ) -> "RecordSoFar":
        """Evaluate a record.

        Parameters
        ----------
        angle_rad
            Shape (n,): motor angle so far, measured or predicted; the beam rested at the first.
        estimate
            Beam, damping and noise.
        rate_hz
            Rate of the angle.
        ahead_s
            How far ahead the ringing is wanted.
        """
        factor = reduction(rate_hz)
        # Rest before it, so that a sample lies at its end.
        angle_rad = np.concatenate([np.zeros(-angle_rad.size % factor), angle_rad - angle_rad[0]])
        ahead = -(-round(ahead_s * rate_hz) // factor)
        samples = angle_rad.size // factor
        model = TorqueModel.of(estimate, rate_hz, angle_rad.size + ahead * factor)
        spectrum = model.spectrum(angle_rad)
        rows = np.concatenate(
            [
                model.rows(spectrum)[:, : samples + ahead],
                _nuisance(estimate, samples + ahead, model.sample_hz),
            ]
        )
        ringing = np.zeros((2, 0))
        if ahead:
            first = angle_rad.size
            ringing = model.motion(spectrum)[:, first : first + ahead * factor]
        before = rows[:, :samples]
        return cls(estimate, before @ before.T, rows[:, samples:], ringing)

    @property
    def through(self) -> Real:
        """Take what the nuisance terms explain out of the derivatives: (k, k + m)."""
        k = len(self.estimate.names)
        return np.concatenate([np.eye(k), -_explained(self.before, k)], axis=1)

    def after(self, more: Real | None, samples: int) -> Real:
        """Information (k, k) when so many more samples are recorded.

        Parameters
        ----------
        more
            Shape (k, n): derivatives that a piece adds from now on, n at least `samples`; None: the
            motor is held.
        samples
            Samples from now on that count.
        """
        rows = self.ahead[:, :samples]
        if more is not None:
            rows = rows.copy()
            rows[: more.shape[0]] += more[:, :samples]
        return projected(self.before + rows @ rows.T, len(self.estimate.names))


def information(angle_rad: Real, estimate: BeamEstimate, rate_hz: float) -> Real:
    """Fisher information of a record on the free parameters of the beam, shape (k, k).

    Free decay from before the record, and offset and drift of the torque, are unknown as well:
    what they take away is taken away. In the order of ``estimate.names``, zeta, gamma, density over
    stiffness and stiffness counted by their logarithms. Its inverse is the least covariance.

    Parameters
    ----------
    angle_rad
        Shape (n,): motor angle, measured or predicted; the beam rested at the first.
    estimate
        Beam, damping, noise, and what is free.
    rate_hz
        Rate of the angle.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping
    >>> from rigd.excitation import BeamEstimate, chirp, information
    >>> estimate = BeamEstimate(
    ...     beam=Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903),
    ...     damping=Damping(zeta=7e-5, gamma=0.02),
    ...     names=("zeta", "gamma", "density_over_stiffness"),
    ...     noise_frequency_hz=np.array([1.0]),
    ...     noise_nm2_per_hz=np.array([2e-7]),
    ... )
    >>> angle_rad = chirp(rate_hz=1000, start_hz=0.5, duration_s=5).reference_rad
    >>> std = np.sqrt(np.diag(np.linalg.inv(information(angle_rad, estimate, 1000))))
    >>> print(f"zeta {std[0]:.1%}, gamma {std[1]:.1%}")
    zeta 0.4%, gamma 1.4%
    """
    return RecordSoFar.of(angle_rad, estimate, rate_hz).after(None, 0)


def projected(gram: Real, k: int) -> Real:
    """Information on the first k parameters when all others are unknown, shape (k, k).

    Parameters
    ----------
    gram
        Shape (k + m, k + m): of the derivatives.
    k
        Number of the parameters that are wanted.
    """
    information: Real = gram[:k, :k] - _explained(gram, k) @ gram[k:, :k]
    return 0.5 * (information + information.T)


def _explained(gram: Real, k: int) -> Real:
    """Regression of the first k derivatives on the others, shape (k, m)."""
    size = np.sqrt(np.maximum(np.diag(gram)[k:], 1e-300))
    unit = gram[k:, k:] / np.outer(size, size) + 1e-12 * np.eye(size.size)
    factors: Real = np.linalg.solve(unit, gram[k:, :k] / size[:, None]).T / size
    return factors


def covariance_of(information: Real, estimate: BeamEstimate) -> Real:
    """Covariance for an information, with the little that is known without any record."""
    prior = np.array([_prior_std(name, estimate) for name in estimate.names])
    # In units of the prior the matrix is well scaled wherever something is known.
    unit = information * np.outer(prior, prior) + np.eye(len(prior))
    size = np.sqrt(np.diag(unit))
    inverse: Real = np.linalg.inv(unit / np.outer(size, size))
    return inverse * np.outer(prior / size, prior / size)


def _prior_std(name: str, estimate: BeamEstimate) -> float:
    beam = estimate.beam
    kind = name.rpartition("_")[0]
    if kind == "background":
        return 10.0 * beam.bending_stiffness_n_m2 / beam.length_m
    if kind in _MODAL:
        return _TOLERATED.get(kind, 1.0) * estimate.uniformity
    if name == "tool_inertia_kg_m2":
        return beam.inertia_kg_m2
    if name == "tip_mass_kg":
        return beam.density_kg_per_m * beam.length_m
    if name == "root_compliance_rad_per_nm":
        return beam.length_m / beam.bending_stiffness_n_m2
    return _PRIOR_STD[name]


def _nuisance(estimate: BeamEstimate, samples: int, sample_hz: float) -> Real:
    """Whitened decays from the first sample on, offset and drift, shape (m, samples)."""
    time_s = np.arange(samples) / sample_hz
    poles = np.array([mode.pole_rad_s for mode in estimate.modes()])
    decays = np.exp(np.outer(poles, time_s))
    weight = _whitening(estimate, poles.imag / (2 * pi), sample_hz)[:, None]
    slow = _whitening(estimate, np.zeros(1), sample_hz)[0]
    level = np.stack([np.ones(samples), time_s]) * slow
    return np.concatenate([decays.real * weight, decays.imag * weight, level])
