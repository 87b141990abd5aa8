"""Excitations of installed packages, as functions like those of rigd."""

import inspect
from collections.abc import Callable, Mapping
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
from rigd.plugins import Plugin, load_declaration, plugin_errors
from rigd.units import unit_of

_SEGMENT_OPTIONS: Final = ("duration_s", "rest_s", "ring_down_s")
"""Options that every excitation of a package has."""

ExcitationFunction = Callable[..., Excitation]
"""Function of the rate and the options that returns an excitation."""


def load_excitation(plugin: Plugin) -> ExcitationKind:
    """Import the excitation of a package, and check its declaration.

    Raise `PluginError` if the excitation cannot be used.
    """
    kind = load_declaration(plugin, ExcitationKind)
    with plugin_errors(plugin):
        option_names = {option.name for option in fields(kind.options)}
        missing_options = [name for name in _SEGMENT_OPTIONS if name not in option_names]
        if missing_options:
            raise plugin.error(f"its options lack {', '.join(missing_options)}; add them.")
        try:
            _checked_options(kind, {})
        except ExcitationError as error:
            raise plugin.error(f"its default {error}") from error
    return kind


@lru_cache(maxsize=64)
def plugin_excitation_function(plugin: Plugin) -> ExcitationFunction:
    """Return the function that makes a package's excitation; its arguments are the options."""
    kind = load_excitation(plugin)

    def make(*, rate_hz: float, **given_options: Any) -> Excitation:  # noqa: ANN401 - of the options
        options = _checked_options(kind, given_options)
        segments = lay_out_segments(
            rate_hz, options.rest_s, options.duration_s, options.ring_down_s
        )
        time_s = np.arange(segments["sweep"][1] - segments["sweep"][0]) / rate_hz
        with plugin_errors(plugin):
            sweep_rad = np.asarray(kind.reference_rad(options, time_s), dtype=np.float64)
        if sweep_rad.shape != time_s.shape or not np.isfinite(sweep_rad).all():
            raise plugin.error(
                f"its reference is not an array of {time_s.size} finite angles; report that to its "
                "author."
            )
        return assemble_excitation(kind.name, asdict(options), rate_hz, segments, sweep_rad)

    option_types = get_type_hints(kind.options, include_extras=True)
    keyword_only = inspect.Parameter.KEYWORD_ONLY
    rate_parameter = inspect.Parameter("rate_hz", keyword_only, annotation=float)
    make.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [rate_parameter]
        + [
            inspect.Parameter(
                option.name,
                keyword_only,
                default=option.default,
                annotation=option_types[option.name],
            )
            for option in fields(kind.options)
        ]
    )
    make.__doc__ = kind.summary
    return documented(make)


def _checked_options(kind: ExcitationKind, given_options: Mapping[str, Any]) -> Any:  # noqa: ANN401
    """Return the options with checked values; raise ExcitationError for one out of its range."""
    from pydantic import ConfigDict, TypeAdapter, ValidationError  # late: half a second

    hints = get_type_hints(kind.options, include_extras=True)
    checked_options = {}
    for option in fields(kind.options):
        option_value = given_options.get(option.name, option.default)
        validator = TypeAdapter(hints[option.name], config=ConfigDict(allow_inf_nan=False))
        try:
            checked_options[option.name] = validator.validate_python(option_value)
        except ValidationError as error:
            reason = error.errors()[0]["msg"].replace("Input should be", "must be")
            unit = f" {unit_of(option.name)}".rstrip()
            raise ExcitationError(f"{option.name} = {option_value}{unit} {reason}.") from error
    return kind.options(**checked_options)
