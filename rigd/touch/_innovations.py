"""Innovations: the part of torque and base shear that is not predicted, in each tick.

The exact model of the free beam predicts torque and base shear from the angle. The measurement
deviates because of noise, earlier vibration of the beam, errors of the model, or a touch. An
observer (a stationary Kalman filter of the first modes and of the zeros of torque and shear)
follows vibration and model errors, which change slowly or at the natural frequencies. The
innovations are the remaining part, which is white noise without a touch.

Filter and observer are linear, so that a tick is the product of one matrix with one vector:
[state, angle, torque, shear] → [next state, whitened innovations, whitened prediction].
"""

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    Beam,
    Damping,
    PointForceGrid,
    clamped_free_eigenvalues,
    poles_for_eigenvalues,
    root_shear_ratio,
)
from rigd.touch._sensor_filter import NO_FILTER, SensorFilter

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

_CANDIDATE_MODE_COUNT = 40
"""Number of the beam's first modes, of which the filter represents those of low enough
frequency."""
_MAX_FREQUENCY_PER_RATE = 0.42
"""Highest frequency of the filter's modes, as a fraction of the tick rate; delay taps approximate
higher modes."""
_MIN_IMAGINARY_FRACTION = 0.5
"""Smallest ratio of imaginary part to magnitude of the poles of the filter's modes; real poles
approximate modes that are more strongly damped."""
_REAL_POLE_COUNT = 10
"""Number of real poles, which approximate the branch cut of fractional-order damping."""
_SLOWEST_REAL_POLE_RAD_S = 0.03
"""Magnitude of the slowest real pole in rad/s."""
_DELAY_TAP_COUNT = 4
"""Number of delay taps of the filter: the present and past angles, with a coefficient each."""
_FIT_START_HZ, _FIT_END_FRACTION = 0.02, 0.45
"""Band in which the filter is fitted: lower end in Hz, upper end as a fraction of the tick rate."""
_FULL_WEIGHT_START_HZ, _FULL_WEIGHT_END_HZ = 0.3, 50.0
"""Lower and upper end in Hz of the band in which the relative error of the fit has full weight.
Above it motors hardly move, and a close fit would only amplify the noise of the encoder."""
_OBSERVED_MODE_COUNT = 4
"""Number of modes whose vibration the observer follows."""
_VIBRATION_BANDWIDTH_RAD_S = 6.0
"""Bandwidth in rad/s with which the observer follows vibration: slow compared with a touch (15
rad/s would absorb a tenth of a touch within 10 ms), and fast compared with the phase drift of a
model with a 1 % frequency error."""
_ZERO_BANDWIDTH_RAD_S = 0.5
"""Bandwidth in rad/s with which the observer follows the zeros of torque and shear."""


@dataclass(frozen=True, slots=True, eq=False)
class ObservedBeam:
    """Discrete model of the beam without contact and its observer, as the matrix of one tick.

    Examples
    --------
    >>> from rigd.beam import Beam, Damping
    >>> from rigd.touch import ChannelNoise, observed_beam
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> noise = ChannelNoise(torque_nm=5e-3, shear_n=0.02)
    >>> model = observed_beam(beam, Damping(zeta=7e-5), 1000.0, noise)
    >>> model.state_count, model.step_matrix.shape
    (39, (43, 42))
    """

    step_matrix: RealArray
    """Matrix of a tick from [state, angle, torque, shear] to [next state, whitened innovations,
    whitened prediction], shape (n + 4, n + 3). Without shear, the rows and the column of shear are
    zero."""
    observer_gain: RealArray
    """Effect of each whitened innovation on the next state, shape (n, 2)."""
    whitening_matrix: RealArray
    """Matrix from innovations in N·m and N to whitened innovations, shape (2, 2)."""
    state_count: int
    """Number n of states."""
    channel_count: int
    """Number of measured quantities: 1 for torque alone, 2 for torque and base shear."""


@dataclass(frozen=True, slots=True)
class ChannelNoise:
    """Standard deviation of the noise in each sample of torque, base shear and angle."""

    torque_nm: float
    """Standard deviation of the coupling torque."""
    shear_n: float | None
    """Standard deviation of the base shear; None: it is not measured."""
    angle_rad: float = 0.0
    """Standard deviation of the angle, such as the encoder's resolution divided by √12."""


