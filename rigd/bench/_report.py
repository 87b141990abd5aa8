"""Report of ``rigd bench``: a table, a histogram and a verdict, or a JSON document."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from math import log10

import numpy as np
import numpy.typing as npt

from rigd.bench._program import BenchResults
from rigd.bench.measure import MIN_HELD_FRACTION, MIN_STALL_US, LoopMeasurement, percentiles
from rigd.engine.realtime import REFUSED_PREFIX

_NAME_COLUMN_WIDTH = 28
"""Width of the column with the measurements' names, in characters."""


def report_lines(results: BenchResults) -> Iterator[str]:
    """Yield the lines of the report on all measurements.

    Parameters
    ----------
    results
        Results with at least one round, one session, and a search.

    Yields
    ------
    str
        Line of text.
    """
    spin_text = (
        f", the last {results.spin_us:g} µs of each wait busy-polled" if results.spin_us else ""
    )
    yield (
        f"The control loop at {results.rate_hz:g} Hz, everything simulated, "
        f"{results.measurement_duration_s:g} s "
        f"each{spin_text}."
    )
    yield (
        "Real time: "
        + ", ".join(
            f"{setting_name.replace('_', ' ')} {setting_text}"
            for setting_name, setting_text in results.granted_settings.items()
        )
        + "."
    )
    yield f"Load of this computer before: {results.load_average[0]:.2f}."
    yield ""
    yield from _latency_table(_measurements(results))
    yield ""
    yield from _cyclictest_lines(results)
    yield ""
    yield "Wake-up latency:"
    histogram_columns = [
        (loop_measurement.name, loop_measurement.latencies_us)
        for loop_measurement in _measurements(results)[:2]
    ]
    yield from histogram_lines(histogram_columns)
    yield ""
    yield "Rates, with recorder:"
    yield from _rate_table(results.search_measurements)
    yield ""
    yield verdict(results)


def verdict(results: BenchResults) -> str:
    """Return sentences on the rate that this computer held, and on what limits it.

    With real devices it is lower, because a tick then waits for their replies.
    """
    highest_hz, between_stalls_hz = (
        results.highest_rate_hz,
        results.highest_rate_between_stalls_hz,
    )
    criterion_text = f"{100 * MIN_HELD_FRACTION:g} % of the ticks or more"
    if highest_hz is not None:
        verdict_text = f"Simulated devices: this computer held {highest_hz:g} Hz, {criterion_text}."
    else:
        best_measurement = max(
            results.search_measurements, key=lambda measurement: measurement.held_fraction
        )
        verdict_text = (
            "Simulated devices: this computer held none of these rates. "
            f"{best_measurement.rate_hz:g} Hz came nearest, with "
            f"{100 * best_measurement.held_fraction:.2f} % of the ticks."
        )
    if between_stalls_hz is not None and between_stalls_hz != highest_hz:
        verdict_text += (
            f" Without stalls of {MIN_STALL_US * 1e-3:g} ms and more, which affect any rate, it "
            f"would have held {between_stalls_hz:g} Hz."
        )
    refused_setting_names = [
        setting_name
        for setting_name, setting_text in results.granted_settings.items()
        if setting_text.startswith(REFUSED_PREFIX)
    ]
    if refused_setting_names:
        verdict_text += (
            f" Not granted: {', '.join(refused_setting_names).replace('_', ' ')}; "
            "rigd check says how."
        )
    cyclictest_result = results.cyclictest_measurement
    if cyclictest_result is not None and cyclictest_result.held_fraction < MIN_HELD_FRACTION:
        verdict_text += (
            " cyclictest alone would have missed "
            f"{100 * (1 - cyclictest_result.held_fraction):.2f} % at "
            f"{cyclictest_result.rate_hz:g} Hz: this is due to the computer itself."
        )
    return verdict_text


def as_json(results: BenchResults) -> dict[str, object]:
    """Return the results as a JSON document."""
    latency_ratios = results.latency_ratios()
    return {
        "profile": results.profile_name,
        "rate_hz": results.rate_hz,
        "seconds": results.measurement_duration_s,
        "spin_us": results.spin_us,
        "realtime": results.granted_settings,
        "load_average": list(results.load_average),
        "rounds": [
            {"loop": _as_dict(loop_alone), "cyclictest": None if peer is None else _as_dict(peer)}
            for loop_alone, peer in results.rounds
        ],
        "ratio_to_cyclictest": None
        if latency_ratios is None
        else {"p50": latency_ratios[0], "p99": latency_ratios[1]},
        "no_cyclictest": results.missing_cyclictest_reason,
        "sessions": [_as_dict(measurement) for measurement in results.session_measurements],
        "rates": [_as_dict(measurement) for measurement in results.search_measurements],
        "highest_rate_hz": results.highest_rate_hz,
        "highest_rate_between_stalls_hz": results.highest_rate_between_stalls_hz,
        "verdict": verdict(results),
    }


