"""What was computed last: a descent ends at one of the last points that it looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

_Value = TypeVar("_Value")

_KEPT: Final = 2
"""The last step of a descent may have been taken back."""


class Recent(Generic[_Value]):
    """Values at the last two points, for an objective that is asked for them again.

    Covariances are asked for where a descent ended, and the next one begins there.
    """

    __slots__ = ("_values",)

    def __init__(self) -> None:
        self._values: dict[bytes, _Value] = {}

    def at(
        self, x: NDArray[np.float64], compute: Callable[[NDArray[np.float64]], _Value]
    ) -> _Value:
        """Value at `x`, computed if it is not one of the last."""
        key = x.tobytes()
        if key not in self._values:
            if len(self._values) == _KEPT:
                del self._values[next(iter(self._values))]
            self._values[key] = compute(x)
        return self._values[key]