def observed_beam(
    beam: Beam,
    damping: Damping,
    rate_hz: float,
    noise_stds: ChannelNoise,
    *,
    tool_inertia_kg_m2: float = 0.0,
    torque_after_angle_s: float = 0.0,
    sensor_filter: SensorFilter = NO_FILTER,
) -> ObservedBeam:
    """Return the model with filter and observer that computes innovations of torque and shear.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    rate_hz
        Ticks a second.
    noise_stds
        Standard deviations of the noise of torque, base shear and angle.
    tool_inertia_kg_m2
        Inertia between sensor and beam.
    torque_after_angle_s
        Delay of a tick's wrench relative to its angle, without the delay of the filters.
    sensor_filter
        Filters of the wrench.

    Returns
    -------
    ObservedBeam
        Model for an `InnovationFilter`.
    """
    angle_filter = _fit_filter(
        beam, damping, rate_hz, tool_inertia_kg_m2, torque_after_angle_s, sensor_filter
    )
    has_shear = noise_stds.shear_n is not None
    observer = _design_observer(beam, damping, rate_hz, noise_stds, angle_filter.noise_gain)
    f, o = angle_filter.a.shape[0], observer.a.shape[0]
    n = f + o
    step_matrix = np.zeros((n + 4, n + 3))
    step_matrix[:f, :f], step_matrix[:f, n] = angle_filter.a, angle_filter.b
    prediction_rows = np.zeros((2, n + 3))
    prediction_rows[:, :f], prediction_rows[:, n] = angle_filter.c, angle_filter.d
    innovation_rows = -prediction_rows
    innovation_rows[:, f:n] -= observer.c
    innovation_rows[0, n + 1] = innovation_rows[1, n + 2] = 1.0
    step_matrix[f:n, f:n] = observer.a
    step_matrix[f:n] += observer.gain @ innovation_rows
    step_matrix[n : n + 2] = observer.whitening_matrix @ innovation_rows
    step_matrix[n + 2 :] = observer.whitening_matrix @ prediction_rows
    observer_gain = np.zeros((n, 2))
    channel_count = 2 if has_shear else 1
    observer_gain[f:, :channel_count] = observer.gain[:, :channel_count] @ np.linalg.inv(
        observer.whitening_matrix[:channel_count, :channel_count]
    )
    return ObservedBeam(step_matrix, observer_gain, observer.whitening_matrix, n, channel_count)


