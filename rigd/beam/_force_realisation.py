"""State-space realisation of the beam under point forces while the motor holds its root.

The response to a force is that of the modes, whose pairs of poles and residues are exact. The
remainder is smooth: the static part of the omitted modes, the branch cut of the fractional orders,
and overdamped modes. A ladder of real poles and a direct term, fitted to the exact response
(`PointForceGrid`) by linear least squares, approximates it.
"""

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from rigd.beam._model import Beam, Damping
from rigd.beam._modes import (
    clamped_free_eigenvalues,
    mode_shape,
    mode_shape_mean,
    poles_for_eigenvalues,
)
from rigd.beam._point_force import PointForceGrid
from rigd.beam.realisation import RealisationError

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

_MAX_MODES = 80
"""Largest number of modes in a realisation."""
_MAX_MODAL_DAMPING_RATIO = 0.9
"""Damping ratio from which the real poles represent a mode.

The mode's own poles lie on the branch cut, or near it."""
_MAX_RESONANT_DAMPING_RATIO = 0.3
"""Damping ratio below which the last mode counts as resonant, like the omitted modes above it."""
_SLOWEST_POLE_RAD_S = 0.03
"""Slowest real pole in rad/s (magnitude)."""
_REAL_POLES_PER_DECADE = 5
"""Number of real poles per decade of frequency."""
_HIGHEST_MODE_PER_BAND = 2.0
"""Multiple of the highest frequency of interest up to which modes are included.

The omitted modes are static below the highest frequency."""
_HIGHEST_REAL_POLE_PER_BAND = 10.0
"""Multiple of the highest frequency of interest up to which there are real poles."""
_TAIL_END_PER_BAND = 30.0
"""Multiple of the highest frequency of interest up to which the fit bounds the response."""
_FIT_TAIL_WEIGHT = 1e-2
"""Weight of the fit beyond the highest frequency, which bounds the response there.

It applies on a line halfway between the axes, where no omitted mode resonates."""
_FIT_POINTS_PER_DECADE = 40
"""Number of fitted frequencies per decade."""
_RESPONSE_FLOOR = 0.01
"""Size of a response below which the fit minimises its absolute, not relative, error.

The responses are the torque per force, divided by the lever arm, and the shear per force."""
_SINGULAR_VALUE_CUTOFF = 1e-11
"""Relative singular value below which the least-squares fit drops a combination of poles."""
_MAX_DAMPING_ORDER = 1.5
"""Highest damping order that is accepted.

For orders up to it the displacements of 580 random beams were right to 0.6 %."""


@dataclass(frozen=True, slots=True, eq=False)
class ForceRealisation:
    """State space ``x' = a x + b F`` of the beam's response to a point force F in N.

    A force at another point of the beam has the same `a` and `b`, but other output rows.
    """

    a: RealArray
    """State matrix, shape (n, n), in 1/s: 2 × 2 blocks of the modes, then the real poles.

    A realisation of the same beam up to a higher frequency has all these poles and additional modal
    and real ones."""
    mode_count: int
    """Number of modes in the state space."""
    b: RealArray
    """Input vector of the force, shape (n,)."""
    output_rows: RealArray
    """Output matrix, shape (outputs, n).

    The outputs are the displacement at each output point (m), then the torque (N·m) and the shear
    force (N) of the motor on the beam."""
    feedthrough: RealArray
    """Direct term: immediate change of each output per N of the force, shape (outputs,)."""


