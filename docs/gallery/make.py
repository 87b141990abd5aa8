"""Draw the gallery of faults: what each does to a record, and what the report says of it.

Usage: python docs/gallery/make.py [FOLDER] [--only NAME …]

Every record is a session of the simulated rig in which one thing is wrong. Some faults are of the
simulated rig itself; others are made in the samples of a sound session, as a wrong setting or a
damaged signal would make them. For each, the script draws the response and the residual over
frequency and time, and quotes on the page (``docs/fault_gallery.md``) what `analyze` says. With
FOLDER, pictures and page go there. The whole takes three minutes of a processor.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from analysis import frf, load, select
from analysis.record import Record
from rigd.session import read_session
from rigd.spectral import FrequencyResponse
from rigd.testing import Signals, write_profile, write_session

HERE = Path(__file__).parent
PAGE = HERE.parent / "fault_gallery.md"
AMPLITUDE_RAD = 0.0055
"""Amplitude at which the antenna's tip stays within the small slopes of the linear model."""
REST_S, SWEEP_S, RING_DOWN_S = 1.0, 60.0, 9.0
SEED = 4
SOUND, BLUE, ORANGE, RED = "#A8A8A8", "#0072B2", "#E69F00", "#D55E00"
BINS_PER_POINT = 20
BLOCK_S = 0.25
"""Time over which the power of a residual is averaged."""

Alteration = Callable[[Signals], Signals]


@dataclass(frozen=True)
class Fault:
    """A fault, and how to make it; the page says what it means."""

    name: str
    profile: dict[str, float | str | list[str]] = field(default_factory=dict)
    """Values by which the profile of the simulated rig differs."""
    alter: Alteration | None = None
    """Change of the samples of the session."""
    amplitude_rad: float = AMPLITUDE_RAD


@dataclass(frozen=True)
class Finding:
    """What an analysis finds in a record, as far as it is drawn and written."""

    response: FrequencyResponse
    sentences: tuple[str, ...]
    lines_hz: tuple[float, ...]
    residual_hz: NDArray[np.float64]
    modal: "Residual"
    """Residual of the modal model, which the report shows."""
    beam: "Residual"
    """Residual of a uniform beam."""
    removed: NDArray[np.float64]
    """What the analysis has removed (hum, a knock), over time in units of the noise."""
    time_s: NDArray[np.float64]


@dataclass(frozen=True)
class Residual:
    """A residual in units of the noise, over frequency and time."""

    over_frequency: NDArray[np.float64]
    over_time: NDArray[np.float64]


def reversed_encoder(signals: Signals) -> Signals:
    """Count the angle in the other sense."""
    return replace(signals, angle_rad=-signals.angle_rad, reference_rad=-signals.reference_rad)


def play(signals: Signals) -> Signals:
    """Put 0.8 mrad of play between the encoder and the antenna's root."""
    half_rad = 4e-4
    shaft = np.empty_like(signals.angle_rad)
    position = 0.0
    for index, root in enumerate(signals.angle_rad.tolist()):
        position = min(max(position, root - half_rad), root + half_rad)
        shaft[index] = position
    return replace(signals, angle_rad=2 * signals.angle_rad - shaft)


def clipped(signals: Signals) -> Signals:
    """Cut the torque at a limit that no status bit reports, as an amplifier does."""
    limit_nm = 0.35 * float(np.abs(signals.torque_nm).max())
    return replace(signals, torque_nm=np.clip(signals.torque_nm, -limit_nm, limit_nm))


def aliased(signals: Signals) -> Signals:
    """Add what a pulse-width modulation at 20.014 kHz leaves in samples at 1 kHz: 14 Hz."""
    t_s = np.arange(len(signals.torque_nm)) / signals.rate_hz
    return replace(signals, torque_nm=signals.torque_nm + 8e-3 * np.sin(2 * np.pi * 20_014.0 * t_s))


def late_torque(signals: Signals) -> Signals:
    """Delay the torque by 4 ms, which the file does not state."""
    return replace(signals, torque_nm=_delayed(signals.torque_nm, 4))


def friction(signals: Signals) -> Signals:
    """Add Coulomb friction between sensor and antenna, as of a cable that rubs."""
    speed = np.gradient(signals.angle_rad) * signals.rate_hz
    smooth = np.convolve(speed, np.ones(5) / 5, mode="same")
    return replace(signals, torque_nm=signals.torque_nm + 1e-3 * np.tanh(smooth / 0.01))


def wrong_unit(signals: Signals) -> Signals:
    """Give the torque in lbf·in, in a file that says N·m."""
    return replace(signals, torque_nm=signals.torque_nm / 0.112984829)