class InnovationFilter:
    """Filter that computes the innovations of torque and base shear in each tick.

    The beam is assumed to be at rest at the angle of the first tick.

    Parameters
    ----------
    model
        Model from `observed_beam`.

    Attributes
    ----------
    whitened
        Two whitened innovations of the last tick: combinations of those of torque and shear that
        are uncorrelated and, for the assumed noise, have a standard deviation of 1.
    predicted
        Torque and shear that the angle alone predicts, transformed by the same matrix.
    """

    __slots__ = (
        "_angle_rad",
        "_following_zeros",
        "_gain",
        "_holding_zeros",
        "_multiply",
        "_previous_angle_rad",
        "_start_rad",
        "_states",
        "_unwhitening",
        "_vectors",
        "predicted",
        "whitened",
    )

    def __init__(self, model: ObservedBeam) -> None:
        n = self._states = model.state_count
        self._unwhitening = (0.0, 0.0)
        if model.channel_count == 2:
            torque_coefficient, shear_coefficient = np.linalg.inv(model.whitening_matrix)[
                1
            ].tolist()
            self._unwhitening = torque_coefficient, shear_coefficient
        # The zeros are the last states: without a gain they stay what they are.
        zero_state_indices = np.arange(n - model.channel_count, n)
        holding_matrix, holding_gain = model.step_matrix.copy(), model.observer_gain.copy()
        holding_matrix[zero_state_indices] = np.eye(n + 3)[zero_state_indices]
        holding_gain[zero_state_indices] = 0.0
        self._following_zeros, self._holding_zeros = (
            (np.asfortranarray(matrix).dot, gain)
            for matrix, gain in (
                (model.step_matrix, model.observer_gain),
                (holding_matrix, holding_gain),
            )
        )
        self._multiply, self._gain = self._following_zeros
        # In turn input [state, angle, torque, shear] and output [state, whitened, predicted].
        self._vectors = tuple(np.zeros((2, n + 4)))
        self._start_rad: float | None = None
        self._angle_rad = self._previous_angle_rad = 0.0
        self.whitened = (0.0, 0.0)
        self.predicted = (0.0, 0.0)

    def step(
        self,
        angle_rad: float,
        torque_nm: float,
        shear_n: float,
        *,
        missed_tick_count: int = 0,
        angle_stale: bool = False,
        wrench_stale: bool = False,
    ) -> None:
        """Compute the innovations of a tick from its readings.

        Parameters
        ----------
        angle_rad, torque_nm, shear_n
            Measured angle, torque and base shear; the shear is ignored if the model has none.
        missed_tick_count
            Number of ticks that were missed before this tick; their angles are interpolated.
        angle_stale
            Whether the angle is older than the tick; it is then extrapolated from earlier angles.
        wrench_stale
            Whether torque and shear are older than the tick; they are then ignored.
        """
        if self._start_rad is None:
            self._start_rad = angle_rad
        relative_angle_rad = angle_rad - self._start_rad
        if angle_stale:
            relative_angle_rad = 2.0 * self._angle_rad - self._previous_angle_rad
        if missed_tick_count:
            start_rad = self._angle_rad
            for missed_tick in range(1, missed_tick_count + 1):
                path_fraction = missed_tick / (missed_tick_count + 1)
                self._step_without_wrench(
                    start_rad + path_fraction * (relative_angle_rad - start_rad), torque_nm, shear_n
                )
        if wrench_stale:
            self._step_without_wrench(relative_angle_rad, torque_nm, shear_n)
        else:
            self._step_with_wrench(relative_angle_rad, torque_nm, shear_n)

    def hold_sensor_zeros(self) -> None:
        """Hold the zeros of torque and shear, so that a contact force does not shift them."""
        self._multiply, self._gain = self._holding_zeros

    def follow_sensor_zeros(self) -> None:
        """Let the observer follow the zeros of torque and shear again."""
        self._multiply, self._gain = self._following_zeros

    @property
    def predicted_shear_n(self) -> float:
        """Base shear in N predicted from the angle alone; 0 if the model has no shear."""
        torque_coefficient, shear_coefficient = self._unwhitening
        whitened_torque, whitened_shear = self.predicted
        return torque_coefficient * whitened_torque + shear_coefficient * whitened_shear

    def _step_with_wrench(
        self, relative_angle_rad: float, torque_nm: float, shear_n: float
    ) -> None:
        """Process one tick: angle relative to the first tick, torque and base shear."""
        n = self._states
        input_vector, output_vector = self._vectors
        input_vector[n] = relative_angle_rad
        input_vector[n + 1] = torque_nm
        input_vector[n + 2] = shear_n
        self._multiply(input_vector[: n + 3], output_vector)
        self._vectors = output_vector, input_vector
        torque_innovation, shear_innovation, predicted_torque, predicted_shear = output_vector[
            n:
        ].tolist()
        self.whitened = torque_innovation, shear_innovation
        self.predicted = predicted_torque, predicted_shear
        self._previous_angle_rad, self._angle_rad = self._angle_rad, relative_angle_rad

    def _step_without_wrench(
        self, relative_angle_rad: float, torque_nm: float, shear_n: float
    ) -> None:
        """Process one tick whose torque and shear are invalid and have no effect on the state."""
        self._step_with_wrench(relative_angle_rad, torque_nm, shear_n)
        self._vectors[0][: self._states] -= self._gain @ np.array(self.whitened)
        self.whitened = 0.0, 0.0


# Filter of the angle


@dataclass(frozen=True, slots=True, eq=False)
class _AngleFilter:
    """State space that predicts torque and shear of the free beam from the angle θ.

    The equations are ``x' = a x + b θ`` and ``[torque, shear] = c x + d θ``.
    """

    a: RealArray
    b: RealArray
    c: RealArray
    d: RealArray
    noise_gain: RealArray
    """Standard deviations of torque and shear per white noise of 1 rad in the angle, shape (2,)."""