def realise_force(
    beam: Beam, damping: Damping, force_at_m: float, output_at_m: RealArray, highest_rad_s: float
) -> ForceRealisation:
    """Return a state-space realisation of the beam's response to a point force.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    force_at_m
        Position of the force, as a distance from the motor's axis.
    output_at_m
        Positions of the displacements, shape (points,).
    highest_rad_s
        Angular frequency up to which the response is accurate, except for beams with more than 80
        modes below twice that.

    Raises
    ------
    RealisationError
        If an order of the damping is above 1.5.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, realise_force
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> pushed = realise_force(beam, Damping(zeta=7e-5), 0.6, np.array([0.6]), 1e4)
    >>> static = pushed.feedthrough - pushed.output_rows @ np.linalg.solve(pushed.a, pushed.b)
    >>> print(static.round(3))  # m/N, N·m/N, N/N
    [ 0.797 -0.6   -1.   ]
    """
    check_force_damping_order(damping)
    x = np.append(output_at_m, force_at_m) / beam.length_m
    poles, residues = _modal_poles_and_residues(beam, damping, x, highest_rad_s)
    if poles.size == _MAX_MODES and -poles[-1].real < _MAX_RESONANT_DAMPING_RATIO * np.abs(
        poles[-1]
    ):
        # The next modes resonate and are not included.
        highest_rad_s = min(highest_rad_s, float(np.abs(poles[-1])) / _HIGHEST_MODE_PER_BAND)

    lowest_fit_rad_s, highest_fit_rad_s = _SLOWEST_POLE_RAD_S / 300, highest_rad_s
    s = 1j * np.geomspace(
        lowest_fit_rad_s,
        highest_fit_rad_s,
        int(_FIT_POINTS_PER_DECADE * np.log10(highest_fit_rad_s / lowest_fit_rad_s)),
    )
    s = s[np.abs(s[:, None] - poles).min(axis=1, initial=np.inf) > 1e-6 * np.abs(s)]
    tail_rad_s = np.geomspace(
        highest_fit_rad_s, _TAIL_END_PER_BAND * highest_fit_rad_s, _FIT_POINTS_PER_DECADE
    ) * np.exp(0.25j * np.pi)
    fit_emphasis = np.append(np.ones(s.size), np.full(tail_rad_s.size, _FIT_TAIL_WEIGHT))
    s = np.append(s, tail_rad_s)
    grid = PointForceGrid(s, beam, damping)
    exact_response = np.column_stack(
        [
            grid.displacement_per_force(output_at_m, np.full_like(output_at_m, force_at_m)),
            grid.torque_per_force(force_at_m),
            grid.shear_per_force(force_at_m),
        ]
    )
    # Real poles at fixed frequencies, whatever the highest frequency is.
    real_pole_count = (
        ceil(
            _REAL_POLES_PER_DECADE
            * np.log10(_HIGHEST_REAL_POLE_PER_BAND * highest_fit_rad_s / _SLOWEST_POLE_RAD_S)
        )
        + 1
    )
    real_poles = -_SLOWEST_POLE_RAD_S * 10 ** (np.arange(real_pole_count) / _REAL_POLES_PER_DECADE)
    # A ladder's response to a held force is 1, so that the cut-off loses no pole.
    pole_columns = np.column_stack([-real_poles / (s[:, None] - real_poles), np.ones_like(s)])
    modal_response = _modal_response(s, poles, residues)
    error_weights = fit_emphasis[:, None] / np.column_stack(
        [
            np.abs(exact_response[:, :-2]) + _infinite_beam_response(s, beam, damping)[:, None],
            np.abs(exact_response[:, -2]) + _RESPONSE_FLOOR * force_at_m,
            np.abs(exact_response[:, -1]) + _RESPONSE_FLOOR,
        ]
    )
    remainder = exact_response - modal_response
    fitted_weights = np.empty((exact_response.shape[1], pole_columns.shape[1]))
    for i in range(exact_response.shape[1]):
        weighted_columns, fit_target = (
            pole_columns * error_weights[:, i, None],
            remainder[:, i] * error_weights[:, i],
        )
        fitted_weights[i] = np.linalg.lstsq(
            np.concatenate([weighted_columns.real, weighted_columns.imag]),
            np.concatenate([fit_target.real, fit_target.imag]),
            rcond=_SINGULAR_VALUE_CUTOFF,
        )[0]

    pair_state_count = 2 * poles.size
    n = pair_state_count + real_poles.size
    a, b = np.zeros((n, n)), np.ones(n)
    pair_rows = np.arange(0, pair_state_count, 2)
    a[pair_rows, pair_rows] = a[pair_rows + 1, pair_rows + 1] = poles.real
    a[pair_rows, pair_rows + 1] = poles.imag
    a[pair_rows + 1, pair_rows] = -poles.imag
    b[pair_rows + 1] = 0.0
    real_pole_rows = np.arange(pair_state_count, n)
    a[real_pole_rows, real_pole_rows] = real_poles
    b[real_pole_rows] = -real_poles
    output_rows = np.empty((exact_response.shape[1], n))
    # The first of a pair's states is the real part of z, the second minus its imaginary part.
    output_rows[:, pair_rows], output_rows[:, pair_rows + 1] = (
        2 * residues.real,
        2 * residues.imag,
    )
    output_rows[:, pair_state_count:] = fitted_weights[:, :-1]
    return ForceRealisation(a, poles.size, b, output_rows, fitted_weights[:, -1])


