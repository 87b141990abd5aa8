"""Poles of a plant, and Newton's search for its poles and zeros."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MAX_HOMOTOPY_STEPS = 12
"""Largest number of steps in which the tip mass and the clamp's compliance grow from zero."""
_RELATIVE_CHANGE_PER_STEP = 0.02
"""Growth of tip mass and compliance in one step while poles are followed.

It is relative to the mass and the compliance of the beam itself."""
_MAX_NEWTON_STEPS = 60
"""Largest number of Newton's iterations."""
_NEWTON_TOLERANCE = 1e-10
"""Relative length of Newton's last step: the error is of the order of its square."""
CLOSE_START_TOLERANCE = 1e-6
"""Relative length of Newton's last step from a start close to the root.

Convergence is quadratic there from the first step on."""
_INTERMEDIATE_STEP_TOLERANCE = 1e-4
"""Relative length of Newton's last step before tip mass and compliance have their full size."""
_MAX_ROOT_TO_START_RATIO = 10.0
"""Largest ratio of a root to the start of Newton's method that is accepted."""
_RELATIVE_START_DISTANCE = 1e-7
"""Relative distance of the first starts from the poles, where G of an undamped beam is infinite."""


@dataclass(frozen=True, slots=True)
class Pole:
    """One pole of one mode: the upper one of a conjugate pair, or a real one."""

    mode: int
    """Number of the mode, from 1."""
    at_rad_s: complex
    """Pole in the complex plane."""
    derivative: ComplexArray
    """Derivatives of the pole with respect to the k requested parameters, shape (k,)."""

    @property
    def oscillates(self) -> bool:
        """Whether the free decay oscillates, so that it has a cosine and a sine component."""
        return self.at_rad_s.imag != 0

    @property
    def frequency_hz(self) -> float:
        """Frequency of the free decay in Hz."""
        return self.at_rad_s.imag / (2 * math.pi)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio, as a fraction of critical damping."""
        return -self.at_rad_s.real / abs(self.at_rad_s)

    @property
    def frequency_derivative_hz(self) -> RealArray:
        """Derivatives of the frequency in Hz with respect to the parameters, shape (k,)."""
        return np.asarray(self.derivative.imag / (2 * math.pi), dtype=np.float64)

    @property
    def damping_ratio_derivative(self) -> RealArray:
        """Derivatives of the damping ratio with respect to the parameters, shape (k,)."""
        p, pole_magnitude = self.at_rad_s, abs(self.at_rad_s)
        magnitude_derivative = (p.conjugate() * self.derivative).real / pole_magnitude
        damping_derivatives = (
            -self.derivative.real / pole_magnitude
            - self.damping_ratio * magnitude_derivative / pole_magnitude
        )
        return np.asarray(damping_derivatives, dtype=np.float64)


def follow_roots(
    uniform_roots: ComplexArray,
    relative_change: float,
    roots_near: Callable[[float, ComplexArray, float], ComplexArray],
) -> ComplexArray:
    """Return poles or zeros, followed from those of the uniform beam on a rigid clamp.

    `relative_change` is the difference of the plant's tip mass and compliance from that beam,
    relative to the beam's own values. ``roots_near(fraction, start_roots, step_tolerance)`` returns
    the roots of a plant with a fraction of this difference. A row is NaN if the path was lost.
    """
    roots = uniform_roots
    has_root = ~np.isnan(roots[:, 0])
    # One of a conjugate pair suffices; without oscillation both have to be found.
    is_oscillating = roots[has_root][:, 0].imag != 0
    second_real_poles = roots[has_root][~is_oscillating][:, 1]
    current_roots = np.concatenate([roots[has_root][:, 0], second_real_poles])
    current_roots *= 1 - _RELATIVE_START_DISTANCE  # G is infinite at an undamped pole
    # A change that moves the poles little needs few steps.
    step_count = min(
        max(math.ceil(relative_change / _RELATIVE_CHANGE_PER_STEP), 2), _MAX_HOMOTOPY_STEPS
    )
    previous_roots = current_roots
    for step_number in range(1, step_count + 1):
        is_last_step = step_number == step_count
        start_roots = 2 * current_roots - previous_roots if step_number > 1 else current_roots
        previous_roots, current_roots = (
            current_roots,
            roots_near(
                step_number / step_count,
                start_roots,
                _NEWTON_TOLERANCE if is_last_step else _INTERMEDIATE_STEP_TOLERANCE,
            ),
        )
    first_roots = current_roots[: is_oscillating.size]
    second_roots = first_roots.conj()
    second_roots[~is_oscillating] = current_roots[is_oscillating.size :]
    roots[has_root] = np.column_stack([first_roots, second_roots])
    return roots


def newton_roots(
    newton_step: Callable[[ComplexArray], ComplexArray], s: ComplexArray, step_tolerance: float
) -> ComplexArray:
    """Return the roots that Newton's method finds from the start values `s`.

    `step_tolerance` is the relative length of the last step. The result is NaN where no root is
    found near its start.
    """
    start_roots = s
    with np.errstate(all="ignore"):
        for _ in range(_MAX_NEWTON_STEPS):
            step = newton_step(s)
            s = s + step
            if not np.nanmax(np.abs(step / s), initial=0.0) > step_tolerance:
                break
        # Far from any root every step is short, too.
        has_converged = (np.abs(step) < max(step_tolerance, 1e-9) * np.abs(s)) & (
            np.abs(s) < _MAX_ROOT_TO_START_RATIO * np.abs(start_roots)
        )
        return np.where(has_converged, s, np.nan + 0j)