def _fit_filter(
    beam: Beam,
    damping: Damping,
    rate_hz: float,
    tool_inertia_kg_m2: float,
    torque_after_angle_s: float,
    sensor_filter: SensorFilter,
) -> _AngleFilter:
    """Return the discrete filter that approximates the exact model's frequency response.

    Its complex poles are those of the exact model. Real poles and delay taps approximate the
    remaining response. The coefficients are fitted by least squares.
    """
    pole_pairs = poles_for_eigenvalues(
        clamped_free_eigenvalues(_CANDIDATE_MODE_COUNT), beam, damping
    )
    upper_poles = pole_pairs[_is_represented_mode(pole_pairs[:, 0], rate_hz), 0]
    complex_poles: ComplexArray = np.exp(upper_poles / rate_hz)
    real_poles: RealArray = np.exp(
        -np.geomspace(_SLOWEST_REAL_POLE_RAD_S, rate_hz, _REAL_POLE_COUNT) / rate_hz
    )

    half_width_hz = np.maximum(-upper_poles.real, 1e-3 * upper_poles.imag) / (2 * pi)
    resonance_hz = upper_poles.imag[:, None] / (2 * pi) + half_width_hz[:, None] * np.linspace(
        -3, 3, 11
    )
    band_hz = np.geomspace(_FIT_START_HZ, _FIT_END_FRACTION * rate_hz, 400)
    frequency_hz = np.concatenate([band_hz, resonance_hz.ravel()])
    frequency_hz = frequency_hz[(frequency_hz > 0) & (frequency_hz < _FIT_END_FRACTION * rate_hz)]
    s = 2j * pi * frequency_hz
    exact_model = PointForceGrid(s, beam, damping)
    exact_response = np.array([exact_model.torque_per_angle(), exact_model.shear_per_angle()])
    exact_response[0] += tool_inertia_kg_m2 * s**2
    exact_response *= sensor_filter.response(s) * np.exp(-torque_after_angle_s * s)

    fit_weights = np.minimum(1.0, (_FULL_WEIGHT_END_HZ / frequency_hz) ** 3)
    fit_weights *= np.minimum(1.0, frequency_hz / _FULL_WEIGHT_START_HZ)
    term_responses = _term_responses(s / rate_hz, complex_poles, real_poles)
    static_response = _term_responses(np.zeros(1, dtype=complex), complex_poles, real_poles).real
    coefficients = np.empty((2, term_responses.shape[1]))
    for row, fit_target in zip(coefficients, exact_response, strict=True):
        fit_scale = fit_weights / np.abs(fit_target)
        weighted_columns = term_responses * fit_scale[:, None]
        # An angle at rest must give exactly no torque, not only a small one.
        least_squares_matrix = np.concatenate(
            [weighted_columns.real, weighted_columns.imag, 1e4 * static_response]
        )
        right_hand_side = np.concatenate(
            [(fit_target * fit_scale).real, (fit_target * fit_scale).imag, [0.0]]
        )
        column_norms = np.linalg.norm(least_squares_matrix, axis=0)
        row[:] = (
            np.linalg.lstsq(least_squares_matrix / column_norms, right_hand_side, rcond=1e-12)[0]
            / column_norms
        )

    dense_response = (
        _term_responses(1j * np.linspace(0, pi, 4001), complex_poles, real_poles) @ coefficients.T
    )
    noise_gain = np.sqrt(np.mean(np.abs(dense_response) ** 2, axis=0))
    return _state_space(complex_poles, real_poles, coefficients, noise_gain)


def _is_represented_mode(upper_poles: ComplexArray, rate_hz: float) -> NDArray[np.bool_]:
    """Return a mask of the poles whose modes the filter represents.

    These are oscillating modes below `_MAX_FREQUENCY_PER_RATE` of the tick rate; poles that are NaN
    are excluded.
    """
    is_represented: NDArray[np.bool_] = upper_poles.imag > _MIN_IMAGINARY_FRACTION * np.abs(
        upper_poles
    )
    return is_represented & (upper_poles.imag < 2 * pi * _MAX_FREQUENCY_PER_RATE * rate_hz)


def _term_responses(
    s_ticks: ComplexArray, complex_poles: ComplexArray, real_poles: RealArray
) -> ComplexArray:
    """Return the frequency response of each term of the filter, shape (frequencies, terms).

    The terms are the real and the imaginary part of each complex pole, the real poles and the delay
    taps. `s_ticks` is the Laplace variable multiplied by the duration of a tick.
    """
    tick_delay = np.exp(-s_ticks)[:, None]
    upper_terms, lower_terms = (
        1 / (1 - complex_poles * tick_delay),
        1 / (1 - complex_poles.conj() * tick_delay),
    )
    real_terms = 1 / (1 - real_poles * tick_delay)
    return np.concatenate(
        [
            upper_terms + lower_terms,
            1j * (upper_terms - lower_terms),
            real_terms,
            tick_delay ** np.arange(_DELAY_TAP_COUNT),
        ],
        axis=1,
    )


