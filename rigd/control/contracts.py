"""Contracts between the control loop and a controller of the motor's angle."""

from typing import Protocol, runtime_checkable

from rigd.errors import FailureError


class ControllerError(FailureError):
    """Error: a controller failed in a tick, so that the session ends without torque."""


class Controller(Protocol):
    """Controller of an installed package, given as Python code and not by matrices.

    The loop calls `reset` before the first tick of a session, while the motor is without torque,
    and `step` once a tick. All limits of the profile are checked outside of the controller.
    """

    def reset(self, angle_rad: float) -> None:
        """Set the state to rest at an angle.

        The next step returns 0 if reference and angle are equal to this angle and the coupling
        torque is zero.

        Parameters
        ----------
        angle_rad
            Angle at which the motor is at rest.
        """

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Return the output of a tick: a torque in N·m, or a shift of the reference in rad.

        The output is a finite ``float``. The call takes a few microseconds, does not block, and
        leaves no memory allocated.

        Parameters
        ----------
        reference_rad, angle_rad
            Reference and measured angle.
        coupling_torque_nm
            Measured coupling torque.
        """


@runtime_checkable
class LoopController(Protocol):
    """Interface between the loop and any controller: the limited torque, and its terms."""

    torque_limit_nm: float
    """Largest magnitude of the returned torque."""
    saturated: bool
    """Whether the torque of the last step was limited, or is not a number."""
    unlimited_torque_nm: float
    """Torque of the last step before it was limited."""

    @property
    def terms_nm(self) -> tuple[float, float, float, float, float]:
        """Terms of the last torque: proportional, integral, derivative, feed-forward, friction.

        They are zero for a controller without such terms.
        """

    def reset(self, angle_rad: float) -> None:
        """Set the controller's state to rest at an angle, so that the torque does not jump.

        Parameters
        ----------
        angle_rad
            Angle at which the motor is at rest.
        """

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Return the torque command of a tick in N·m, within `torque_limit_nm`.

        Parameters
        ----------
        reference_rad, angle_rad
            Reference and measured angle.
        coupling_torque_nm
            Measured coupling torque.

        Raises
        ------
        ControllerError
            If the code of an installed package fails.
        """
