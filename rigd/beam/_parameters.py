"""Table of the parameters of a plant: the beam, its damping, its ends, and the torque channel."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import Final, Literal

OFFSET_PREFIX: Final = "stiffness_offset_"
"""Beginning of the names of modal stiffness offsets, before the number of the mode."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Definition of a parameter: its symbol, units, scale and valid range."""

    name: str
    """Name in estimates and documents, and in gradients if it is of beam, damping or ends."""
    symbol: str
    """Symbol in tables and figures."""
    meaning: str
    """Meaning in tables."""
    unit: str = ""
    """SI unit, or "" for a dimensionless parameter."""
    display_unit: str = "1"
    """Unit in tables."""
    display_factor: float = 1.0
    """Factor from the SI unit to the display unit."""
    logarithmic: bool = False
    """Whether the parameter is uncertain by a factor, so that its logarithm is estimated."""
    lower: float = 0.0
    """Smallest valid value."""
    upper: float = inf
    """Upper limit; valid values are less."""
    positive: bool = False
    """Whether valid values must be greater than 0."""
    gradient_name: str = ""
    """Name of the parameter's logarithm in gradients; "" if gradients use the parameter itself."""
    starts: tuple[float, ...] = ()
    """Values from which a fit starts, in the SI unit; () if a fit derives them from the beam."""

    def is_valid(self, parameter_value: float) -> bool:
        """Return whether a value is in the range of the parameter.

        Parameters
        ----------
        parameter_value
            Value in the SI unit.
        """
        return self.lower <= parameter_value < self.upper and (
            parameter_value > 0.0 or not self.positive
        )

    @property
    def range_text(self) -> str:
        """Valid range and unit, as the end of a message: "0 or more below 2 s"."""
        range_text = "any size"
        if self.lower > -inf:
            range_text = "more than 0" if self.positive else f"{self.lower:g} or more"
        if self.upper < inf:
            range_text += f" below {self.upper:g}"
        return f"{range_text} {self.unit}".rstrip()


PARAMETERS: Final[Mapping[str, Parameter]] = MappingProxyType(
    {
        definition.name: definition
        for definition in (
            Parameter("zeta", "ζ", "internal damping", "s^alpha", "1e-5 s^α", 1e5,
                      logarithmic=True, upper=1.0),
            Parameter("alpha", "α", "its order", upper=2.0),
            Parameter("gamma", "γ", "external damping", "s^lambda/m⁴", "1e-2 s^λ/m⁴", 1e2,
                      logarithmic=True),
            Parameter("lambda", "λ", "its order", upper=2.0),
            Parameter("density_over_stiffness", "ρ/EI", "density over stiffness",
                      "s²/m⁴", "1e-3 s²/m⁴", 1e3, logarithmic=True, positive=True,
                      gradient_name="ln_density_over_stiffness"),
            Parameter("bending_stiffness_n_m2", "EI", "bending stiffness", "N·m²", "N·m²",
                      logarithmic=True, positive=True, gradient_name="ln_stiffness"),
            Parameter("delay_s", "τ", "torque-channel delay", "s", "µs", 1e6, lower=-inf),
            Parameter("tool_inertia_kg_m2", "J", "tool inertia", "kg·m²", "1e-6 kg·m²", 1e6),
            Parameter("root_compliance_rad_per_nm", "κ", "compliance of the clamp",
                      "rad/(N·m)", "rad/(N·m)"),
            Parameter("tip_mass_kg", "m", "mass at the tip", "kg", "g", 1e3),
            Parameter("filter_time_constant_s", "T", "first-order filter of the torque",
                      "s", "ms", 1e3),
            Parameter("second_order_filter_time_constant_s", "T",
                      "second-order filter of the torque", "s", "ms", 1e3),
            Parameter("drag", "C_D d", "drag of the air", "m", "mm", 1e3),
            # In documents of older versions only:
            Parameter("clock_rate_difference", "ε", "difference of the clocks' rates",
                      lower=-1.0, upper=1.0),
        )
    }
)  # fmt: skip
"""Parameters of a plant by name, without the modal stiffness offsets: see `parameter_named`."""

DampingParameter = Literal["zeta", "alpha", "gamma", "lambda"]
"""Name of a parameter of the damping."""
DAMPING_PARAMETERS: Final[tuple[DampingParameter, ...]] = ("zeta", "alpha", "gamma", "lambda")
"""Names of the damping's parameters: coefficient and order of internal and of external damping."""
COEFFICIENT_OF: Final[Mapping[str, DampingParameter]] = MappingProxyType(
    {"alpha": "zeta", "lambda": "gamma"}
)
"""Map from the name of each damping order to the name of the coefficient it belongs to."""
BEAM_PARAMETERS: Final = ("density_over_stiffness", "bending_stiffness_n_m2")
"""Names of the parameters of the beam other than its damping."""
END_PARAMETERS: Final = ("tip_mass_kg", "root_compliance_rad_per_nm")
"""Names of the parameters of the beam's ends; 0 for a uniform beam on a rigid clamp."""
FILTER_PARAMETERS: Final = ("filter_time_constant_s", "second_order_filter_time_constant_s")
"""Names of the time constants of the torque channel's low-pass filters; 0 without a filter."""
LOGARITHMIC_PARAMETERS: Final = frozenset(
    name for name, definition in PARAMETERS.items() if definition.logarithmic
)
"""Names of the parameters whose logarithm is estimated."""


def parameter_named(name: str) -> Parameter:
    """Return the definition of a parameter.

    Parameters
    ----------
    name
        Key of `PARAMETERS`, or ``stiffness_offset_N`` for mode N.

    Raises
    ------
    KeyError
        If there is no parameter of that name.
    """
    mode_number = name.removeprefix(OFFSET_PREFIX)
    if mode_number != name and mode_number.isdecimal():
        return Parameter(
            name,
            f"δ{mode_number}",
            "stiffness beyond the uniform beam's",
            display_unit="%",
            display_factor=100.0,
            lower=-0.9,
            upper=10.0,
        )
    return PARAMETERS[name]


def gradient_name(name: str) -> str:
    """Return the name that gradients of the response use for a parameter or its logarithm.

    Parameters
    ----------
    name
        Name of the parameter.
    """
    definition = PARAMETERS.get(name)
    return name if definition is None else definition.gradient_name or name