def _delayed(values: NDArray[np.float64], ticks: int) -> NDArray[np.float64]:
    """Return values that come some ticks late."""
    return np.concatenate([np.full(ticks, values[0]), values[:-ticks]])


FAULTS = (
    Fault("loose_clamp", {"simulation.clamp_compliance_rad_per_nm": 0.5}),
    Fault("tip_mass", {"simulation.tip_mass_kg": 3e-4}),
    Fault("air_drag", {"simulation.air_drag_m": 6e-3}, amplitude_rad=0.02),
    Fault("hum", {"simulation.hum_nm": 8e-3, "simulation.hum_hz": 49.8}),
    Fault("aliasing", alter=aliased),
    Fault("clipped_torque", alter=clipped),
    Fault("reversed_encoder", alter=reversed_encoder),
    Fault("play", alter=play),
    Fault("drifting_stiffness", {"simulation.stiffness_drift_per_s": -8e-4}),
    Fault("two_clocks", {"simulation.clock_rate_difference": -5e-4}),
    Fault("unstated_delay", alter=late_torque),
    Fault(
        "sensor_filter", {"simulation.torque_filter_hz": 35.0, "simulation.torque_filter_order": 2}
    ),
    Fault("knock", {"simulation.obstacles": ["x=0.5,force=0.4,duration=0.02,at=40"]}),
    Fault("friction", alter=friction),
    Fault("wrong_unit", alter=wrong_unit),
)
"""All faults, in the order of the page."""
SOUND_RIG = Fault("sound")


