"""Finite-dimensional stand-in for Eq. 25 that can run in real time.

``G(s) / s²``, coupling torque per angular acceleration, is approximated by poles and direct terms::

    G(s) ≈ s² [ sum_i r_i / (s - p_i) + D ] + V s + K

with one complex pair a clamped–free mode, where the exact poles are, and a fixed ladder of real
poles for the branch cut of the fractional orders. Only the residues and the direct terms are
fitted: one linear least-squares problem with relative errors as residuals. V and K are needed: the
branch point at s = 0 makes G fall slower than s² there. D, V and K are kept from going negative and
the fit has a faint tail beyond its band, because an approximation can be accurate in the band and
still not be passive, and then motor and beam together are unstable.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.beam.coupled import couple
from rigd.beam.modes import clamped_free_eigenvalues
from rigd.beam.parameters import Beam, Damping
from rigd.beam.state_space import Realisation, basis
from rigd.beam.tip_mass import LoadedBeam
from rigd.beam.transfer_function import TransferGrid

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

ERROR_BAND_HZ = (0.05, 100.0)
"""Where a realisation answers for its error: the paper's chirp and an octave above."""

MAX_GROWTH_PER_S = 1e-2
"""A frictionless motor with the beam attached may not grow faster than this. Zero would refuse the
undamped beam, whose poles lie on the imaginary axis but for rounding and the fit's error."""

_MODES_UP_TO_HZ = 1200.0
_MOST_MODES = 300
_HEAVY_DAMPING = 0.8
"""Damping ratio from which a pair beyond the band is left out: with the real poles next to it, it
would only offer huge residues that cancel in the band."""
_CUT_POLES = -(10.0 ** (np.arange(-6, 14) / 3.0))
_FIT_BAND_HZ = (0.02, 500.0)
_TAIL_HZ = (1e-4, 1080.0)
_TAIL_WEIGHT = 1e-3
_CLOSEST = 3e-7
_RCOND = 1e-10
"""Cuts off the combinations of columns that would buy the last digit in the band with huge residues
that cancel there and nowhere else."""


class RealisationError(ValueError):
    """The damping cannot be realised to the error asked for, or not stably."""


def realise(
    beam: Beam,
    damping: Damping,
    *,
    max_relative_error: float = 1e-3,
    tip_mass_kg: float = 0.0,
    root_compliance_rad_per_nm: float = 0.0,
) -> Realisation:
    """Real-time realisation of the beam.

    Parameters
    ----------
    beam, damping
        What to realise.
    tip_mass_kg, root_compliance_rad_per_nm
        Point mass at its tip, and by how much its clamp turns for a torque.
    max_relative_error
        Largest acceptable relative error over `ERROR_BAND_HZ`.

    Raises
    ------
    RealisationError
        If the error is larger, naming the error achieved; if the realisation would make a
        frictionless motor unstable; if the exact beam itself is not passive: negative
        coefficients, orders outside 0…2; or if the beam has more than 300 modes to realise.
    """
    _check_passive(damping)
    loaded = LoadedBeam(beam, damping, tip_mass_kg, root_compliance_rad_per_nm)
    poles = _poles(loaded)
    zeros = _zeros(loaded)
    landmarks = np.concatenate([poles[poles.imag > 0], zeros])

    omega, weight = _fit_grid(landmarks)
    apart = _apart(omega, poles, zeros)
    s = 1j * omega[apart]
    exact = _exact(loaded, s)
    scale = weight[apart] / exact
    coefficients = _fit(basis(s, poles) * scale[:, None], weight[apart].astype(np.complex128))

    error = _relative_error(loaded, poles, zeros, coefficients)
    if not error <= max_relative_error:
        raise RealisationError(
            f"{damping} on {beam} is realised with a relative error of {error:.1e} between "
            f"{ERROR_BAND_HZ[0]:g} and {ERROR_BAND_HZ[1]:g} Hz; {max_relative_error:.1e} was asked."
        )
    realisation = _state_space(poles, coefficients, error)
    growth = _growth_on_frictionless_motor(realisation, beam)
    if growth > MAX_GROWTH_PER_S:
        raise RealisationError(
            f"{damping} on {beam} is realised with a relative error of {error:.1e}, but a motor "
            f"without friction would be unstable with it (growth {growth:.1e} 1/s)."
        )
    return realisation


def _check_passive(damping: Damping) -> None:
    values = (damping.zeta, damping.gamma, damping.alpha, damping.lambda_)
    if not all(value >= 0 for value in values) or not max(damping.alpha, damping.lambda_) < 2:
        raise RealisationError(
            f"{damping} describes a beam that creates energy: zeta and gamma must not be negative, "
            "alpha and lambda must lie between 0 and 2."
        )


def _exact(loaded: LoadedBeam, s: Complex) -> Complex:
    """Transfer function of the beam as it is, of the shape of s."""
    if loaded.tip_mass_kg == 0 and loaded.root_compliance_rad_per_nm == 0:
        return TransferGrid(s).evaluate(loaded.beam, loaded.damping)
    return loaded.transfer(np.asarray(s, dtype=np.complex128))


