"""Motion that a beam without contact has in a record, predicted from the measured angle.

The innovations of a touch are the deviations from this prediction. The measured angle drives the
exact model from the beginning of the record. Motion before the record adds free vibrations of
unknown amplitudes, which are fitted to the samples before the touch, together with an offset and a
drift of torque and base shear.
"""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    CausalTransform,
    PointForceGrid,
    clamped_free_eigenvalues,
    mode_shape,
    poles,
    root_shear_ratio,
)
from rigd.touch._kernels import TRANSFORM_DECAY_EXPONENT, chebyshev_nodes
from rigd.touch._model import TouchModel

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

STEPS_PER_SAMPLE = 4
"""Number of time steps of the free motion per sample; a spline interpolates the angle to them."""
_COMPUTED_BAND_FRACTION = 0.5
"""Highest frequency that is computed, as a fraction of the Nyquist frequency of the time steps."""
_MAX_MODE_HZ = 330.0
"""Highest frequency in Hz of the modes whose free vibrations are fitted."""
_ANGLE_SETTLING_S = 0.03
"""Time constant in s with which the angle is continued to rest after the record's end. A jump at
the end would cause computed vibrations before it."""
_SPEED_WINDOW_S = 0.02
"""Duration in s of the first samples from which the initial speed is estimated."""
_POSITION_NODE_COUNT = 36
"""Number of positions from which the displacement at all other positions is interpolated."""
SPLINE_FADE_SAMPLES = 24
"""Number of samples after which the effect of one sample on a spline has faded."""


@dataclass(frozen=True, slots=True)
class TouchRecord:
    """Samples of angle, torque and base shear around a touch, from 0.3 s or more before it."""

    rate_hz: float
    """Samples a second."""
    angle_rad: RealArray
    """Measured angle, shape (n,)."""
    torque_nm: RealArray
    """Measured coupling torque, shape (n,)."""
    shear_n: RealArray | None
    """Measured base shear, shape (n,); None if the profile does not define it."""
    detection_index: int
    """Index of the sample at which the touch was detected."""

    def first_samples(self, sample_count: int) -> "TouchRecord":
        """Return the record of the first samples only, with the same detection.

        Parameters
        ----------
        sample_count
            Number of samples.
        """
        shear_n = None if self.shear_n is None else self.shear_n[:sample_count]
        return TouchRecord(
            self.rate_hz,
            self.angle_rad[:sample_count],
            self.torque_nm[:sample_count],
            shear_n,
            self.detection_index,
        )