def _measurements(results: BenchResults) -> list[LoopMeasurement]:
    """Return the measurements in the order of the report's table."""
    cyclictest_result = results.cyclictest_measurement
    return [
        results.pooled_loop_measurement,
        *([] if cyclictest_result is None else [cyclictest_result]),
        *results.session_measurements,
    ]


def _latency_table(measurements: list[LoopMeasurement]) -> Iterator[str]:
    """Yield the lines of the report's table of wake-up latencies and execution times in µs."""
    yield (
        f"{'':{_NAME_COLUMN_WIDTH}}{'wake-up latency, µs':>40}   {'execution, µs':>16}   "
        f"{'missed':>7}  "
        f"{'CPU':>5}  faults"
    )
    yield (
        f"{'':{_NAME_COLUMN_WIDTH}}{'p50':>8}{'p90':>8}{'p99':>8}{'p99.9':>8}{'max':>8}   "
        f"{'p50':>8}{'p99':>8}   {'%':>7}  {'%':>5}"
    )
    for measurement in measurements:
        latency_percentiles = percentiles(measurement.latencies_us)
        shown_percentiles_us = (
            latency_percentiles.p50,
            latency_percentiles.p90,
            latency_percentiles.p99,
            latency_percentiles.p999,
            latency_percentiles.largest,
        )
        row_text = f"{measurement.name:{_NAME_COLUMN_WIDTH}}" + "".join(
            f"{percentile_us:8.0f}" for percentile_us in shown_percentiles_us
        )
        if measurement.execution_times_us.size:
            execution_percentiles = percentiles(measurement.execution_times_us)
            row_text += f"   {execution_percentiles.p50:8.0f}{execution_percentiles.p99:8.0f}"
        else:
            row_text += " " * 19
        row_text += f"   {100 * (1 - measurement.held_fraction):7.3f}"
        if measurement.cpu_percent is not None and measurement.page_faults is not None:
            row_text += f"  {measurement.cpu_percent:5.1f}  {measurement.page_faults:6d}"
        yield row_text


def _rate_table(search_measurements: list[LoopMeasurement]) -> Iterator[str]:
    """Yield the lines of the table of all rates at which the loop was measured."""
    yield (
        f"{'':>10}{'held, %':>9}{'but stalls':>12}{'stalls':>8}{'late p99, µs':>14}"
        f"{'exec p99, µs':>14}{'CPU, %':>8}"
    )
    for measurement in sorted(search_measurements, key=lambda measurement: measurement.rate_hz):
        cpu_text = "" if measurement.cpu_percent is None else f"{measurement.cpu_percent:8.1f}"
        yield (
            f"{measurement.rate_hz:7.0f} "
            f"Hz{100 * measurement.held_fraction:9.3f}"
            f"{100 * measurement.held_fraction_between_stalls:12.3f}"
            f"{measurement.stall_count:8d}{percentiles(measurement.latencies_us).p99:14.0f}"
            f"{percentiles(measurement.execution_times_us).p99:14.0f}{cpu_text}"
        )


def _cyclictest_lines(results: BenchResults) -> Iterator[str]:
    """Yield the line that compares the loop with cyclictest."""
    latency_ratios = results.latency_ratios()
    if latency_ratios is None:
        yield f"No cyclictest to compare with: {results.missing_cyclictest_reason}."
        return
    yield (
        f"Wake-up latency of the loop alone over cyclictest's, same core and policy, median of "
        f"{len(results.rounds)} rounds in turn: p50 {latency_ratios[0]:.2f}, p99 "
        f"{latency_ratios[1]:.2f}."
    )