def _poles(loaded: LoadedBeam) -> Complex:
    """Modes up to 1.2 kHz, upper half plane first, then every real pole."""
    beam = loaded.beam
    reach = (2 * np.pi * _MODES_UP_TO_HZ) ** 2 * beam.density_over_stiffness
    # Damping may shift the highest modes down, so a few more are looked at than the undamped count.
    count = int(1.25 * reach**0.25 * beam.length_m / np.pi) + 3
    if count > _MOST_MODES:
        raise RealisationError(
            f"{beam} has some {count} modes below {_MODES_UP_TO_HZ:g} Hz, more than the "
            f"{_MOST_MODES} that are realised; check the units of its length, density and "
            "stiffness."
        )
    pairs = loaded.poles(clamped_free_eigenvalues(count))
    pairs = pairs[~np.isnan(pairs[:, 0])]
    oscillating = pairs[:, 0].imag > 0
    upper = pairs[oscillating, 0]
    in_band = np.abs(upper) < 2 * np.pi * _FIT_BAND_HZ[1]
    upper = upper[in_band | (-upper.real < _HEAVY_DAMPING * np.abs(upper))]
    beyond = np.flatnonzero(upper.imag > 2 * np.pi * _MODES_UP_TO_HZ)
    upper = upper[: beyond[0] + 1] if beyond.size else upper
    over_damped = pairs[~oscillating].ravel()
    over_damped = over_damped[np.abs(over_damped) < 2 * np.pi * _MODES_UP_TO_HZ]
    return np.concatenate([upper, over_damped, _CUT_POLES])


def _zeros(loaded: LoadedBeam) -> Complex:
    """Zeros of G up to the end of the fit's band: the modes of the pinned–free beam."""
    beam = loaded.beam
    reach = (2 * np.pi * _FIT_BAND_HZ[1]) ** 2 * beam.density_over_stiffness
    count = int(reach**0.25 * beam.length_m / np.pi) + 1
    z = np.pi * np.arange(1.25, count + 1)  # of tan z = tanh z, within 4e-4
    zeros = loaded.zeros(z)[:, 0]
    upper: Complex = zeros[zeros.imag > 0]
    return upper


def _fit_grid(landmarks: Complex) -> tuple[Real, Real]:
    """Angular frequencies and weights: the band, crowded at poles and zeros, and the tails."""
    low, high = _FIT_BAND_HZ
    band = np.concatenate([np.geomspace(low, high, 200), _clusters(landmarks, 10)])
    band = band[(band >= low) & (band <= high)]
    tails = np.concatenate(
        [np.geomspace(_TAIL_HZ[0], low, 25), np.geomspace(high, _TAIL_HZ[1], 25)]
    )
    frequency = np.concatenate([band, tails])
    weight = np.concatenate([np.ones(band.size), np.full(tails.size, _TAIL_WEIGHT)])
    return 2 * np.pi * frequency, weight


def _clusters(landmarks: Complex, points: int) -> Real:
    """Frequencies (Hz) spread over three half-widths on either side of each pole or zero."""
    half_width = np.maximum(-landmarks.real, 1e-4 * landmarks.imag)
    offsets = np.linspace(-3, 3, points)
    frequency: Real = (landmarks.imag[:, None] + half_width[:, None] * offsets).ravel() / (
        2 * np.pi
    )
    return frequency


def _fit(columns: Complex, target: Complex) -> Real:
    """Real least squares with the last three unknowns (D, V, K) not negative."""
    matrix = np.concatenate([columns.real, columns.imag])
    scale = np.linalg.norm(matrix, axis=0)
    q, r = np.linalg.qr(matrix / scale)
    rotated = q.T @ np.concatenate([target.real, target.imag])
    kept = np.arange(matrix.shape[1])
    while True:
        solution = np.zeros(matrix.shape[1])
        solution[kept] = np.linalg.lstsq(r[:, kept], rotated, rcond=_RCOND)[0]
        direct = solution[-3:]
        if (direct >= 0).all():
            scaled: Real = solution / scale
            return scaled
        kept = kept[kept != matrix.shape[1] - 3 + np.argmin(direct)]


def _relative_error(
    loaded: LoadedBeam, poles: Complex, zeros: Complex, coefficients: Real
) -> float:
    """Largest relative error over a grid several times as dense as the fit's."""
    low, high = ERROR_BAND_HZ
    landmarks = np.concatenate([poles[poles.imag > 0], zeros])
    frequency = np.concatenate([np.geomspace(low, high, 1200), _clusters(landmarks, 34)])
    omega = 2 * np.pi * frequency[(frequency >= low) & (frequency <= high)]
    s = 1j * omega[_apart(omega, poles, zeros)]
    exact = _exact(loaded, s)
    return float(np.max(np.abs(basis(s, poles) @ coefficients / exact - 1)))


def _apart(omega: Real, poles: Complex, zeros: Complex) -> NDArray[np.bool_]:
    """Where ω is not so near a pole or zero that a relative error means nothing there."""
    landmarks = np.concatenate([poles, zeros])
    distance = np.abs(1j * omega[:, None] - landmarks).min(axis=1)
    apart: NDArray[np.bool_] = distance > _CLOSEST * omega
    return apart


def _state_space(poles: Complex, coefficients: Real, error: float) -> Realisation:
    upper, real = poles[poles.imag > 0], poles[poles.imag == 0].real
    n = 2 * upper.size + real.size
    a = np.zeros((n, n))
    even = np.arange(0, 2 * upper.size, 2)
    a[even, even] = a[even + 1, even + 1] = upper.real
    a[even, even + 1] = upper.imag
    a[even + 1, even] = -upper.imag
    rest = np.arange(2 * upper.size, n)
    a[rest, rest] = real
    b = np.ones(n)
    b[even + 1] = 0.0
    inertia, viscosity, stiffness = (float(value) for value in coefficients[-3:])
    return Realisation(a, b, coefficients[:-3], inertia, viscosity, stiffness, error, poles)


def _growth_on_frictionless_motor(realisation: Realisation, beam: Beam) -> float:
    """Largest real part of the poles of a motor, as heavy as the beam, that turns the realisation.

    Without friction and with little inertia of its own it gives the beam every chance to be
    unstable.
    """
    motor_and_beam = couple(realisation, motor_inertia_kg_m2=beam.inertia_kg_m2)
    return float(np.linalg.eigvals(motor_and_beam.a).real.max())