def check_force_damping_order(damping: Damping) -> None:
    """Raise RealisationError if the damping's order is too high for point forces on the beam.

    Parameters
    ----------
    damping
        Damping of the exact model.

    Raises
    ------
    RealisationError
        If an order of the damping is above 1.5.
    """
    damping_orders = (damping.alpha if damping.zeta else 0, damping.lambda_ if damping.gamma else 0)
    if max(damping_orders) > _MAX_DAMPING_ORDER:
        raise RealisationError(
            f"{damping} has an order above {_MAX_DAMPING_ORDER:g}, with which the response to a "
            "force at a point cannot be realised; leave the obstacle out, or choose a lower order."
        )


def _modal_poles_and_residues(
    beam: Beam, damping: Damping, x: RealArray, highest_rad_s: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return the oscillating modes' poles in rad/s and the outputs' residues (outputs, modes).

    `x` contains the output points, then the point of the force, as fractions of the length.
    """
    z = clamped_free_eigenvalues(_MAX_MODES)
    poles = poles_for_eigenvalues(z, beam, damping)[:, 0]
    pole_magnitude = np.abs(poles)  # not a number where there is none: then False below
    is_selected = (poles.imag > 0) & (-poles.real < _MAX_MODAL_DAMPING_RATIO * pole_magnitude)
    is_selected &= pole_magnitude < _HIGHEST_MODE_PER_BAND * highest_rad_s
    poles, z = poles[is_selected], z[is_selected]
    mode_numbers = np.flatnonzero(is_selected) + 1
    mode_shapes = np.array(
        [mode_shape(int(mode_number), x) for mode_number in mode_numbers]
    ).reshape(-1, x.size)
    shape_sign = (-1.0) ** (mode_numbers - 1)
    shape_moment_m = 2 * beam.length_m * shape_sign / z**2  # ∫ x phi dx / L
    shape_mean = mode_shape_mean(_MAX_MODES)[is_selected]

    k_fourth = (z / beam.length_m) ** 4
    inertial_term = beam.density_over_stiffness * poles**2
    external_term = damping.gamma * poles**damping.lambda_
    internal_term = damping.zeta * poles**damping.alpha * k_fourth
    equation_slope = (
        2 * inertial_term + damping.lambda_ * external_term + damping.alpha * internal_term
    ) / poles
    shape_at_force = mode_shapes[:, -1] / equation_slope
    length_times_stiffness = beam.length_m * beam.bending_stiffness_n_m2
    root_residue = shape_at_force * (inertial_term + external_term)
    residues: ComplexArray = np.vstack(
        [
            mode_shapes[:, :-1].T * shape_at_force / length_times_stiffness,
            shape_moment_m * root_residue,
            shape_mean * root_residue,
        ]
    )
    return poles, residues


def _modal_response(s: ComplexArray, poles: ComplexArray, residues: ComplexArray) -> ComplexArray:
    """Return the modes' part of each output at `s`: the sum over conjugate pole pairs.

    The shape is (number of s, outputs).
    """
    upper_terms, lower_terms = 1 / (s[:, None] - poles), 1 / (s[:, None] - poles.conj())
    modal_outputs: ComplexArray = upper_terms @ residues.T + lower_terms @ residues.conj().T
    return modal_outputs


def _infinite_beam_response(s: ComplexArray, beam: Beam, damping: Damping) -> RealArray:
    """Return the magnitude in m/N of an infinitely long beam's displacement under the force."""
    stiffness = beam.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    inertial_load = beam.density_over_stiffness * s**2 + damping.gamma * s**damping.lambda_
    inertial_load = inertial_load * beam.bending_stiffness_n_m2
    response_m_per_n: RealArray = np.sqrt(0.125) / np.abs(inertial_load**0.75 * stiffness**0.25)
    return response_m_per_n
