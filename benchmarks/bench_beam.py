"""Time of the exact model, against Eq. 25 typed in as it stands with differences for derivatives.

Run as ``python benchmarks/bench_beam.py``. Best of ten, on the 7907 points of the paper's fit band.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the control process

from collections.abc import Callable

import numpy as np
from timing import least_s

from rigd.beam import Beam, Damping, Plant, TransferGrid
from rigd.beam.realisation import couple, propagator, realise
from rigd.sim import SimulatedPlant

BEAM = Beam(0.98, 4.7e-3, 0.090275)
DAMPING = Damping(7.1e-5, 0.996, 0.055, 0.594)
TICKS = 20_000


def best_of_ten(function: Callable[[], object]) -> float:
    """Shortest of ten runs, in milliseconds."""
    return 1e3 * least_s(function, 10)


def textbook(s: np.ndarray, zeta: float, alpha: float, gamma: float, lambda_: float) -> np.ndarray:
    """Eq. 25 as printed."""
    stiffness, length = BEAM.bending_stiffness_n_m2, BEAM.length_m
    c = 1 + zeta * s**alpha
    beta = (-(BEAM.density_over_stiffness * s**2 + gamma * s**lambda_) / c) ** 0.25
    z = beta * length
    bracket = np.sin(z) * np.cosh(z) - np.cos(z) * np.sinh(z)
    return -stiffness * c * beta * bracket / (1 + np.cos(z) * np.cosh(z))


def textbook_with_differences(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add the four derivatives by forward differences."""
    at = np.array([DAMPING.zeta, DAMPING.alpha, DAMPING.gamma, DAMPING.lambda_])
    g = textbook(s, *at)
    steps = 1e-7 * at
    rows = [(textbook(s, *(at + step)) - g) / step.sum() for step in np.diag(steps)]
    return g, np.array(rows)


def tick_by_tick(plant: SimulatedPlant, torques: list[float]) -> None:
    """Drive the plant as a session does."""
    for torque in torques:
        plant.command(torque)
        plant.advance()


def main() -> None:
    """Print the table."""
    s = 2j * np.pi * np.arange(94, 8001) / 160
    grid = TransferGrid(s)
    peer = best_of_ten(lambda: textbook_with_differences(s))
    peer_value = best_of_ten(lambda: textbook(s, 7.1e-5, 0.996, 0.055, 0.594))
    value = best_of_ten(lambda: grid.evaluate(BEAM, DAMPING))
    gradient = best_of_ten(lambda: grid.evaluate_with_gradient(BEAM, DAMPING))
    fresh = best_of_ten(lambda: TransferGrid(s).evaluate_with_gradient(BEAM, DAMPING))
    print(f"{s.size} points, best of ten")
    print(f"  G, textbook form                     {peer_value:7.2f} ms")
    print(f"  G                                    {value:7.2f} ms   {peer_value / value:5.1f} x")
    print(f"  G + 4 derivatives, differences       {peer:7.2f} ms")
    print(f"  G + 4 derivatives                    {gradient:7.2f} ms   {peer / gradient:5.1f} x")
    print(f"  G + 4 derivatives, grid rebuilt       {fresh:7.2f} ms   {peer / fresh:5.1f} x")

    exact = grid.evaluate_with_gradient(BEAM, DAMPING)[1]
    differences = textbook_with_differences(s)[1]
    error = np.max(np.abs(differences - exact) / np.abs(exact))
    print(f"  largest relative error of the differences {error:.0e}")

    realisation = realise(Plant(BEAM, DAMPING))
    model = couple(realisation, motor_inertia_kg_m2=2e-3, viscous_nm_s_per_rad=0.02)
    build = best_of_ten(lambda: realise(Plant(BEAM, DAMPING)))
    step = best_of_ten(lambda: propagator(model, 1e-3))
    print(f"realisation, {realisation.b.size} states, error {realisation.relative_error:.1e}")
    print(f"  build                                {build:7.2f} ms")
    print(f"  propagator                           {step:7.2f} ms")

    from rigd.profile import load_profile

    plant = SimulatedPlant(load_profile("sim").rig)
    plant.enable()
    torques = (0.2 * np.random.default_rng(0).standard_normal(TICKS)).tolist()
    ticks = best_of_ten(lambda: tick_by_tick(plant, torques)) * 1e3 / TICKS
    matrix, x = np.ones((56, 53)), np.ones(53)
    y = np.empty(56)

    def products() -> None:
        for _ in range(TICKS):
            np.dot(matrix, x, out=y)

    product = best_of_ten(products) * 1e3 / TICKS
    print(f"plant, {TICKS} ticks of the profile `sim`")
    print(f"  its matrix product alone             {product:7.2f} us a tick")
    print(f"  command and advance                  {ticks:7.2f} us a tick {ticks / product:4.1f} x")


if __name__ == "__main__":
    main()