def _state_space(
    complex_poles: ComplexArray,
    real_poles: RealArray,
    coefficients: RealArray,
    noise_gain: RealArray,
) -> _AngleFilter:
    """Return the state space of the filter with the given coefficients of its terms.

    The state depends on past angles only; the present one acts through ``d``.
    """
    m, k = complex_poles.size, real_poles.size
    n = 2 * m + k + _DELAY_TAP_COUNT - 1
    a, b = np.zeros((n, n)), np.zeros(n)
    even_states = np.arange(0, 2 * m, 2)
    a[even_states, even_states] = a[even_states + 1, even_states + 1] = complex_poles.real
    a[even_states, even_states + 1], a[even_states + 1, even_states] = (
        -complex_poles.imag,
        complex_poles.imag,
    )
    b[even_states], b[even_states + 1] = complex_poles.real, complex_poles.imag
    real_states = np.arange(2 * m, 2 * m + k)
    a[real_states, real_states] = b[real_states] = real_poles
    delay_states = np.arange(2 * m + k, n)
    b[delay_states[0]] = 1.0
    a[delay_states[1:], delay_states[:-1]] = 1.0
    # A state is the sum up to the previous tick, moved on by one tick: adding θ completes it.
    c = np.zeros((2, n))
    c[:, even_states] = 2 * coefficients[:, :m]
    c[:, even_states + 1] = -2 * coefficients[:, m : 2 * m]
    c[:, real_states] = coefficients[:, 2 * m : 2 * m + k]
    c[:, delay_states] = coefficients[:, -_DELAY_TAP_COUNT + 1 :]
    d = (
        2 * coefficients[:, :m].sum(axis=1)
        + coefficients[:, 2 * m : 2 * m + k].sum(axis=1)
        + coefficients[:, -_DELAY_TAP_COUNT]
    )
    return _AngleFilter(a, b, c, d, noise_gain)


# Observer of the motion that the angle does not explain


@dataclass(frozen=True, slots=True, eq=False)
class _Observer:
    """Observer of vibrations and zeros, from the deviations y of torque and shear.

    The equations are ``x' = a x + gain e`` and ``e = y - c x``, with the innovations e.
    """

    a: RealArray
    c: RealArray
    gain: RealArray
    whitening_matrix: RealArray
    """Matrix from innovations to whitened innovations, shape (2, 2)."""


def _design_observer(
    beam: Beam, damping: Damping, rate_hz: float, noise: ChannelNoise, noise_gain: RealArray
) -> _Observer:
    """Return the stationary Kalman filter that follows vibrating modes and drifting zeros."""
    from scipy.linalg import solve_discrete_are

    z = clamped_free_eigenvalues(_OBSERVED_MODE_COUNT)
    upper_poles = poles_for_eigenvalues(z, beam, damping)[:, 0]
    is_represented = _is_represented_mode(upper_poles, rate_hz)
    complex_poles, wave_number = (
        np.exp(upper_poles[is_represented] / rate_hz),
        z[is_represented] / beam.length_m,
    )
    has_shear = noise.shear_n is not None
    channel_count = 2 if has_shear else 1
    m = complex_poles.size
    n = 2 * m + channel_count
    a, c = np.zeros((n, n)), np.zeros((2, n))
    even_states = np.arange(0, 2 * m, 2)
    a[even_states, even_states] = a[even_states + 1, even_states + 1] = complex_poles.real
    a[even_states, even_states + 1], a[even_states + 1, even_states] = (
        -complex_poles.imag,
        complex_poles.imag,
    )
    zero_states = np.arange(2 * m, n)
    a[zero_states, zero_states] = 1.0
    c[0, even_states] = 1.0
    c[np.arange(channel_count), zero_states] = 1.0
    noise_stds = np.array([noise.torque_nm, noise.shear_n or 0.0])
    noise_variances = noise_stds**2 + (noise_gain * noise.angle_rad) ** 2
    q = np.zeros(n)
    # A random walk of this size gives the observer its bandwidth.
    q[even_states] = q[even_states + 1] = (
        noise_variances[0] * (_VIBRATION_BANDWIDTH_RAD_S / rate_hz) ** 2
    )
    q[zero_states] = noise_variances[:channel_count] * (_ZERO_BANDWIDTH_RAD_S / rate_hz) ** 2
    if has_shear:
        c[1, even_states] = root_shear_ratio(_OBSERVED_MODE_COUNT)[is_represented] * wave_number
    measured_rows = c[:channel_count]
    r = np.diag(noise_variances[:channel_count])
    covariance = solve_discrete_are(a.T, measured_rows.T, np.diag(q), r)
    innovation_covariance = measured_rows @ covariance @ measured_rows.T + r
    observer_gain, whitening_matrix = np.zeros((n, 2)), np.zeros((2, 2))
    observer_gain[:, :channel_count] = (
        a @ np.linalg.solve(innovation_covariance, measured_rows @ covariance).T
    )
    whitening_matrix[:channel_count, :channel_count] = np.linalg.inv(
        np.linalg.cholesky(innovation_covariance)
    )
    return _Observer(a, c, observer_gain, whitening_matrix)
