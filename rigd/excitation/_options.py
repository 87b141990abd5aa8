"""Options of excitations, as the signatures of their functions declare them.

An option is an argument annotated with its type and its help, ``Annotated[float, doc("…")]``. The
command of a package's excitation, the page's form, the socket and the docstrings read this.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Final, TypeVar, get_args, get_origin

from annotated_types import DocInfo, doc

from rigd.units import unit_of

F = TypeVar("F", bound=Callable[..., Any])
"""Type of a function that returns an excitation."""

RestS = Annotated[float, doc("Rest before the excitation.")]
"""Type of the option ``rest_s`` of every excitation: duration of the rest in s."""
RingDownS = Annotated[float, doc("Ring-down after the excitation.")]
"""Type of the option ``ring_down_s`` of every excitation: duration of the ring-down in s."""

RIG_ARGUMENTS: Final = frozenset({"rate_hz", "rig", "tip_slope_rad"})
"""Names of arguments of these functions that are data or limits of the rig, not options of the
excitation."""


@dataclass(frozen=True, slots=True)
class ExcitationOption:
    """Declared option of an excitation."""

    name: str
    """Name of the argument, which ends in its unit."""
    value_type: Any
    """Type of its values."""
    default: Any
    """Default; None also if the option is required."""
    required: bool
    """Whether the option has no default."""
    help: str
    """Description, as sentences."""

    @property
    def unit(self) -> str:
        """Unit of the values, or ""."""
        return unit_of(self.name)


def declared_options(
    function: Callable[..., Any], *, include_rig_arguments: bool = False
) -> tuple[ExcitationOption, ...]:
    """Return the options of a function that returns an excitation.

    Arguments that are data of the rig (`RIG_ARGUMENTS`) are left out by default.
    """
    return tuple(
        _option(argument)
        for argument in inspect.signature(function).parameters.values()
        if include_rig_arguments or argument.name not in RIG_ARGUMENTS
    )


def _option(argument: inspect.Parameter) -> ExcitationOption:
    """Return the option that an argument declares."""
    value_type: Any = argument.annotation
    metadata: list[Any] = []
    if get_origin(value_type) is Annotated:
        value_type, *metadata = get_args(value_type)
    required = argument.default is inspect.Parameter.empty
    return ExcitationOption(
        name=argument.name,
        value_type=value_type,
        default=None if required else argument.default,
        required=required,
        help=next((each.documentation for each in metadata if isinstance(each, DocInfo)), ""),
    )


def documented(function: F) -> F:
    """Add the section ``Parameters`` to the docstring of a function, from its signature."""
    summary, separator, raises_text = inspect.cleandoc(function.__doc__ or "").partition(
        "\nRaises\n---"
    )
    parameter_entries = "".join(
        f"{option.name}\n    {option.help}\n"
        for option in declared_options(function, include_rig_arguments=True)
    )
    docstring_section = f"\nParameters\n----------\n{parameter_entries}"
    function.__doc__ = f"{summary.rstrip()}\n{docstring_section}{separator}{raises_text}"
    return function