def record_of(fault: Fault, folder: Path) -> Record:
    """Run the session of a fault on the simulated rig, change its samples, and load its record."""
    folder.mkdir()
    profile = write_profile(folder, {"name": fault.name, **fault.profile})
    command = [
        "rigd",
        "run",
        "chirp",
        "--fast",
        "--no-look",
        "--profile",
        profile,
        "--output",
        folder,
    ]
    command += ["--amplitude", fault.amplitude_rad, "--tip-slope", 1.0, "--seed", SEED]
    command += ["--rest", REST_S, "--duration", SWEEP_S, "--ring-down", RING_DOWN_S]
    done = subprocess.run(
        [sys.executable, "-m", *map(str, command)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{fault.name}: {done.stdout}{done.stderr}")
    (session,) = folder.glob("*.mcap")
    if fault.alter is not None:
        whole = read_session(session)
        signals = Signals(
            whole.samples["angle_reference_rad"],
            whole.samples["angle_rad"],
            whole.samples["coupling_torque_nm"],
            dict(whole.segments),
        )
        kept = ("excitation", "amplitude_rad", "start_hz", "stop_hz", "actuation_delay_s")
        metadata = {key: whole.metadata[key] for key in kept}
        session = write_session(folder / "altered.mcap", fault.alter(signals), metadata=metadata)
    return load(session)


def find(fault: Fault) -> Finding:
    """Make and analyse the record of a fault."""
    with tempfile.TemporaryDirectory() as folder:
        record = record_of(fault, Path(folder) / "session")
        selection = select(record)
    analysis, comparison = selection.analysis, selection.analysis.comparison
    compared = np.flatnonzero(analysis.is_compared)
    bins = np.array_split(compared, max(compared.size // BINS_PER_POINT, 1))
    rate_hz = comparison.decimation.rate_hz
    size = max(int(rate_hz * BLOCK_S), 1)

    def over_time(values: NDArray[np.float64]) -> NDArray[np.float64]:
        whole = len(values) // size * size
        return np.sqrt(np.mean(values[:whole].reshape(-1, size) ** 2, axis=1))

    def residual(whitened: NDArray[np.complex128]) -> Residual:
        in_time = comparison.to_time_series(whitened) * np.sqrt(comparison.sample_count / 2)
        return Residual(
            np.array([np.sqrt(np.mean(np.abs(whitened[each]) ** 2) / 2) for each in bins]),
            over_time(in_time),
        )

    noise_nm = np.sqrt(np.mean(analysis.noise_nm2_per_hz) * analysis.frequency_hz[-1])
    removed_nm = np.asarray(comparison.removed_torque_nm)
    beam = residual(selection.fit.residual)
    modal = selection.headline.modal
    return Finding(
        response=frf(record).band(0.8, 60.0),
        sentences=selection.verdict.sentences,
        lines_hz=tuple(line.frequency_hz for line in analysis.lines),
        residual_hz=np.array([analysis.frequency_hz[each].mean() for each in bins]),
        modal=beam if modal is None else residual(modal.residual),
        beam=beam,
        removed=over_time(np.broadcast_to(removed_nm / noise_nm, comparison.sample_count)),
        time_s=np.arange(len(beam.over_time)) * size / rate_hz,
    )


def picture(found: Finding, sound: Finding) -> Figure:
    """Draw the response with that of a sound rig, and the residual over frequency and time."""
    figure = Figure(figsize=(10.0, 3.0), dpi=110, layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=(1.6, 1), width_ratios=(1.15, 1, 1))
    magnitude, phase = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    for each, colour, label in ((sound, SOUND, "rig without fault"), (found, BLUE, "this record")):
        hz, response = each.response.frequency_hz, each.response.response
        magnitude.plot(hz, 20 * np.log10(np.abs(response)), color=colour, label=label)
        phase.plot(hz, (np.degrees(np.angle(response)) + 90) % 360 - 90, ".", color=colour, ms=1.5)
    magnitude.set_title("Response (dB re N·m/rad, degrees)")
    magnitude.tick_params(labelbottom=False)
    phase.set(ylim=(-100, 280), yticks=(-90, 0, 90, 180, 270), xlabel="Frequency (Hz)")
    for axes in (magnitude, phase):
        axes.set(xscale="log", xlim=(0.8, 60))
        axes.set_xticks((1, 2, 5, 10, 20, 50), ("1", "2", "5", "10", "20", "50"))
        axes.minorticks_off()
    spectrum, power = figure.add_subplot(grid[:, 1]), figure.add_subplot(grid[:, 2])
    for each, colour, label in ((found.beam, ORANGE, "beam"), (found.modal, BLUE, "modes")):
        spectrum.plot(found.residual_hz, each.over_frequency, ".", color=colour, ms=3, label=label)
        power.plot(found.time_s, each.over_time, color=colour, label=label)
    for line_hz in found.lines_hz:
        spectrum.axvline(line_hz, color=RED, linewidth=1, linestyle=":")
        spectrum.text(
            line_hz, 0.97, f"{line_hz:.1f} Hz ", ha="right", va="top", fontsize=7, color=RED,
            transform=spectrum.get_xaxis_transform(),
        )  # fmt: skip
    if np.any(found.removed > 0):
        power.plot(found.time_s, found.removed, color=RED, linestyle=":", label="removed")
    spectrum.set(xlabel="Frequency (Hz)", title="Residual / noise, over frequency", xlim=(0, None))
    power.set(xlabel="Time (s)", title="Residual / noise, over time", xlim=(0, None))
    for axes in (spectrum, power):
        axes.axhline(1, color="black", linewidth=0.6, zorder=0)
        high = max(3.0, *(float(np.max(line.get_ydata())) for line in axes.lines))
        axes.set(yscale="log", ylim=(0.3, 1.6 * high))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
        axes.title.set(fontsize=8.5)
        axes.tick_params(labelsize=7.5)
        axes.xaxis.label.set(fontsize=8)
        for line in axes.lines:
            line.set_linewidth(min(line.get_linewidth(), 1.0))
    magnitude.legend(loc="lower left", bbox_to_anchor=(0.2, 0.0), fontsize=7)  # clear of peaks
    power.legend(loc="upper right", fontsize=7, ncols=3)
    return figure


def with_sentences(page: str, name: str, sentences: tuple[str, ...]) -> str:
    """Return the page with the report's sentences quoted below a fault's picture."""
    begin = page.index(f"(gallery/{name}.png)")
    quote = re.compile(r"(?:^> .*\n)+", re.MULTILINE).search(page, begin)
    assert quote is not None, f"no quotation below {name}.png"
    text = "".join(f"> * {sentence}\n" for sentence in sentences)
    return page[: quote.start()] + text + page[quote.end() :]


def main() -> None:
    """Draw the pictures and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=HERE)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="faults to draw")
    options = parser.parse_args()
    chosen = [each for each in FAULTS if not options.only or each.name in options.only]
    options.folder.mkdir(exist_ok=True)
    page = PAGE.read_text("utf-8")
    with ProcessPoolExecutor(2) as pool:
        findings = pool.map(find, [SOUND_RIG, *chosen])
        sound = next(findings)
        for fault, found in zip(chosen, findings, strict=True):
            picture(found, sound).savefig(options.folder / f"{fault.name}.png")
            page = with_sentences(page, fault.name, found.sentences)
    (PAGE if options.folder == HERE else options.folder / PAGE.name).write_text(page, "utf-8")


if __name__ == "__main__":
    main()
