"""The figures of ``docs/paper_method.md``, from the results of ``bench_oddities.py``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from exact_sessions import LINK
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from analysis.report import _style as style
from rigd.beam import Damping, ResponseGrid, transfer

if TYPE_CHECKING:
    from bench_oddities import FirstPeak
    from exact_sessions import Session
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from rigd.estimates import ReportedMode
    from rigd.spectral import FrequencyResponse

    Parameters = dict[tuple[str, str], dict[str, NDArray[np.float64]]]

LINES = {
    "const": {"color": style.BLUE, "linestyle": "-"},
    "omega": {"color": style.VERMILION, "linestyle": (0, (4, 2))},
}
NAMES = {"const": "constant weights", "omega": "1/ω weights"}
TRUTH = {"color": style.INK, "linewidth": 0.9}


def weights(folder: Path, found: Parameters, made: Session) -> None:
    """Draw nominal models of types I, IV and III over the estimate they were fitted to."""
    h1 = made.noisy(0).h1()
    with style.figure_style():
        figure = style.new_figure(
            10.0, 3.9, "One ζ for three peaks",
            "types I and IV have internal damping only: constant weights fit the two higher peaks "
            "with it, 1/ω weights the first, and flatten the others",
        )  # fmt: skip
        axes = figure.subplots(1, 3, sharey=True)
        figure.subplots_adjust(0.065, 0.13, 0.985, 0.8, wspace=0.06)
        for panel, name in zip(axes, ("I", "IV", "III"), strict=True):
            panel.plot(
                *style.envelope(h1.frequency_hz, _db(h1.response), logarithmic=True),
                color=style.LIGHT_GREY, linewidth=2.4, label="Welch's estimate, one session",
            )  # fmt: skip
            texts = []
            for weighting, line in LINES.items():
                mean = {key: float(v.mean()) for key, v in found[name, weighting].items()}
                damping = Damping(mean["zeta"], mean["alpha"], mean["gamma"], mean["lambda"])
                response = transfer(2j * np.pi * h1.frequency_hz, LINK, damping)
                panel.plot(h1.frequency_hz, _db(response), label=NAMES[weighting], **line)
                texts.append((f"ζ = {_scientific(mean['zeta'])}", line["color"]))
            for row, (text, colour) in enumerate(texts):
                panel.text(0.04, 0.93 - 0.075 * row, text, color=colour, transform=panel.transAxes)
            panel.set_title(f"Type {name}")
            style.set_frequency_axis(panel, (0.6, 50.0))
            panel.set_ylim(-45, 48)
            panel.set_xlabel("Frequency (Hz)")
        axes[0].set_ylabel("Magnitude (dB re 1 N·m/rad)")
        _legend(figure, axes[0])
        _save(figure, folder / "paper_method_weights.png")


def first_peak(folder: Path, peaks: list[FirstPeak]) -> None:
    """Draw the true first peak, that of Welch's estimate, and the estimated damping."""
    shown = (0, 2, 3, 4, 5)
    colours = (style.PURPLE, style.BLUE, style.GREEN, style.ORANGE, style.VERMILION)
    with style.figure_style():
        figure = style.new_figure(
            10.0, 4.5, "The window has its own peak",
            "left: five beams of different damping; right: the damping ratio that each method "
            "finds for the first mode (one session each, torque noise 10 mN·m)",
        )  # fmt: skip
        left, right = figure.subplots(1, 2)
        figure.subplots_adjust(0.065, 0.12, 0.985, 0.79, wspace=0.16)
        fine_hz = np.linspace(2.3, 2.85, 6001)
        for index, colour in zip(shown, colours, strict=True):
            peak = peaks[index]
            true = ResponseGrid(2j * np.pi * fine_hz).evaluate(peak.plant)[0]
            left.plot(fine_hz, _db(true), color=colour, linewidth=0.9, linestyle=(0, (2, 1.5)))
            left.plot(
                peak.welch.frequency_hz, _db(peak.welch.response), color=colour, linewidth=2.0,
                label=f"{100 * peak.true_ratio:.2f} %",
            )  # fmt: skip
        left.set_xlim(2.3, 2.85)
        left.set_ylim(-8, 48)
        left.set_xlabel("Frequency (Hz)")
        left.set_ylabel("Magnitude (dB re 1 N·m/rad)")
        left.set_title("Dashed: the beam. Solid: Welch's estimate of it")
        left.legend(title="damping ratio", loc="upper left")
        true_percent = np.array([100 * peak.true_ratio for peak in peaks])
        right.plot(true_percent, true_percent, label="truth", **TRUTH)
        for weighting, line in LINES.items():
            right.plot(
                true_percent, [100 * peak.welch_ratio[weighting] for peak in peaks], marker="o",
                markersize=4, label=f"paper's route, type VI, {NAMES[weighting]}", **line,
            )  # fmt: skip
        modes = [peak.record.modes[0] for peak in peaks]
        right.errorbar(
            true_percent,
            [100 * mode.damping_ratio for mode in modes],
            [196 * mode.damping_ratio_std for mode in modes],
            fmt="D", markersize=3.5, color=style.PURPLE, linewidth=1, label="whole record",
        )  # fmt: skip
        for axis in (right.xaxis, right.yaxis):
            axis.set_minor_locator(NullLocator())
        right.set_xscale("log")
        right.set_yscale("log")
        for axis in (right.xaxis, right.yaxis):
            axis.set_major_locator(FixedLocator([0.1, 0.2, 0.5, 1, 2, 5]))
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(FuncFormatter(lambda value, _position: f"{value:g}"))
        right.set_xlabel("True damping ratio of mode 1 (%)")
        right.set_ylabel("Damping ratio found (%)")
        right.set_title("Below 1 % the paper's route finds its window")
        right.legend(loc="lower right")
        _save(figure, folder / "paper_method_first_peak.png")


