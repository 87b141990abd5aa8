"""The model structures: which damping parameters are fitted and which stay fixed.

Types I to VI with the fixed values of the paper's Table 2. Type VII is the one its conclusions
point to: internal damping of integer order (alpha = 1) with external damping of fractional order.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, Literal

from rigd.beam import Damping

Parameter = Literal["zeta", "alpha", "gamma", "lambda"]
PARAMETERS: Final[tuple[Parameter, ...]] = ("zeta", "alpha", "gamma", "lambda")
COEFFICIENT_OF: Final[Mapping[str, Parameter]] = MappingProxyType(
    {"alpha": "zeta", "lambda": "gamma"}
)
"""The coefficient that belongs to an order of the damping, and means nothing without it."""


@dataclass(frozen=True, slots=True)
class Structure:
    """One choice of free and fixed damping parameters.

    Attributes
    ----------
    name : str
        "I" to "VII".
    free : tuple of str
        Parameters to be fitted, in the order of `PARAMETERS`.
    fixed : mapping of str to float
        The others with their values. An order of 0 belongs to a coefficient of 0: absent damping.
    """

    name: str
    free: tuple[Parameter, ...]
    fixed: Mapping[Parameter, float]

    @property
    def internal(self) -> bool:
        """Whether the structure has internal damping (of the material)."""
        return "zeta" in self.free

    @property
    def external(self) -> bool:
        """Whether the structure has external damping (of the environment)."""
        return "gamma" in self.free

    def has(self, name: str) -> bool:
        """Whether a parameter means anything in the structure: of a beam or a rig any does.

        Parameters
        ----------
        name : str
            Of `PARAMETERS`, or of beam and rig.
        """
        if name in ("zeta", "alpha"):
            return self.internal
        if name in ("gamma", "lambda"):
            return self.external
        return True

    def damping(self, values: Mapping[Parameter, float]) -> Damping:
        """Complete the free parameters' `values` with the fixed ones."""
        every = {**self.fixed, **{name: values[name] for name in self.free}}
        return Damping(
            zeta=every["zeta"],
            alpha=every["alpha"],
            gamma=every["gamma"],
            lambda_=every["lambda"],
        )


def _structure(name: str, fixed: dict[Parameter, float]) -> Structure:
    free = tuple(p for p in PARAMETERS if p not in fixed)
    return Structure(name, free, MappingProxyType(fixed))


STRUCTURES: Final[Mapping[str, Structure]] = MappingProxyType(
    {
        structure.name: structure
        for structure in (
            _structure("I", {"alpha": 1.0, "gamma": 0.0, "lambda": 0.0}),
            _structure("II", {"zeta": 0.0, "alpha": 0.0, "lambda": 1.0}),
            _structure("III", {"alpha": 1.0, "lambda": 1.0}),
            _structure("IV", {"gamma": 0.0, "lambda": 0.0}),
            _structure("V", {"zeta": 0.0, "alpha": 0.0}),
            _structure("VI", {}),
            _structure("VII", {"alpha": 1.0}),
        )
    }
)
