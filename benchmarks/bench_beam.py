"""Time of the exact model, against Eq. 25 as printed, with finite differences as derivatives.

Best of ten in turn, on the 7907 points of the paper's fit band.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the control process

import argparse

import numpy as np
from gate import Gate, Row
from timing import least_in_turn_s

from rigd.beam import Beam, Damping, Plant, TransferGrid
from rigd.beam.realisation import couple, propagator, realise
from rigd.sim import SimulatedPlant

BEAM = Beam(0.98, 4.7e-3, 0.090275)
DAMPING = Damping(7.1e-5, 0.996, 0.055, 0.594)
TICKS = 20_000
ROWS = (
    # Measured 0.25, 0.033 and 0.058.
    Row("G", most=0.5, unit="times the textbook form"),
    # Measured 0.083 to 0.10 on four computers.
    Row("G and 4 derivatives", most=0.12, unit="times differences"),
    Row("G and 4 derivatives, new grid", most=0.12, unit="times differences"),
    # Measured 8e-4: the error of finite differences of 1e-7.
    Row("derivatives against the differences", most=2e-3, unit="relative deviation"),
    # Measured 3.4e-5.
    Row("error of the realisation", most=1e-4, unit="of the largest response"),
    # Measured 9 to 12, and 2.2 to 2.9.
    Row("realisation", most=25, unit="times G and 4 derivatives"),
    Row("tick of the plant", most=5, unit="times its matrix product"),
)


def textbook(s: np.ndarray, zeta: float, alpha: float, gamma: float, lambda_: float) -> np.ndarray:
    """Return Eq. 25 as printed."""
    stiffness, length = BEAM.bending_stiffness_n_m2, BEAM.length_m
    c = 1 + zeta * s**alpha
    beta = (-(BEAM.density_over_stiffness * s**2 + gamma * s**lambda_) / c) ** 0.25
    z = beta * length
    bracket = np.sin(z) * np.cosh(z) - np.cos(z) * np.sinh(z)
    return -stiffness * c * beta * bracket / (1 + np.cos(z) * np.cosh(z))


def textbook_with_differences(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Eq. 25 and its four derivatives by forward differences."""
    at = np.array([DAMPING.zeta, DAMPING.alpha, DAMPING.gamma, DAMPING.lambda_])
    g = textbook(s, *at)
    steps = 1e-7 * at
    rows = [(textbook(s, *(at + step)) - g) / step.sum() for step in np.diag(steps)]
    return g, np.array(rows)


def tick_by_tick(plant: SimulatedPlant, torques: list[float]) -> None:
    """Advance the plant tick by tick, as a session does."""
    for torque in torques:
        plant.command(torque)
        plant.advance()


def main() -> None:
    """Measure and print the ratios, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    s = 2j * np.pi * np.arange(94, 8001) / 160
    grid = TransferGrid(s)
    plain, value, differences, gradient, fresh, build = least_in_turn_s(
        10,
        lambda: textbook(s, 7.1e-5, 0.996, 0.055, 0.594),
        lambda: grid.evaluate(BEAM, DAMPING),
        lambda: textbook_with_differences(s),
        lambda: grid.evaluate_with_gradient(BEAM, DAMPING),
        lambda: TransferGrid(s).evaluate_with_gradient(BEAM, DAMPING),
        lambda: realise(Plant(BEAM, DAMPING)),
    )
    print(f"{s.size} points: G {1e3 * value:.2f} ms, with 4 derivatives {1e3 * gradient:.2f} ms")
    gate.measured("G", value / plain)
    gate.measured("G and 4 derivatives", gradient / differences)
    gate.measured("G and 4 derivatives, new grid", fresh / differences)
    exact = grid.evaluate_with_gradient(BEAM, DAMPING)[1]
    error = np.max(np.abs(textbook_with_differences(s)[1] - exact) / np.abs(exact))
    gate.measured("derivatives against the differences", error)

    realisation = realise(Plant(BEAM, DAMPING))
    model = couple(realisation, motor_inertia_kg_m2=2e-3, viscous_nm_s_per_rad=0.02)
    (step,) = least_in_turn_s(10, lambda: propagator(model, 1e-3))
    print(f"realisation, {realisation.b.size} states: {1e3 * build:.2f} ms")
    print(f"its propagator: {1e3 * step:.2f} ms")
    gate.measured("error of the realisation", realisation.relative_error)
    gate.measured("realisation", build / gradient)

    from rigd.profile import load_profile

    plant = SimulatedPlant(load_profile("sim").rig)
    plant.enable()
    torques = (0.2 * np.random.default_rng(0).standard_normal(TICKS)).tolist()
    matrix, x = np.ones((56, 53)), np.ones(53)
    y = np.empty(56)

    def products() -> None:
        for _ in range(TICKS):
            np.dot(matrix, x, out=y)

    ticks, product = least_in_turn_s(10, lambda: tick_by_tick(plant, torques), products)
    print(f"plant of the profile `sim`: {1e6 * ticks / TICKS:.2f} µs a tick")
    gate.measured("tick of the plant", ticks / product)
    gate.finish()


if __name__ == "__main__":
    main()
