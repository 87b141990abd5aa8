"""A discrete system with a delay: its exact response, and records that went through it."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class System:
    rate_hz: float = 200.0
    delay: int = 5
    numerator: tuple[float, ...] = (0.3, 0.1, -0.05)
    denominator: tuple[float, ...] = (1.0, -1.1, 0.5)

    def response(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        back = np.exp(-2j * np.pi * frequency_hz / self.rate_hz)
        rational = np.polyval(self.numerator[::-1], back) / np.polyval(self.denominator[::-1], back)
        return rational * back**self.delay

    def output(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """From rest, sample by sample."""
        driven = np.convolve(x, np.concatenate((np.zeros(self.delay), self.numerator)))[: x.size]
        y = np.zeros(x.size + 2)
        _, a1, a2 = self.denominator
        for n, value in enumerate(driven, start=2):
            y[n] = value - a1 * y[n - 1] - a2 * y[n - 2]
        return y[2:]


@dataclass(frozen=True, slots=True)
class Records:
    input_: NDArray[np.float64]
    output: NDArray[np.float64]


@pytest.fixture(scope="session")
def system() -> System:
    return System()


@pytest.fixture(scope="session")
def records(system: System) -> Records:
    x = np.random.default_rng(8_251_337).normal(size=60_000)
    return Records(x, system.output(x))