def _as_dict(measurement: LoopMeasurement) -> dict[str, object]:
    """Return a measurement as a JSON object."""
    return {
        "name": measurement.name,
        "rate_hz": measurement.rate_hz,
        "scheduled": measurement.scheduled_ticks,
        "missed": measurement.missed_ticks,
        "held": measurement.held_fraction,
        "held_between_stalls": measurement.held_fraction_between_stalls,
        "stalls": measurement.stall_count,
        "lateness_us": _percentiles_object(measurement.latencies_us),
        "work_us": _percentiles_object(measurement.execution_times_us)
        if measurement.execution_times_us.size
        else None,
        "cpu_percent": measurement.cpu_percent,
        "page_faults": measurement.page_faults,
        "histogram_us": dict(
            zip(
                (f"{edge_us:g}" for edge_us in histogram_edges_us()),
                histogram_counts(measurement.latencies_us),
                strict=True,
            )
        ),
    }


def _percentiles_object(delays_us: npt.NDArray[np.float64]) -> dict[str, float]:
    """Return the percentiles of some delays in µs as a JSON object."""
    return asdict(percentiles(delays_us))


# Histogram

_FIRST_EDGE_US, _LAST_EDGE_US = 1.0, 100_000.0
"""Lowest edge above 0 and highest edge of the histogram's bins, in µs."""
_DECADE_STEPS = (1.0, 2.0, 5.0)
"""Edges of the histogram's bins within a decade, relative to the beginning of the decade."""
_BIN_LABEL_WIDTH = 18
"""Width of the bins' labels in characters."""
_MAX_BAR_WIDTH = 20
"""Width of the longest bar in characters."""
_BAR_CHARACTER = "█"
"""Character of which bars consist."""


def histogram_edges_us() -> list[float]:
    """Return the lower edges of the histogram's bins in µs.

    They are 0, 1, 2, 5, 10, …, 100 000; the last bin has no upper edge.
    """
    decade_count = round(log10(_LAST_EDGE_US / _FIRST_EDGE_US))
    return [0.0, *(s * 10.0**d for d in range(decade_count) for s in _DECADE_STEPS), _LAST_EDGE_US]


def histogram_counts(delays_us: npt.NDArray[np.float64]) -> list[int]:
    """Return how many delays in µs are in each bin of the histogram."""
    bin_indices = np.searchsorted(histogram_edges_us(), delays_us, side="right") - 1
    bin_counts: list[int] = np.bincount(bin_indices, minlength=len(histogram_edges_us())).tolist()
    return bin_counts


def histogram_lines(histogram_columns: Sequence[tuple[str, npt.NDArray[np.float64]]]) -> list[str]:
    """Return the lines of text with the histograms of several series of delays, side by side.

    Each column has a series' name and its delays in µs. The length of a bar is proportional to the
    logarithm of its count, so that rare delays are visible.
    """
    counts_by_column = [histogram_counts(delays_us) for _, delays_us in histogram_columns]
    used_bin_numbers = [
        bin_no
        for bin_no in range(len(histogram_edges_us()))
        if any(bin_totals[bin_no] for bin_totals in counts_by_column)
    ]
    if not used_bin_numbers:
        return []
    largest_bin_count = max(max(bin_totals) for bin_totals in counts_by_column)
    header_line = " " * (_BIN_LABEL_WIDTH + 3) + "".join(
        f"{column_title:<{_MAX_BAR_WIDTH + 9}}" for column_title, _ in histogram_columns
    )
    text_lines = [header_line.rstrip()]
    for bin_no in range(used_bin_numbers[0], used_bin_numbers[-1] + 1):
        bars_text = (
            f"{_histogram_bar(bin_totals[bin_no], largest_bin_count)}{bin_totals[bin_no]:>7}  "
            for bin_totals in counts_by_column
        )
        text_lines.append(
            f"{_bin_label(bin_no):>{_BIN_LABEL_WIDTH}}   {''.join(bars_text)}".rstrip()
        )
    return text_lines


def _histogram_bar(bin_count: int, largest_bin_count: int) -> str:
    """Return the bar of a bin; `largest_bin_count` is the count of the longest bar."""
    bar_length = round((_MAX_BAR_WIDTH - 1) * log10(1 + bin_count) / log10(1 + largest_bin_count))
    return f"{_BAR_CHARACTER * bar_length:<{_MAX_BAR_WIDTH}}"


def _bin_label(bin_index: int) -> str:
    """Return the label of a bin with its edges."""
    bin_edges_us = histogram_edges_us()
    if bin_index + 1 == len(bin_edges_us):
        return f"{bin_edges_us[bin_index]:.0f} µs and more"
    return f"{bin_edges_us[bin_index]:.0f}–{bin_edges_us[bin_index + 1]:.0f} µs"
