"""Linear state space with named inputs, outputs and states, and a delay of its outputs.

In continuous time ``x' = A x + B u``, ``y(t) = C x(t - delay) + D u(t - delay)``. At a sampling
rate ``x[k+1] = A x[k] + B u[k]``, with the input held between the samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_FREQUENCIES_PER_BLOCK: Final = 256
"""Number of frequencies whose equations are solved together."""


@dataclass(frozen=True, slots=True)
class SignalNames:
    """Names and units of the components of an input, output or state vector, in ASCII."""

    names: tuple[str, ...]
    units: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class StateSpace:
    """Linear system in state space: its matrices, signal names and delay of the output.

    Attributes
    ----------
    a, b, c, d : ndarray, shapes (n, n), (n, m), (p, n), (p, m)
        Matrices of the system.
    inputs, outputs, states : SignalNames
        Names and units of the vectors u, y and x.
    delay_s : float
        Delay of the outputs in s that the matrices do not include: ``y(t) = C x(t - delay_s) +
        D u(t - delay_s)``. Negative if the outputs lead.
    period_s : float
        Time between the samples, 0 in continuous time.
    """

    a: NDArray[np.float64]
    b: NDArray[np.float64]
    c: NDArray[np.float64]
    d: NDArray[np.float64]
    inputs: SignalNames
    outputs: SignalNames
    states: SignalNames
    delay_s: float = 0.0
    period_s: float = 0.0

    @property
    def order(self) -> int:
        """Return the number of states."""
        return len(self.a)

    def response(self, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the frequency response in continuous time without delay, shape (len(s), p, m).

        The points s are in rad/s, and none of them is a pole.
        """
        frequency_response = np.empty((s.size, *self.d.shape), dtype=np.complex128)
        for first_point in range(0, s.size, _FREQUENCIES_PER_BLOCK):
            points_of_block = s[first_point : first_point + _FREQUENCIES_PER_BLOCK, None, None]
            resolvent = np.linalg.solve(
                points_of_block * np.eye(self.order) - self.a, self.b[None] + 0j
            )
            frequency_response[first_point : first_point + _FREQUENCIES_PER_BLOCK] = (
                self.c @ resolvent + self.d
            )
        return frequency_response

    def discretized(self, rate_hz: float) -> StateSpace:
        """Return the discrete-time system, which is exact for inputs held between the samples."""
        from scipy.signal import cont2discrete

        a, b, c, d, period_s = cont2discrete(
            (self.a, self.b, self.c, self.d), 1.0 / rate_hz, method="zoh"
        )
        return replace(self, a=a, b=b, c=c, d=d, period_s=float(period_s))


def with_filter(state_space: StateSpace, time_constant_s: float, filter_order: int) -> StateSpace:
    """Return the system with a low-pass filter (order 1, or Butterworth of order 2) at its output.

    The system is in continuous time and has one output. `time_constant_s` is the reciprocal of the
    corner frequency, in s/rad.
    """
    n, m = state_space.b.shape
    cutoff_rad_s = 1.0 / time_constant_s
    a = np.zeros((n + filter_order, n + filter_order))
    b = np.zeros((n + filter_order, m))
    a[:n, :n], b[:n] = state_space.a, state_space.b
    first_state, last_state = n, n + filter_order - 1
    # x' = omega (u - x), or x' = omega y, y' = omega (u - x - sqrt(2) y)
    a[last_state, :n], b[last_state] = (
        cutoff_rad_s * state_space.c[0],
        cutoff_rad_s * state_space.d[0],
    )
    a[last_state, first_state] = -cutoff_rad_s
    if filter_order == 2:
        a[first_state, last_state] = cutoff_rad_s
        a[last_state, last_state] = -np.sqrt(2) * cutoff_rad_s
    output_unit = state_space.outputs.units[0]
    state_names = ("filter_output", "filter_slope")[:filter_order]
    return replace(
        state_space,
        a=a,
        b=b,
        c=np.eye(1, n + filter_order, n),
        d=np.zeros_like(state_space.d),
        states=concatenate_names(
            (state_space.states, SignalNames(state_names, (output_unit,) * filter_order))
        ),
    )


def concatenate_names(signal_vectors: Sequence[SignalNames]) -> SignalNames:
    """Concatenate the names and units of several signal vectors."""
    return SignalNames(
        tuple(
            signal_name for signal_vector in signal_vectors for signal_name in signal_vector.names
        ),
        tuple(
            signal_unit for signal_vector in signal_vectors for signal_unit in signal_vector.units
        ),
    )
