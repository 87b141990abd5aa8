"""Arrays become a session file, by the writer that the rig's recorder uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rigd.session import SAMPLE_TYPES, SAMPLE_WIRE_DTYPE, SessionWriter, field_tag

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

_BLOCK: Final = 25_000
"""Samples that are packed at a time."""


def write_session(
    path: Path,
    samples: Mapping[str, NDArray[np.generic]],
    rate_hz: float,
    start_utc_ns: int,
    metadata: Mapping[str, str],
    segments: Mapping[str, tuple[int, int]],
    warnings: Sequence[str],
) -> None:
    """Write a session that was recorded elsewhere.

    How it ended is not known, so the outcome has the counts and nothing else. If it cannot be
    written, nothing is left behind.

    Parameters
    ----------
    path : Path
        Its final name, which must not exist.
    samples : mapping of str to ndarray, shape (n,)
        Fields of a sample, ``tick`` among them; those that are absent are 0.
    rate_hz, start_utc_ns, metadata, segments
        As the format has them (docs/session_format.md).
    warnings : sequence of str
        Written as events.

    Raises
    ------
    rigd.session.SessionError
        If the file exists or cannot be written.
    """
    ticks = samples["tick"]
    writer = SessionWriter(path)
    try:
        writer.begin(start_utc_ns, metadata, segments, {})
        for warning in warnings:
            writer.log(0, "warning", warning, "import")
        for begin in range(0, len(ticks), _BLOCK):
            part = slice(begin, begin + _BLOCK)
            block = _packed({name: values[part] for name, values in samples.items()}, rate_hz)
            writer.write_samples(block.tobytes())
        scheduled = int(ticks[-1]) + 1
        counts = {"scheduled": scheduled, "recorded": len(ticks), "missed": 0}
        counts["lost"] = scheduled - len(ticks)
        writer.close({name: str(count) for name, count in counts.items()})
    except BaseException:
        # Unlike a recording, the source is still there: an incomplete copy of it is useless.
        writer.abandon()
        writer.part.unlink(missing_ok=True)
        raise


def _packed(samples: Mapping[str, NDArray[np.generic]], rate_hz: float) -> NDArray[np.void]:
    """Pack samples into the fixed layout (n,)."""
    wire = np.zeros(len(samples["tick"]), SAMPLE_WIRE_DTYPE)
    for number, (name, kind) in enumerate(SAMPLE_TYPES.items(), start=1):
        wire[f"tag_{name}"] = field_tag(number, kind)
        if name in samples:
            wire[name] = samples[name]
    wire["t_ns"] = np.rint(wire["tick"] * (1e9 / rate_hz))
    return wire
