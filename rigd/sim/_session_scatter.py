"""Random variation of the simulated beam between sessions, drawn from the seed of each session."""

from dataclasses import replace

import numpy as np

from rigd.devices.parameters import RigParameters

_SCATTER_RANDOM_STREAM = 1
"""Number that makes these random draws differ from those of the noise with the same seed."""


def scatters_between_sessions(rig: RigParameters) -> bool:
    """Return whether the simulated beam varies between sessions."""
    return any(_scatter_percentages(rig))


def session_parameters(rig: RigParameters, seed: int) -> RigParameters:
    """Return the parameters of the simulated rig in one session, with the beam of this session.

    zeta, gamma and the bending stiffness are each multiplied by ``exp(0.01 p z)``. Here p is the
    percentage in the profile, and z a standard normal number that follows from the seed.

    Parameters
    ----------
    rig
        Parameters of the rig, with a section ``simulation``.
    seed
        Seed of the session (`simulation_seed` in its file).

    Examples
    --------
    >>> from dataclasses import replace
    >>> from rigd.profile import load_profile
    >>> from rigd.sim import session_parameters
    >>> rig = load_profile("sim").rig
    >>> rig = replace(rig, simulation=replace(rig.simulation, gamma_scatter_percent=5.0))
    >>> print(*(f"{session_parameters(rig, seed).damping.gamma:.4f}" for seed in (1, 2, 3)))
    0.0585 0.0498 0.0536
    """
    scatter_percentages = np.array(_scatter_percentages(rig))
    simulation = rig.simulation
    if simulation is None or not scatter_percentages.any():
        return rig
    standard_normals = np.random.default_rng((seed, _SCATTER_RANDOM_STREAM)).standard_normal(
        scatter_percentages.size
    )
    zeta_factor, gamma_factor, stiffness_factor = np.exp(
        0.01 * scatter_percentages * standard_normals
    ).tolist()
    damping = rig.damping
    return replace(
        rig,
        damping=replace(
            damping, zeta=zeta_factor * damping.zeta, gamma=gamma_factor * damping.gamma
        ),
        simulation=replace(
            simulation, stiffness_ratio=stiffness_factor * simulation.stiffness_ratio
        ),
    )


def _scatter_percentages(rig: RigParameters) -> tuple[float, float, float]:
    """Return the percentages by which zeta, gamma and bending stiffness vary between sessions."""
    simulation = rig.simulation
    if simulation is None:
        return 0.0, 0.0, 0.0
    return (
        simulation.zeta_scatter_percent,
        simulation.gamma_scatter_percent,
        simulation.stiffness_scatter_percent,
    )
