"""Drag in a whole-record fit: its torque at one beam, and what it changes by beside it.

The torque by drag is not linear in the motion, so no response function gives it. At a beam and a
drag it is computed (`analysis.whole_record.drag`) and taken out of the measured torque; what it
changes by when beam or drag change is linear in

* the poles of the modes, on which the motion near a resonance depends,
* the external damping, which also drives the modes,
* the logarithm of the mass per length, which the force has to move,
* the delay between the channels,
* the drag itself.

The first four follow from a fit's unknowns, the last is free: its columns are projected out as
those of a free decay are. A fit with drag repeats both steps until they agree.

Without drag a peak grows as the damping falls, beyond all bounds; with it, it hardly grows. Where
the linear torque curves with a pole, the torque by drag curves against it. So of the linear torque
too only the first order in the poles counts: its remainder is taken away again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.whole_record.free_decay import mode_poles

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from analysis.whole_record.drag import DragLaw, DragResponse
    from analysis.whole_record.free_decay import Pole
    from analysis.whole_record.plant import Plant

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class DragExpansion:
    """Changes of the torque by drag round one beam and drag, as spectra in the band.

    Attributes
    ----------
    plant : Plant
    law : DragLaw
        At these the torque was taken out of the record.
    response : DragResponse
        Of that beam.
    band : callable
        Spectrum in the band of samples of the angle's times.
    by_pole : dict of int to ndarray of complex, shape (2, K)
        Of each mode: by the real and the imaginary part of its upper pole.
    by_external : ndarray of complex, shape (2, K)
        By gamma and lambda, the poles held.
    by_ln_density, by_delay : ndarray of complex, shape (K,)
    by_law : ndarray of complex, shape (2, K)
        By the two numbers of the law.
    speed_m_s, top_speed_m_s : float
        Speed that counts most, and the highest: see `DragTorque`.
    """

    plant: Plant
    law: DragLaw
    response: DragResponse
    band: Callable[[Real], Complex]
    by_pole: dict[int, Complex]
    by_external: Complex
    by_ln_density: Complex
    by_delay: Complex
    by_law: Complex
    speed_m_s: float
    top_speed_m_s: float

    def beside(
        self, plant: Plant, poles: Sequence[Pole], names: Sequence[str], chain: Real
    ) -> tuple[Complex, Complex]:
        """Spectrum (K,) of what another beam changes, and its derivatives by the unknowns (k, K).

        Parameters
        ----------
        plant : Plant
            The other beam.
        poles : sequence of Pole
            Its poles, differentiated by the unknowns.
        names : sequence of str
            Names of the parameters, those of `Unknowns`.
        chain : ndarray, shape (len(names), k)
            Their derivatives by the unknowns, of density over stiffness and of stiffness as
            logarithms.
        """
        rows, moved, slopes = [], [], []
        own = {pole.mode: pole.at_rad_s for pole in mode_poles(self.plant, len(self.by_pole), ())}
        for pole in poles:
            if pole.mode in self.by_pole and pole.oscillates and pole.mode in own:
                apart = pole.at_rad_s - own[pole.mode]
                curved, steeper = self._remainder(pole.mode, own[pole.mode], pole.at_rad_s)
                by_pole = self.by_pole[pole.mode]
                # Slopes at the pole itself, the values of the remainder as a row of their own.
                rows += [*by_pole, *steeper, curved]
                moved += [apart.real, apart.imag, 0.0, 0.0, -1.0]
                turn = [pole.derivative.real, pole.derivative.imag]
                slopes += [*turn, *(-part for part in turn), np.zeros(chain.shape[1])]
        of_density = sum(
            (chain[names.index(name)] for name in _OF_DENSITY if name in names),
            start=np.zeros(chain.shape[1]),
        )
        rows.append(self.by_ln_density)
        here, there = self.plant.beam.density_kg_per_m, plant.beam.density_kg_per_m
        moved.append(np.log(there / here))
        slopes.append(of_density)
        before, after = self.plant.damping, plant.damping
        if after.gamma > 0:
            rows += list(self.by_external)
            moved += [after.gamma - before.gamma, after.lambda_ - before.lambda_]
            slopes += [
                chain[names.index(name)] if name in names else np.zeros(chain.shape[1])
                for name in ("gamma", "lambda")
            ]
        else:
            rows.append(self.by_external[0])
            moved.append(-before.gamma)
            slopes.append(np.zeros(chain.shape[1]))
        rows.append(self.by_delay)
        moved.append(plant.delay_s - self.plant.delay_s)
        free = "delay_s" in names
        slopes.append(chain[names.index("delay_s")] if free else np.zeros(chain.shape[1]))
        # As real numbers: they are multiplied by real ones only.
        every = np.array(rows).view(np.float64)
        change: Complex = (np.array(moved) @ every).view(np.complex128)
        jacobian: Complex = (np.array(slopes).T @ every).view(np.complex128)
        return change, jacobian

    def _remainder(self, mode: int, here: complex, there: complex) -> tuple[Complex, Complex]:
        """Linear torque of a mode beyond the first order in its pole, (K,), and its slopes, (2, K).

        The slopes are by the real and the imaginary part.
        """
        s, torque = self.response.s, self.response.modal_torque(mode)
        apart = there - here
        before, mirror = 1 / (s - here), 1 / (s - here.conjugate())
        after, after_mirror = 1 / (s - there), 1 / (s - there.conjugate())
        grown = after * after_mirror / (before * mirror)
        first = apart * before + apart.conjugate() * mirror
        real = grown * (after + after_mirror) - (before + mirror)
        imaginary = 1j * (grown * (after - after_mirror) - (before - mirror))
        spectra = torque * np.array([grown - 1 - first, real, imaginary])
        curved, *steeper = self.band(self.response.in_time(spectra))
        return curved, np.array(steeper)


_OF_DENSITY = ("density_over_stiffness", "bending_stiffness_n_m2")
"""Parameters whose logarithms add up to that of the mass per length."""
