"""Command line options of the frequency response estimate and of the Welch fits."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Final, TypeVar, get_args

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.models import WelchSettings

_MAX_NFFT_SAMPLES: Final = 2**22
"""Longest FFT in samples, which takes seconds and a few 100 MB; the paper's is 26 times shorter."""


_ChoiceName = TypeVar("_ChoiceName", bound=str)
"""Type of the names among which an option chooses."""

Band = Annotated[
    str | None,
    typer.Option(
        metavar="F0,F1",
        help="Band of the fits (Hz).  [default: 0,50; of Welch fits 0.5875,50; at most 0.4 of the "
        "record's rate]",
    ),
]
"""Option --band: frequency band of the fits."""
Estimator = Annotated[
    str,
    typer.Option(
        metavar="h1|h2|hv|iv|fft",
        help="Estimator of the response: Welch's H1, H2 or Hv; iv: instrumental variable, with the "
        "reference as instrument (no bias from fed-back noise); fft: one FFT of the whole record.",
    ),
]
"""Option --frf: estimator of the frequency response."""
Segment = Annotated[
    int | None,
    typer.Option(
        metavar="SAMPLES", min=2, help="Welch segment.  [default: 17.266 s, as in the paper]"
    ),
]
"""Option --segment: length of a Welch segment."""
Overlap = Annotated[
    int | None,
    typer.Option(
        metavar="SAMPLES", min=0, help="Overlap of segments.  [default: 15 % of the segment]"
    ),
]
"""Option --overlap: overlap of Welch segments."""
Nfft = Annotated[
    int | None,
    typer.Option(
        metavar="SAMPLES", min=2, max=_MAX_NFFT_SAMPLES, help="FFT length.  [default: 160 s]"
    ),
]
"""Option --nfft: length of the FFT."""


def welch_settings(
    types: str,
    weights: str,
    frf: str,
    segment: int | None,
    overlap: int | None,
    nfft: int | None,
) -> WelchSettings:
    """Return the Welch settings from the options' texts; raise a usage error for invalid ones.

    The band is the default one, because `analysis.applicability` chooses a band for each record.
    """
    from analysis.models import WelchSettings
    from rigd.spectral import Estimator as FrfEstimator

    if segment is not None and overlap is not None and overlap >= segment:
        raise typer.BadParameter(
            f"{overlap} samples must be fewer than those of a segment, {segment}.",
            param_hint="--overlap",
        )
    if segment is not None and nfft is not None and nfft < segment:
        raise typer.BadParameter(
            f"{nfft} samples must be no fewer than those of a segment, {segment}.",
            param_hint="--nfft",
        )
    return WelchSettings(
        estimator=parse_option_choice(frf, get_args(FrfEstimator), "--frf"),
        segment_length=segment,
        overlap=overlap,
        nfft=nfft,
        types=_parse_types(types),
        weightings=_parse_weightings(weights),
    )


def parse_option_choice(
    option_text: str, choices: Sequence[_ChoiceName], option_name: str
) -> _ChoiceName:
    """Return the choice that a text names, ignoring case; raise a usage error if it names none."""
    for candidate in choices:
        if candidate == option_text.lower():
            return candidate
    raise typer.BadParameter(
        f"there is no '{option_text}'; choose from {', '.join(choices)}.", param_hint=option_name
    )


def band_hz(option_text: str | None) -> tuple[float, float] | None:
    """Return the band in Hz stated by --band, or None without it; raise if invalid."""
    if option_text is None:
        return None
    try:
        low_hz, high_hz = (float(frequency_text) for frequency_text in option_text.split(","))
    except ValueError:
        low_hz = high_hz = math.nan
    if not 0.0 <= low_hz < high_hz < math.inf:
        raise typer.BadParameter(
            f"'{option_text}' is not two frequencies in Hz with 0 <= F0 < F1, such as 0.5875,50.",
            param_hint="--band",
        )
    return low_hz, high_hz


def _parse_types(option_text: str) -> tuple[str, ...]:
    """Return the model types named in --types; raise a usage error if one is unknown."""
    from analysis.models import STRUCTURES

    type_names = _split_list(option_text.upper())
    unknown_types = [type_name for type_name in type_names if type_name not in STRUCTURES]
    if unknown_types or not type_names:
        raise typer.BadParameter(
            f"there is no model type '{(unknown_types or [option_text])[0]}'; "
            f"choose from {', '.join(STRUCTURES)}.",
            param_hint="--types",
        )
    return type_names


def _parse_weightings(option_text: str) -> tuple[str, ...]:
    """Return the weightings named in --weights; raise a usage error if one is unknown."""
    from analysis.models import WeightingError, weighting_name

    try:
        weighting_names = tuple(
            weighting_name(listed_name) for listed_name in _split_list(option_text)
        )
    except WeightingError as error:
        raise typer.BadParameter(str(error), param_hint="--weights") from error
    if not weighting_names:
        raise typer.BadParameter(
            "no weighting was named; choose from const, omega, omega^K.", param_hint="--weights"
        )
    return weighting_names


def _split_list(list_text: str) -> tuple[str, ...]:
    """Return the names in a comma-separated list in their order, each once."""
    return tuple(
        dict.fromkeys(
            list_entry.strip() for list_entry in list_text.split(",") if list_entry.strip()
        )
    )