class FreeBeam:
    """Model of the beam without contact, which predicts its motion from the measured angle.

    Parameters
    ----------
    model
        Model of the beam.
    x_m
        Positions at which the displacement is computed, shape (m,).
    rate_hz
        Samples a second.
    sample_count
        Largest number of samples in a record.
    """

    __slots__ = (
        "_force_grid",
        "_interpolation",
        "_node_displacement",
        "_shear",
        "_torque",
        "_unit_sample_transform",
        "free_vibration",
        "model",
        "rate_hz",
        "transform",
        "x_m",
    )

    def __init__(
        self, model: TouchModel, x_m: RealArray, rate_hz: float, sample_count: int
    ) -> None:
        from scipy.fft import next_fast_len

        self.model, self.x_m, self.rate_hz = model, x_m, rate_hz
        n = next_fast_len(STEPS_PER_SAMPLE * round(1.6 * sample_count + 0.1 * rate_hz), real=True)
        step_hz = STEPS_PER_SAMPLE * rate_hz
        self.transform = CausalTransform(
            n, step_hz, TRANSFORM_DECAY_EXPONENT, _COMPUTED_BAND_FRACTION * step_hz / 2
        )
        s = self.transform.s
        self._force_grid = force_grid = PointForceGrid(s, model.plant.beam, model.plant.damping)
        filter_response = model.sensor_filter.response(s)
        filter_response *= np.exp(-s * (model.wrench_delay_s - model.angle_delay_s))
        tool_inertia = model.plant.tool_inertia_kg_m2 * s * s
        self._torque: ComplexArray = filter_response * (
            force_grid.torque_per_angle() + tool_inertia
        )
        self._shear: ComplexArray = filter_response * force_grid.shear_per_angle()
        self.free_vibration = FreeVibration.from_model(model, np.empty(0))
        self._set_positions(x_m)
        unit_sample = np.zeros(3 * SPLINE_FADE_SAMPLES)
        unit_sample[SPLINE_FADE_SAMPLES] = 1.0
        self._unit_sample_transform = self.transform.forward(
            _interpolate_angle(unit_sample, rate_hz, self.transform)[0]
        )

    def at_positions(self, x_m: RealArray) -> "FreeBeam":
        """Return a copy of the model that computes displacements at other positions.

        Parameters
        ----------
        x_m
            Positions at which the displacement is computed, shape (m,).
        """
        moved_beam = copy(self)
        moved_beam._set_positions(x_m)
        return moved_beam

    def _set_positions(self, x_m: RealArray) -> None:
        """Set the positions at which the displacement is computed.

        Displacements at many positions are interpolated from those at 36 nodes, with a relative
        error of 1e-7 for waves of 1 kHz.
        """
        self.x_m = x_m
        nodes_m, self._interpolation = x_m, np.eye(x_m.size)
        if x_m.size > _POSITION_NODE_COUNT:
            nodes_m, self._interpolation = chebyshev_nodes(x_m, _POSITION_NODE_COUNT)
        self._node_displacement: ComplexArray = self._force_grid.displacement_per_angle(nodes_m).T
        self.free_vibration = self.free_vibration.at_positions(x_m / self.model.plant.beam.length_m)

    def displacement_per_sample(self, position_index: int, sample_count: int) -> RealArray:
        """Return the displacement over time at one position per sample of the angle, in m/rad.

        Parameters
        ----------
        position_index
            Index of the position.
        sample_count
            Number of samples after the sample of the angle for which the displacement is returned.

        Returns
        -------
        ndarray, shape (STEPS_PER_SAMPLE · (SPLINE_FADE_SAMPLES + sample_count),)
            Displacement at the time steps. They begin `SPLINE_FADE_SAMPLES` samples before the
            sample of the angle, because a sample also changes the spline before it.
        """
        laplace_response = (
            self._interpolation[position_index] @ self._node_displacement
        ) * self._unit_sample_transform
        return self.transform.inverse(
            laplace_response, STEPS_PER_SAMPLE * (SPLINE_FADE_SAMPLES + sample_count)
        )

    def motion(
        self,
        touch_record: TouchRecord,
        quiet_samples: int,
        first_sample: int,
        angle_transform: "AngleTransform | None" = None,
    ) -> "FreeMotion":
        """Return the predicted motion without contact, and the record's deviations from it.

        Parameters
        ----------
        touch_record
            Samples around the touch.
        quiet_samples
            Number of samples that are certainly before the touch.
        first_sample
            Index of the sample from which the displacement is computed.
        angle_transform
            Transform of the record's angle, if another model has computed it; None: compute it.
        """
        n = touch_record.angle_rad.size
        rate_hz = self.rate_hz
        angle_transform = angle_transform or AngleTransform.from_samples(
            touch_record.angle_rad, rate_hz, self.transform
        )
        spectrum, start_rad, speed_rad_s = (
            angle_transform.spectrum,
            angle_transform.start_rad,
            angle_transform.speed_rad_s,
        )
        measured_channels = [(touch_record.torque_nm, self._torque)]
        if touch_record.shear_n is not None:
            measured_channels.append((touch_record.shear_n, self._shear))
        t = np.arange(n) / rate_hz
        delay_s = self.model.wrench_delay_s - self.model.angle_delay_s
        vibration_columns = self.free_vibration.torque_and_shear(t - delay_s)
        innovations, design_matrices = [], []
        for i, (measured_samples, transfer_function) in enumerate(measured_channels):
            free_reading = self.transform.inverse(
                transfer_function * spectrum, STEPS_PER_SAMPLE * n
            )[::STEPS_PER_SAMPLE]
            innovations.append(measured_samples - free_reading)
            offset_and_drift = np.zeros((n, 2 * len(measured_channels)))
            offset_and_drift[:, 2 * i] = 1.0
            offset_and_drift[:, 2 * i + 1] = t - t[quiet_samples // 2]
            design_matrices.append(np.hstack([vibration_columns[i], offset_and_drift]))
        motion_fit = _FreeMotionFit.fit(innovations, design_matrices, quiet_samples)
        step_count = STEPS_PER_SAMPLE * n
        node_displacement_m = self.transform.inverse(self._node_displacement * spectrum, step_count)
        displacement_m = (
            self._interpolation @ node_displacement_m[:, STEPS_PER_SAMPLE * first_sample :]
        )
        step_times_s = np.arange(STEPS_PER_SAMPLE * first_sample, step_count) / (
            STEPS_PER_SAMPLE * rate_hz
        )
        displacement_m += self.x_m[:, None] * (start_rad + speed_rad_s * step_times_s)
        vibration_amplitudes = motion_fit.amplitudes[
            : self.free_vibration.displacement_shapes.shape[0] * 2
        ]
        displacement_m += self.free_vibration.displacement(step_times_s, vibration_amplitudes)
        return FreeMotion(
            t=t - self.model.wrench_delay_s,
            innovations=np.array(motion_fit.innovations),
            noise_stds=np.array(motion_fit.noise_stds),
            design_matrices=np.array(design_matrices),
            amplitude_cholesky=np.linalg.cholesky(motion_fit.covariance).astype(np.float64),
            angle_transform=angle_transform,
            free_vibration=self.free_vibration,
            angle_noise_rad=_angle_noise(touch_record.angle_rad[:quiet_samples]),
            displacement_m=displacement_m,
            first_s=first_sample / rate_hz - self.model.angle_delay_s,
            step_s=1 / (STEPS_PER_SAMPLE * rate_hz),
        )


@dataclass(frozen=True, slots=True)
class FreeMotion:
    """Predicted motion of the beam without contact, and the deviations of a record from it."""

    t: RealArray
    """Instants of the samples of torque and shear, corrected for their delays, shape (n,)."""
    innovations: RealArray
    """Innovations (measured minus predicted) of torque and, if measured, base shear, shape (c,
    n)."""
    noise_stds: RealArray
    """Standard deviation of each channel's innovations before the touch, shape (c,)."""
    design_matrices: RealArray
    """Effects of the q fitted quantities (free vibrations, offsets and drifts) on torque and shear
    per unit amplitude, shape (c, n, q)."""
    amplitude_cholesky: RealArray
    """Lower Cholesky factor of the covariance of the q fitted amplitudes, shape (q, q)."""
    angle_transform: "AngleTransform"
    """Laplace transform of the measured angle, which drives the beam."""
    free_vibration: "FreeVibration"
    """Free vibrations whose amplitudes were fitted."""
    angle_noise_rad: float
    """Standard deviation of the noise in one sample of the angle."""
    displacement_m: RealArray
    """Displacement of the beam in m at m positions and k time steps, shape (m, k)."""
    first_s: float
    """Instant of the first time step of `displacement_m`."""
    step_s: float
    """Time between two time steps of `displacement_m`."""


def _angle_noise(angle_rad: RealArray) -> float:
    """Return the standard deviation in rad of the angle's noise, including encoder resolution.

    It is estimated from fourth differences of the samples, which contain hardly any motion.
    """
    return float(np.sqrt(np.mean(np.diff(angle_rad, 4) ** 2) / 70))


@dataclass(frozen=True, slots=True)
class AngleTransform:
    """Laplace transform of a record's angle, without its initial value and speed."""

    spectrum: ComplexArray
    """Laplace transform of the angle minus ``start_rad + speed_rad_s · t``."""
    start_rad: float
    """Angle at the record's beginning."""
    speed_rad_s: float
    """Speed at the record's beginning."""

    @classmethod
    def from_samples(
        cls, angle_rad: RealArray, rate_hz: float, transform: CausalTransform
    ) -> "AngleTransform":
        """Return the Laplace transform of a record's angle from its samples."""
        remaining_angle, start_rad, speed_rad_s = _interpolate_angle(angle_rad, rate_hz, transform)
        return cls(transform.forward(remaining_angle), start_rad, speed_rad_s)


def _interpolate_angle(
    angle_rad: RealArray, rate_hz: float, transform: CausalTransform
) -> tuple[RealArray, float, float]:
    """Return the angle at the time steps of a transform, without its initial value and speed.

    The second and third results are the initial angle in rad and the initial speed in rad/s.
    """
    from scipy.interpolate import CubicSpline

    t = np.arange(angle_rad.size) / rate_hz
    window_samples = max(4, round(_SPEED_WINDOW_S * rate_hz))
    polynomial = np.polyfit(t[:window_samples], angle_rad[:window_samples], 2)
    start_rad, speed_rad_s = float(polynomial[2]), float(polynomial[1])
    relative_angle_rad = angle_rad - start_rad - speed_rad_s * t
    angle_spline = CubicSpline(t, relative_angle_rad)
    step_times_s = np.arange(STEPS_PER_SAMPLE * angle_rad.size) / transform.rate_hz
    record_steps_s = step_times_s[step_times_s <= t[-1]]
    times_after_s = np.arange(1, transform.length - record_steps_s.size + 1) / transform.rate_hz
    end_speed_rad_s = np.polyfit(t[-6:] - t[-1], relative_angle_rad[-6:], 1)[0]
    ending_angle_rad = relative_angle_rad[-1] + end_speed_rad_s * _ANGLE_SETTLING_S * (
        1 - np.exp(-times_after_s / _ANGLE_SETTLING_S)
    )
    fade_factors = 0.5 + 0.5 * np.cos(np.pi * np.minimum(times_after_s / times_after_s[-1], 1.0))
    return (
        np.concatenate([angle_spline(record_steps_s), ending_angle_rad * fade_factors]),
        start_rad,
        speed_rad_s,
    )


@dataclass(frozen=True, slots=True)
class FreeVibration:
    """Free vibrations of the beam's first modes: decaying cosines and sines of unit amplitude."""

    poles: ComplexArray
    """Poles of the modes in rad/s, shape (modes,)."""
    root_loads: ComplexArray
    """Complex torque and base shear of each mode for a unit amplitude, shape (2, modes)."""
    amplitude_units: RealArray
    """Factor of each mode's shape for a unit amplitude, chosen for similar torques; (modes,)."""
    displacement_shapes: RealArray
    """Displacement at each position for a unit amplitude of each mode, shape (modes, positions)."""

    @classmethod
    def from_model(cls, model: TouchModel, x_m: RealArray) -> "FreeVibration":
        """Return the free vibrations of a model, with the displacement at positions `x_m`."""
        beam, damping = model.plant.beam, model.plant.damping
        candidate_mode_count = 12
        mode_poles = poles(beam, damping, candidate_mode_count)[:, 0]
        mode_count = max(1, int(np.sum(mode_poles.imag < 2 * np.pi * _MAX_MODE_HZ)))
        mode_poles = mode_poles[:mode_count]
        wave_numbers = clamped_free_eigenvalues(mode_count) / beam.length_m
        mode_signs = np.where(np.arange(mode_count) % 2 == 0, 1.0, -1.0)
        complex_stiffness = beam.bending_stiffness_n_m2 * (
            1 + damping.zeta * mode_poles**damping.alpha
        )
        shear_ratios = root_shear_ratio(mode_count)
        root_loads = complex_stiffness * np.stack(
            [-2 * mode_signs * wave_numbers**2, -2 * mode_signs * shear_ratios * wave_numbers**3]
        )
        root_loads *= model.sensor_filter.response(mode_poles)
        # With these units the same amplitude causes about the same torque in each mode.
        amplitude_units = 1 / np.abs(root_loads[0])
        without_shapes = cls(
            mode_poles.astype(np.complex128),
            root_loads * amplitude_units,
            amplitude_units,
            np.empty((mode_count, 0)),
        )
        return without_shapes.at_positions(x_m / beam.length_m)

    def at_positions(self, position_fractions: RealArray) -> "FreeVibration":
        """Return the same free vibrations with displacements at other fractions of the length."""
        mode_shapes = np.stack(
            [mode_shape(i + 1, position_fractions) for i in range(self.poles.size)]
        )
        return replace(self, displacement_shapes=mode_shapes * self.amplitude_units[:, None])

    def torque_and_shear(self, t: RealArray) -> RealArray:
        """Return torque and base shear of each vibration over time, shape (2, t, 2 · modes).

        Times are in s from the beginning of the record.
        """
        oscillation = np.exp(np.multiply.outer(t, self.poles))
        complex_parts = [oscillation * root_load for root_load in self.root_loads]
        return np.array(
            [np.hstack([complex_part.real, -complex_part.imag]) for complex_part in complex_parts]
        )

    def displacement(self, t: NDArray[np.floating], amplitudes: RealArray) -> RealArray:
        """Return the beam's displacement in m for given amplitudes of the free vibrations.

        Amplitudes are of cosines and sines, shape (2 · modes, r) or (2 · modes,); the result has
        the shape (positions, t, r) or (positions, t).
        """
        mode_count = self.poles.size
        oscillation = np.exp(np.multiply.outer(t, self.poles)).T
        vibration_columns = amplitudes.reshape(2 * mode_count, -1)
        displacement_m = np.multiply(
            oscillation.real[:, :, None], vibration_columns[:mode_count, None]
        )
        displacement_m -= np.multiply(
            oscillation.imag[:, :, None], vibration_columns[mode_count:, None]
        )
        displacement: RealArray = self.displacement_shapes.T @ displacement_m.reshape(
            mode_count, -1
        )
        return displacement.reshape(-1, t.size, *amplitudes.shape[1:])


@dataclass(frozen=True, slots=True)
class _FreeMotionFit:
    """Fit of free vibrations, offset and drift to the samples before a touch."""

    amplitudes: RealArray
    """Fitted amplitudes, shape (q,)."""
    covariance: RealArray
    """Covariance of the amplitudes, shape (q, q)."""
    noise_stds: list[float]
    """Standard deviations of the residuals of torque and shear before the touch."""
    innovations: list[RealArray]
    """Residuals of torque and shear at all samples, also after the touch."""

    @classmethod
    def fit(
        cls, innovations: list[RealArray], design_matrices: list[RealArray], quiet_samples: int
    ) -> "_FreeMotionFit":
        """Return the weighted least-squares fit to the first `quiet_samples` samples.

        Torque and shear are weighted by their noise, which repeated fits estimate.
        """
        noise_stds = [1.0] * len(innovations)
        for _ in range(3):
            a = np.vstack(
                [d[:quiet_samples] / s for d, s in zip(design_matrices, noise_stds, strict=True)]
            )
            b = np.concatenate(
                [e[:quiet_samples] / s for e, s in zip(innovations, noise_stds, strict=True)]
            )
            normal_matrix = a.T @ a
            regularisation = 1e-9 * np.trace(normal_matrix) / normal_matrix.shape[0]
            covariance = np.linalg.inv(
                normal_matrix + regularisation * np.eye(normal_matrix.shape[0])
            )
            fitted_values = covariance @ (a.T @ b)
            residuals = [
                e - d @ fitted_values for e, d in zip(innovations, design_matrices, strict=True)
            ]
            degrees_of_freedom = max(
                quiet_samples - fitted_values.size / len(residuals), quiet_samples / 2
            )
            noise_stds = [
                float(np.sqrt(np.sum(e[:quiet_samples] ** 2) / degrees_of_freedom))
                for e in residuals
            ]
        a = np.vstack(
            [d[:quiet_samples] / s for d, s in zip(design_matrices, noise_stds, strict=True)]
        )
        normal_matrix = a.T @ a
        covariance = np.linalg.inv(normal_matrix + regularisation * np.eye(normal_matrix.shape[0]))
        return cls(fitted_values, covariance, noise_stds, residuals)