def order(
    folder: Path, found: Parameters, uniform: NDArray[np.float64], modes: tuple[ReportedMode, ...]
) -> None:
    """Draw the loss factors of the estimates, and alpha session by session."""
    hz = np.geomspace(1.0, 50.0, 300)
    true = Damping(7.1e-5, 1.0, 5.5e-2, 0.594)
    with style.figure_style():
        figure = style.new_figure(
            10.0, 4.0, "Three stiffness offsets, read as a fractional order",
            f"{uniform.size} sessions of a beam with α = 1 whose modes are +0.6, +0.5 and −1.3 % "
            "off in stiffness; left: type VI on a uniform beam, right: also the modes found",
        )  # fmt: skip
        left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
        figure.subplots_adjust(0.125, 0.125, 0.985, 0.81, wspace=0.15)
        rows = [
            ("paper's route,\nconstant weights", found["VI", "const"]["alpha"], style.BLUE),
            ("paper's route,\n1/ω weights", found["VI", "omega"]["alpha"], style.VERMILION),
            ("whole record\n(refused there)", uniform, style.GREEN),
        ]
        for height, (_, alphas, colour) in enumerate(reversed(rows)):
            jitter = np.linspace(-0.18, 0.18, alphas.size)
            left.plot(alphas, height + jitter, "o", color=colour, markersize=3.5, alpha=0.7)
        left.axvline(1.0, zorder=0, **TRUTH)
        for name, x in (("Table 3, const", 1.362), ("Table 3, ω", 0.996)):
            left.plot(x, 2.42, "v", color=style.GREY, markersize=6, clip_on=False)
            left.annotate(
                name, (x, 2.42), (0, 7), textcoords="offset points", ha="center", fontsize=7.5,
                color=style.GREY,
            )  # fmt: skip
        left.set_yticks(range(3), [name for name, *_ in reversed(rows)])
        left.set_ylim(-0.5, 2.75)
        left.set_xlim(0.85, 1.6)
        left.set_xlabel("Order of the internal damping, α")
        left.grid(axis="y", visible=False)
        right.plot(hz, 100 * _loss(true, hz), label="truth", zorder=5, **TRUTH)
        for weighting, line in LINES.items():
            values = found["VI", weighting]
            for k in range(values["alpha"].size):
                each = {key: float(v[k]) for key, v in values.items()}
                damping = Damping(each["zeta"], each["alpha"], each["gamma"], each["lambda"])
                right.plot(
                    hz, 100 * _loss(damping, hz), linewidth=0.8,
                    label=f"paper's route, {NAMES[weighting]}" if k == 0 else None, **line,
                )  # fmt: skip
        right.errorbar(
            [mode.frequency_hz.value for mode in modes],
            [200 * mode.damping_ratio.value for mode in modes],
            [2 * 196 * (mode.damping_ratio.std or 0.0) for mode in modes],
            fmt="D", markersize=4, color=style.GREEN, linewidth=1.2, zorder=6,
            label="whole record, twice the damping ratio",
        )  # fmt: skip
        for mode, mark in enumerate(np.array([16.045, 100.55, 281.55]) / (2 * np.pi), start=1):
            right.axvline(mark, color=style.LIGHT_GREY, linewidth=0.8, zorder=0)
            right.text(mark, 6.6, f"mode {mode}", ha="center", fontsize=7.5, color=style.GREY)
        style.set_frequency_axis(right, (1.0, 50.0))
        right.set_ylim(0, 7)
        right.set_xlabel("Frequency (Hz)")
        right.set_ylabel("Loss factor (%)")
        right.legend(loc="upper right", bbox_to_anchor=(1.0, 0.93))
        _save(figure, folder / "paper_method_order.png")


