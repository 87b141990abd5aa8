"""Excitations of installed packages, as functions like those of rigd."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, fields
from functools import lru_cache
from typing import Any, Final, get_type_hints

import numpy as np

from rigd.excitation._options import documented
from rigd.excitation._signals import (
    Excitation,
    ExcitationError,
    assemble_excitation,
    lay_out_segments,
)
from rigd.excitation.declaration import ExcitationKind
from rigd.plugins import (
    Plugin,
    PluginError,
    find_plugin,
    installed_plugins,
    load_declaration,
    plugin_errors,
    refuse_built_in,
)
from rigd.units import unit_of

EXCITATION_GROUP: Final = "rigd.excitations"
"""Group of the entry points by which packages add excitations."""
_SEGMENT_OPTIONS = ("duration_s", "rest_s", "ring_down_s")
"""Options that every excitation of a package has."""

MakeExcitation = Callable[..., Excitation]
"""Function that returns an excitation, of the rate and its options."""


class ExcitationKinds(Mapping[str, MakeExcitation]):
    """Functions that return an excitation, by name: those of rigd, then those of packages.

    Parameters
    ----------
    shipped
        Functions of rigd, which no package can replace.
    """

    def __init__(self, shipped: Mapping[str, MakeExcitation]) -> None:
        self._shipped = shipped

    def __getitem__(self, name: str) -> MakeExcitation:
        """Return the function of a name; raise PluginError if its package cannot be used."""
        if name in self._shipped:
            return self._shipped[name]
        plugin = find_plugin(EXCITATION_GROUP, name)
        if plugin is None:
            raise KeyError(name)
        return added_function(plugin)

    def __iter__(self) -> Iterator[str]:
        """Yield the names; those of packages that cannot be used are left out."""
        yield from self._shipped
        for plugin in installed_plugins(EXCITATION_GROUP):
            try:
                load_excitation(plugin)
            except PluginError:
                continue
            if plugin.name not in self._shipped:
                yield plugin.name

    def __len__(self) -> int:
        """Return the number of names."""
        return sum(1 for _ in self)

    def find_added(self, name: str) -> tuple[ExcitationKind, Plugin] | None:
        """Return the excitation of a name that a package adds, with the package; else None.

        Raises
        ------
        PluginError
            If the package cannot be used.
        """
        if name in self._shipped:
            return None
        plugin = find_plugin(EXCITATION_GROUP, name)
        return None if plugin is None else (load_excitation(plugin), plugin)

    def check_plugin(self, plugin: Plugin) -> str:
        """Import the excitation of a package, and return its summary.

        Raises
        ------
        PluginError
            If it cannot be used.
        """
        refuse_built_in(plugin, self._shipped)
        added_function(plugin)
        return load_excitation(plugin).summary


def load_excitation(plugin: Plugin) -> ExcitationKind:
    """Import the excitation of a package, and check its declaration.

    Raises
    ------
    PluginError
        If it cannot be used.
    """
    kind = load_declaration(plugin, ExcitationKind)
    with plugin_errors(plugin):
        options = {option.name for option in fields(kind.options)}
        missing = [name for name in _SEGMENT_OPTIONS if name not in options]
        if missing:
            raise plugin.error(f"its options lack {', '.join(missing)}; add them.")
        try:
            _checked_options(kind, {})
        except ExcitationError as error:
            raise plugin.error(f"its default {error}") from error
    return kind


@lru_cache(maxsize=64)
def added_function(plugin: Plugin) -> MakeExcitation:
    """Return a function with the options of a package's excitation as its arguments."""
    kind = load_excitation(plugin)

    def make(*, rate_hz: float, **given: Any) -> Excitation:  # noqa: ANN401 - of the options
        options = _checked_options(kind, given)
        segments = lay_out_segments(
            rate_hz, options.rest_s, options.duration_s, options.ring_down_s
        )
        time_s = np.arange(segments["sweep"][1] - segments["sweep"][0]) / rate_hz
        with plugin_errors(plugin):
            sweep_rad = np.asarray(kind.reference_rad(options, time_s), dtype=np.float64)
        if sweep_rad.shape != time_s.shape or not np.isfinite(sweep_rad).all():
            raise plugin.error(
                f"its reference is no {time_s.size} finite angles; report that to its author."
            )
        return assemble_excitation(kind.name, asdict(options), rate_hz, segments, sweep_rad)

    hints = get_type_hints(kind.options, include_extras=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    rate = inspect.Parameter("rate_hz", keyword, annotation=float)
    make.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [rate]
        + [
            inspect.Parameter(
                option.name, keyword, default=option.default, annotation=hints[option.name]
            )
            for option in fields(kind.options)
        ]
    )
    make.__doc__ = kind.summary
    return documented(make)


def _checked_options(kind: ExcitationKind, given: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return the options with checked values; raise ExcitationError for one out of its range."""
    from pydantic import ConfigDict, TypeAdapter, ValidationError  # late: half a second

    hints = get_type_hints(kind.options, include_extras=True)
    checked = {}
    for option in fields(kind.options):
        value = given.get(option.name, option.default)
        validator = TypeAdapter(hints[option.name], config=ConfigDict(allow_inf_nan=False))
        try:
            checked[option.name] = validator.validate_python(value)
        except ValidationError as error:
            reason = error.errors()[0]["msg"].replace("Input should be", "must be")
            unit = f" {unit_of(option.name)}".rstrip()
            raise ExcitationError(f"{option.name} = {value}{unit} {reason}.") from error
    return kind.options(**checked)
