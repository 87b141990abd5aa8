"""Report of ``rigd bench``: a table, a histogram and a verdict, or a JSON document."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from math import log10

import numpy as np
import numpy.typing as npt

from rigd.bench._program import Results
from rigd.bench.measure import HELD, STALL_US, LoopMeasurement, figures
from rigd.engine.realtime import REFUSED

_NAME = 28


def report_lines(results: Results) -> Iterator[str]:
    """Yield the lines of the report.

    Parameters
    ----------
    results
        Results with at least one round, one session, and a search.
    """
    spin = f", the last {results.spin_us:g} µs of each wait busy-polled" if results.spin_us else ""
    yield (
        f"The control loop at {results.rate_hz:g} Hz, everything simulated, {results.seconds:g} s "
        f"each{spin}."
    )
    yield (
        "Real time: "
        + ", ".join(f"{name.replace('_', ' ')} {text}" for name, text in results.granted.items())
        + "."
    )
    yield f"Load of this computer before: {results.load_average[0]:.2f}."
    yield ""
    yield from _table(_rows(results))
    yield ""
    yield from _peer_lines(results)
    yield ""
    yield "Wake-up latency:"
    columns = [(one.name, one.lateness_us) for one in _rows(results)[:2]]
    yield from histogram_lines(columns)
    yield ""
    yield "Rates, with recorder:"
    yield from _search_table(results.search)
    yield ""
    yield verdict(results)


def verdict(results: Results) -> str:
    """Return a sentence on the rate that this computer can hold, and its limitation."""
    highest_hz, between_hz = results.highest_rate_hz, results.highest_rate_between_stalls_hz
    enough = f"{100 * HELD:g} % of the ticks or more"
    if highest_hz is not None:
        text = f"This computer holds {highest_hz:g} Hz: {enough}."
    else:
        best = max(results.search, key=lambda one: one.held)
        text = (
            f"This computer holds none of these rates: {best.rate_hz:g} Hz came nearest, with "
            f"{100 * best.held:.2f} % of the ticks."
        )
    if between_hz is not None and between_hz != highest_hz:
        text += (
            f" Without stalls of {STALL_US * 1e-3:g} ms and more, which affect any rate, it would "
            f"hold {between_hz:g} Hz."
        )
    refused = [name for name, text in results.granted.items() if text.startswith(REFUSED)]
    if refused:
        text += f" Not granted: {', '.join(refused).replace('_', ' ')}; rigd check says how."
    peer = results.peer
    if peer is not None and peer.held < HELD:
        text += (
            f" cyclictest alone would have missed {100 * (1 - peer.held):.2f} % at "
            f"{peer.rate_hz:g} Hz: this is due to the computer itself."
        )
    return text


def as_json(results: Results) -> dict[str, object]:
    """Return the results for a JSON document."""
    ratios = results.ratios()
    return {
        "profile": results.profile,
        "rate_hz": results.rate_hz,
        "seconds": results.seconds,
        "spin_us": results.spin_us,
        "realtime": results.granted,
        "load_average": list(results.load_average),
        "rounds": [
            {"loop": _as_dict(ours), "cyclictest": None if their is None else _as_dict(their)}
            for ours, their in results.rounds
        ],
        "ratio_to_cyclictest": None if ratios is None else {"p50": ratios[0], "p99": ratios[1]},
        "no_cyclictest": results.no_peer,
        "sessions": [_as_dict(one) for one in results.sessions],
        "rates": [_as_dict(one) for one in results.search],
        "highest_rate_hz": results.highest_rate_hz,
        "highest_rate_between_stalls_hz": results.highest_rate_between_stalls_hz,
        "verdict": verdict(results),
    }


def _rows(results: Results) -> list[LoopMeasurement]:
    peer = results.peer
    return [results.alone, *([] if peer is None else [peer]), *results.sessions]


def _table(rows: list[LoopMeasurement]) -> Iterator[str]:
    yield (
        f"{'':{_NAME}}{'wake-up latency, µs':>40}   {'execution, µs':>16}   {'missed':>7}  "
        f"{'CPU':>5}  faults"
    )
    yield (
        f"{'':{_NAME}}{'p50':>8}{'p90':>8}{'p99':>8}{'p99.9':>8}{'max':>8}   "
        f"{'p50':>8}{'p99':>8}   {'%':>7}  {'%':>5}"
    )
    for one in rows:
        late = figures(one.lateness_us)
        numbers = (late.p50, late.p90, late.p99, late.p999, late.largest)
        text = f"{one.name:{_NAME}}" + "".join(f"{number:8.0f}" for number in numbers)
        if one.work_us.size:
            work = figures(one.work_us)
            text += f"   {work.p50:8.0f}{work.p99:8.0f}"
        else:
            text += " " * 19
        text += f"   {100 * (1 - one.held):7.3f}"
        if one.cpu_percent is not None and one.page_faults is not None:
            text += f"  {one.cpu_percent:5.1f}  {one.page_faults:6d}"
        yield text


def _search_table(search: list[LoopMeasurement]) -> Iterator[str]:
    yield (
        f"{'':>10}{'held, %':>9}{'but stalls':>12}{'stalls':>8}{'late p99, µs':>14}"
        f"{'exec p99, µs':>14}{'CPU, %':>8}"
    )
    for one in sorted(search, key=lambda one: one.rate_hz):
        cpu = "" if one.cpu_percent is None else f"{one.cpu_percent:8.1f}"
        yield (
            f"{one.rate_hz:7.0f} Hz{100 * one.held:9.3f}{100 * one.held_between_stalls:12.3f}"
            f"{one.stalls:8d}{figures(one.lateness_us).p99:14.0f}"
            f"{figures(one.work_us).p99:14.0f}{cpu}"
        )


def _peer_lines(results: Results) -> Iterator[str]:
    ratios = results.ratios()
    if ratios is None:
        yield f"No cyclictest to compare with: {results.no_peer}."
        return
    yield (
        f"Wake-up latency of the loop alone over cyclictest's, same core and policy, median of "
        f"{len(results.rounds)} rounds in turn: p50 {ratios[0]:.2f}, p99 {ratios[1]:.2f}."
    )


def _as_dict(one: LoopMeasurement) -> dict[str, object]:
    return {
        "name": one.name,
        "rate_hz": one.rate_hz,
        "scheduled": one.scheduled,
        "missed": one.missed,
        "held": one.held,
        "held_between_stalls": one.held_between_stalls,
        "stalls": one.stalls,
        "lateness_us": _figures(one.lateness_us),
        "work_us": _figures(one.work_us) if one.work_us.size else None,
        "cpu_percent": one.cpu_percent,
        "page_faults": one.page_faults,
        "histogram_us": dict(
            zip((f"{edge:g}" for edge in edges_us()), counts_of(one.lateness_us), strict=True)
        ),
    }


def _figures(values: npt.NDArray[np.float64]) -> dict[str, float]:
    return asdict(figures(values))


# Histogram

_FIRST_US, _LAST_US = 1.0, 100_000.0
_STEPS = (1.0, 2.0, 5.0)
_LABEL = 18
_WIDTH = 20
_FULL = "█"


def edges_us() -> list[float]:
    """Return the edges of the bins: 0, 1, 2, 5, 10, … µs; the last bin is open."""
    decades = round(log10(_LAST_US / _FIRST_US))
    return [0.0, *(s * 10.0**d for d in range(decades) for s in _STEPS), _LAST_US]


def counts_of(delays_us: npt.NDArray[np.float64]) -> list[int]:
    """Return the number of delays in each bin."""
    found = np.searchsorted(edges_us(), delays_us, side="right") - 1
    counts: list[int] = np.bincount(found, minlength=len(edges_us())).tolist()
    return counts


def histogram_lines(columns: Sequence[tuple[str, npt.NDArray[np.float64]]]) -> list[str]:
    """Return the lines of histograms of several series of delays in µs, side by side.

    The length of a bar is the logarithm of its count, so that rare delays are visible.
    """
    counted = [counts_of(delays_us) for _, delays_us in columns]
    used = [index for index in range(len(edges_us())) if any(counts[index] for counts in counted)]
    if not used:
        return []
    longest = max(max(counts) for counts in counted)
    header = " " * (_LABEL + 3) + "".join(f"{name:<{_WIDTH + 9}}" for name, _ in columns)
    lines = [header.rstrip()]
    for index in range(used[0], used[-1] + 1):
        bars = (f"{_bar(counts[index], longest)}{counts[index]:>7}  " for counts in counted)
        lines.append(f"{_label(index):>{_LABEL}}   {''.join(bars)}".rstrip())
    return lines


def _bar(count: int, longest: int) -> str:
    length = round((_WIDTH - 1) * log10(1 + count) / log10(1 + longest))
    return f"{_FULL * max(length, int(count > 0)):<{_WIDTH}}"


def _label(index: int) -> str:
    edges = edges_us()
    if index + 1 == len(edges):
        return f"{edges[index]:.0f} µs and more"
    return f"{edges[index]:.0f}–{edges[index + 1]:.0f} µs"