def segments(folder: Path, estimates: dict[int, FrequencyResponse]) -> None:
    """Draw the part of the sweep in the segments, and the resulting third peak."""
    with style.figure_style():
        figure = style.new_figure(
            10.0, 3.9, "Five samples short",
            "15 % overlap rounded up (2590 samples) and rounded down (2589): then an eighth "
            "segment would end 5 samples after the sweep",
        )  # fmt: skip
        left, right = figure.subplots(1, 2)
        figure.subplots_adjust(0.085, 0.13, 0.98, 0.81, wspace=0.16)
        colours = dict(zip(estimates, (style.BLUE, style.VERMILION), strict=True))
        for height, (overlap, estimate) in enumerate(reversed(estimates.items())):
            for k in range(estimate.segments):
                start = k * (17_266 - overlap) / 1000
                left.barh(
                    height + (0.16 if k % 2 else -0.16), 17.266, 0.28, start,
                    color=colours[overlap], alpha=0.75, linewidth=0,
                )  # fmt: skip
        for mode, hertz in enumerate((2.554, 16.00, 44.81), start=1):
            at_s = (hertz - 0.05) / (50 - 0.05) * 120
            left.axvline(at_s, color=style.INK, linewidth=0.9)
            left.text(at_s + 1, 1.62, f"mode {mode}", fontsize=7.5, color=style.INK)
        left.set_yticks((1, 0), ["2590:\n8 segments", "2589:\n7 segments"])
        left.set_ylim(-0.6, 1.85)
        left.set_xlim(0, 120)
        left.set_xlabel("Time in the sweep (s)")
        left.grid(axis="y", visible=False)
        for overlap, estimate in reversed(estimates.items()):
            part = estimate.band(30.0, 50.0)
            right.plot(
                part.frequency_hz, _db(part.response), color=colours[overlap],
                linewidth=1.4 if overlap == max(estimates) else 0.8, label=f"overlap {overlap}",
            )  # fmt: skip
        hz = np.linspace(30, 50, 2000)
        right.plot(
            hz, _db(transfer(2j * np.pi * hz, LINK, Damping(7.1e-5, 1.0, 5.5e-2, 0.594))),
            label="truth", linestyle=(0, (3, 2)), **TRUTH,
        )  # fmt: skip
        right.set_xlim(30, 50)
        right.set_xticks(range(30, 51, 5))
        right.set_xlabel("Frequency (Hz)")
        right.set_ylabel("Magnitude (dB re 1 N·m/rad)")
        right.legend(loc="upper left")
        _save(figure, folder / "paper_method_segments.png")


def _loss(damping: Damping, hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the loss factor of stiffness and inertia together."""
    s = 2j * np.pi * hz
    internal = 1 + damping.zeta * s**damping.alpha
    external = LINK.density_over_stiffness * s**2 + damping.gamma * s**damping.lambda_
    return np.asarray(
        internal.imag / internal.real + external.imag / -external.real, dtype=np.float64
    )


def _db(response: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.asarray(20 * np.log10(np.abs(response)), dtype=np.float64)


def _scientific(value: float) -> str:
    mantissa, power = f"{value:.2e}".split("e")
    digits = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}·10{digits}"


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=3, bbox_to_anchor=(0.99, 0.995))


def _save(figure: Figure, path: Path) -> None:
    path.unlink(missing_ok=True)
    style.save_figure(figure, path)
    print(f"wrote {path}")
