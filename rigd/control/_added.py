"""Controller of an installed package in the loop: its output is checked, its torque is limited."""

from math import isfinite

from rigd.control._pid import PidController
from rigd.control.contracts import Controller, ControllerError
from rigd.plugins import Plugin, error_text


class PluginController:
    """Controller of an installed package, as the loop uses it (`LoopController`).

    The output is limited to `torque_limit_nm`, and added to the reference of the PID if there is
    one; otherwise it is the torque. Messages name the package `owner`.
    """

    __slots__ = (
        "_controller",
        "_owner",
        "_pid",
        "_step",
        "saturated",
        "torque_limit_nm",
        "unlimited_torque_nm",
    )

    def __init__(
        self,
        controller: Controller,
        torque_limit_nm: float,
        owner: Plugin,
        pid: PidController | None,
    ) -> None:
        self._controller = controller
        self._step = controller.step
        self._owner = owner
        self._pid = pid
        self.torque_limit_nm = torque_limit_nm
        self.unlimited_torque_nm = 0.0
        self.saturated = False

    @property
    def terms_nm(self) -> tuple[float, float, float, float, float]:
        """Terms of the PID whose reference is shifted; zero if there is no PID."""
        return (0.0, 0.0, 0.0, 0.0, 0.0) if self._pid is None else self._pid.terms_nm

    def reset(self, angle_rad: float) -> None:
        """Set the state to rest at an angle.

        Raise `ControllerError` if the package's code fails.
        """
        self.unlimited_torque_nm, self.saturated = 0.0, False
        if self._pid is not None:
            self._pid.reset(angle_rad)
        try:
            self._controller.reset(angle_rad)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit is no Exception
            raise self._controller_error("reset", error_text(error)) from error

    def step(self, reference_rad: float, angle_rad: float, coupling_torque_nm: float) -> float:
        """Return the torque command of a tick in N·m, within the limit.

        Raise `ControllerError` if the package's code fails, or its output is not a finite number.
        """
        try:
            controller_output = self._step(reference_rad, angle_rad, coupling_torque_nm)
            is_usable = isinstance(controller_output, (float, int)) and isfinite(controller_output)
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit is no Exception
            raise self._controller_error("step", error_text(error)) from error
        if not is_usable:
            raise self._controller_error("step", f"it returned {controller_output!r}")
        pid = self._pid
        if pid is not None:
            torque_nm = pid.step(reference_rad + controller_output, angle_rad, coupling_torque_nm)
            self.unlimited_torque_nm, self.saturated = pid.unlimited_torque_nm, pid.saturated
            return torque_nm
        limit_nm = self.torque_limit_nm
        self.unlimited_torque_nm = float(controller_output)
        self.saturated = not -limit_nm <= controller_output <= limit_nm
        return min(max(float(controller_output), -limit_nm), limit_nm)

    def _controller_error(self, method_name: str, failure_text: str) -> ControllerError:
        """Return the error that names the package, the failed method and the kind of failure."""
        return ControllerError(
            str(
                self._owner.error(
                    f"the controller's {method_name} failed ({failure_text}), and the torque was "
                    "switched off; report that to the package's author, or set "
                    'control.controller = "pid".'
                )
            )
        )
