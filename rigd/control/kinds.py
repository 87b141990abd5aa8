"""Kinds of controllers that a profile can name: that of rigd, and those of installed packages."""

from functools import lru_cache
from typing import Final

from rigd.control._added import PluginController
from rigd.control._control_law import RunningLinearController
from rigd.control._loop_model import LinearController
from rigd.control._pid import SHIPPED_CONTROLLER, PidController, design_pid
from rigd.control.contracts import Controller, LoopController
from rigd.control.declaration import ControlledRig, ControllerKind
from rigd.plugins import Plugin, PluginError, Registry, load_declaration, plugin_errors


def _make_pid(rig: ControlledRig) -> PidController:
    """Return the PID controller, designed for the motor of a rig."""
    loop = rig.loop
    gains = design_pid(
        loop.motor_inertia_kg_m2, loop.viscous_nm_s_per_rad, loop.settings.pole_rad_s
    )
    return PidController(gains, loop.settings, loop.rate_hz, rig.torque_limit_nm)


SHIPPED: Final = {
    kind.name: kind
    for kind in (
        ControllerKind(
            SHIPPED_CONTROLLER,
            "PID with two degrees of freedom, feed-forward and friction compensation",
            make=_make_pid,
        ),
    )
}
"""Controllers that come with rigd, by their names in a profile."""


def _load_controller(plugin: Plugin) -> ControllerKind:
    """Import the kind of controller that a package adds; raise PluginError if it is invalid."""
    kind = load_declaration(plugin, ControllerKind)
    if not (callable(kind.linear) or callable(kind.make)):
        raise plugin.error("it has neither matrices nor code; add linear or make.")
    return kind


CONTROLLERS: Final = Registry("rigd.controllers", SHIPPED, _load_controller)
"""Kinds of controllers, by their names in a profile."""


def make_controller(rig: ControlledRig) -> LoopController:
    """Return a new controller of the kind that a rig's settings name.

    Parameters
    ----------
    rig
        Rig, from :meth:`rigd.profile.Profile.controlled_rig`.

    Raises
    ------
    PluginError
        If the package that adds the kind cannot be used, or its code fails.
    ControlDesignError
        If the PID cannot be designed.
    """
    controller_plugin = _plugin_of_controller(rig)
    if controller_plugin is None:
        make_shipped = SHIPPED[rig.loop.settings.controller].make
        assert make_shipped is not None
        loop_controller = make_shipped(rig)
        assert isinstance(loop_controller, LoopController)
        return loop_controller
    kind = CONTROLLERS.load(controller_plugin)
    if kind.make is None:
        linear_law = linear_controller(rig)
        assert linear_law is not None
        torque_limit_nm = float("inf") if kind.shifts_reference else rig.torque_limit_nm
        controller: Controller = RunningLinearController(linear_law, torque_limit_nm)
    else:
        with plugin_errors(controller_plugin):
            controller = kind.make(rig)
        if not all(callable(getattr(controller, name, None)) for name in ("reset", "step")):
            raise controller_plugin.error(
                f"{type(controller).__name__} has no reset and step; add them."
            )
    pid = _make_pid(rig) if kind.shifts_reference else None
    return PluginController(controller, rig.torque_limit_nm, controller_plugin, pid)


def linear_controller(rig: ControlledRig) -> LinearController | None:
    """Return the matrices of the controller of a package, or None if there are none.

    Parameters
    ----------
    rig
        Rig, from :meth:`rigd.profile.Profile.controlled_rig`.

    Raises
    ------
    PluginError
        If the package that adds the kind cannot be used, or its code fails.
    """
    owner = _plugin_of_controller(rig)
    if owner is None:
        return None
    with plugin_errors(owner):
        return _linear_controller(CONTROLLERS.load(owner), owner, rig)


def _plugin_of_controller(rig: ControlledRig) -> Plugin | None:
    """Return the package that adds the controller of a rig, or None for a shipped one.

    Raise `PluginError` if there is no such controller any more, or its package cannot be used.
    """
    name = rig.loop.settings.controller
    controller_plugin = CONTROLLERS.owner(name)
    if controller_plugin is None and name not in SHIPPED:
        raise PluginError(
            f'control.controller = "{name}": no installed package adds it; install the package, or '
            f'set control.controller = "{SHIPPED_CONTROLLER}".'
        )
    return controller_plugin


@lru_cache(maxsize=8)
def _linear_controller(
    kind: ControllerKind, controller_plugin: Plugin, rig: ControlledRig
) -> LinearController | None:
    """Return the matrices of a kind of controller for a rig; a design may take seconds."""
    if kind.linear is None:
        return None
    linear_law = kind.linear(rig)
    if not isinstance(linear_law, LinearController):
        raise controller_plugin.error(
            f"its linear returns a {type(linear_law).__name__}, not a LinearController."
        )
    return linear_law
