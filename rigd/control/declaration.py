"""Declaration of a controller of the motor's angle: its settings, its law and its checks.

A package adds a controller by an entry point of the group ``rigd.controllers``
(:mod:`rigd.plugins`), which names a `ControllerKind`. The PID that comes with rigd is declared in
the same way (:mod:`rigd.control.kinds`).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rigd.check_rows import CheckRow
from rigd.control._loop_model import LinearController, LoopModel
from rigd.control.contracts import Controller


@dataclass(frozen=True, slots=True)
class ControlledRig:
    """Rig for which a controller is made."""

    loop: LoopModel
    """Motor, beam, delays and rate, with the PID of the section ``[control]``."""
    torque_limit_nm: float
    """Largest torque of the motor: the loop limits every torque to it."""
    settings: Any = None
    """Values of the profile's section, of the type that the controller's kind declares."""


@dataclass(frozen=True, slots=True)
class ControllerKind:
    """Declaration of a controller that a profile can name as ``control.controller``.

    The controller is given by its matrices (`linear`), or as Python code (`make`). A kind with code
    can state matrices as well, which then serve for checks and predictions only.
    """

    name: str
    """Name in a profile, equal to the name of the entry point."""
    summary: str
    """One line on the controller, for lists."""
    linear: Callable[[ControlledRig], LinearController] | None = None
    """Function that returns the controller's matrices at the rig's rate."""
    make: Callable[[ControlledRig], Controller] | None = None
    """Function that returns a new controller with its own code; None: the matrices are used."""
    shifts_reference: bool = False
    """Whether the output is an angle in rad that is added to the reference of rigd's PID.

    Otherwise it is the motor's torque in N·m, in place of the PID's."""
    settings: type | None = None
    """Frozen dataclass with the keys of the profile's section of this name; None: no section.

    The fields are declared like those of a device: units in the names, ranges and help
    (``annotated_types.doc``) in ``Annotated``. A key may be omitted if its field has a default."""
    contradictions: Callable[[Mapping[str, Any]], Iterable[str]] | None = None
    """Function that yields messages on values of a profile that contradict each other.

    Its argument maps the dotted keys of the profile (``"rig.rate_hz"``) to validated values."""
    check_rows: Callable[[ControlledRig], Iterable[CheckRow]] | None = None
    """Function that yields rows of ``rigd check``; a failed row prevents every session."""

    @property
    def required_sections(self) -> tuple[str, ...]:
        """Sections that a profile with this controller must have."""
        return () if self.settings is None else (self.name,)
