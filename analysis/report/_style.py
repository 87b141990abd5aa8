"""Style of a report's figures, and drawing of the figures into image files.

The colours are Okabe and Ito's, distinguishable with any common colour blindness. Lines that lie on
top of each other differ in dash and colour. Lines are decimated to the resolution of a screen. A
copy of this process draws half of the figures at the same time, because drawing takes half the time
of a report.
"""

from __future__ import annotations

import base64
import io
import logging
import warnings
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

from analysis.models import STRUCTURES
from analysis.report.folder import write_new_file
from analysis.results import DEFAULT_FORMATS, FIGURE_FORMATS
from rigd.beam import parameter_named
from rigd.runtime.computations import computed_in_parallel
from rigd.spectral import magnitude_db

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.gridspec import GridSpec
    from matplotlib.legend import Legend
    from numpy.typing import NDArray

    from analysis.results import FigureFormat, ImagesByName

# This hides messages about the font cache, which is slow to build or is being built by another
# process. They affect no figure and mean nothing to the reader of a log.
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)

BLUE: Final = "#0072B2"
VERMILION: Final = "#D55E00"
GREEN: Final = "#009E73"
PURPLE: Final = "#CC79A7"
ORANGE: Final = "#E69F00"
INK: Final = "#222222"
"""Colour of titles, labels and points."""
GREY: Final = "#808080"
"""Colour of measured curves."""
LIGHT_GREY: Final = "#D2D2D2"
"""Colour of secondary lines, such as the ratio of transforms behind Welch's estimate."""
SHADE_COLOR: Final = "#F0E9D8"
"""Colour of shaded areas, such as the range of white noise."""

DPI: Final = 150
"""Resolution of PNG figures, in dots per inch."""
_PNG_COMPRESSION_LEVEL: Final = 1
"""Compression level of PNG figures: fast, with a tenth more bytes for a quarter of the time."""
_MAX_SVG_BYTES: Final = 1_000_000
"""Largest size of an SVG image in a page; instead of a larger one, the page shows a PNG image."""
_VECTOR_FORMAT_SETTINGS: Final[dict[Any, Any]] = {
    "svg.fonttype": "none", "svg.hashsalt": "rigd", "pdf.fonttype": 42,
}  # fmt: skip
"""Matplotlib's settings for SVG and PDF: text stays text, and identifiers are the same each time.
"""
_OMITTED_METADATA: Final = {
    "svg": dict.fromkeys(("Creator", "Date", "Format", "Type")),
    "pdf": dict.fromkeys(("Creator", "CreationDate", "Producer")),
}
"""Metadata that is omitted from SVG and PDF, so that the same figure gives the same file."""
SCREEN_COLUMNS: Final = 1000
"""Number of columns into which a line is decimated: the pixels of a full-width panel on a screen.
"""

_FREQUENCY_TICKS_HZ: Final = tuple(
    digit * 10.0**decade for decade in range(-4, 5) for digit in (1, 2, 5)
)
"""Frequencies with a tick label on a logarithmic axis, in hertz."""
_MATPLOTLIB_SETTINGS: Final[dict[Any, Any]] = {
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    # The default position. No axis is on top, and the search for overlapping labels takes a tenth
    # of the drawing time.
    "axes.titley": 1.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#9A9A9A",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E8E8E8",
    "grid.linewidth": 0.6,
    "xtick.color": "#606060",
    "ytick.color": "#606060",
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.1,
    "lines.solid_joinstyle": "round",
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "path.simplify_threshold": 0.25,
    "agg.path.chunksize": 20000,
}
"""Matplotlib's settings for fonts, axes and lines of all figures."""


@contextmanager
def figure_style() -> Iterator[None]:
    """Provide a context in which figures are made and saved in the style of this module."""
    with rc_context(_MATPLOTLIB_SETTINGS), warnings.catch_warnings():
        # A file name may hold characters that the font lacks; a box in a title does no harm.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def new_figure(width_in: float, height_in: float, title: str = "", subtitle: str = "") -> Figure:
    """Return an empty figure with a bold title and a grey subtitle, in a font that fits the width.

    A figure for a paper has no title and no subtitle, because it has a caption.
    """
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    if not title:
        return figure
    left_fraction, top_fraction = 0.35 / width_in, 1.0 - 0.17 / height_in
    # A file name may hold dollar signs, which are not mathematics, and bytes that are not text.
    text_options: dict[str, Any] = {"va": "top", "parse_math": False}
    title, subtitle = (
        title_line.encode("utf-8", "replace").decode() for title_line in (title, subtitle)
    )
    for figure_text in (
        figure.text(
            left_fraction,
            top_fraction,
            title,
            fontsize=12,
            fontweight="bold",
            color=INK,
            **text_options,
        ),
        figure.text(
            left_fraction,
            top_fraction - 0.26 / height_in,
            subtitle,
            fontsize=8.5,
            color="#606060",
            **text_options,
        ),
    ):
        width_fraction = figure_text.get_window_extent().width / (DPI * width_in)
        figure_text.set_fontsize(
            float(figure_text.get_fontsize())
            * (1 - 2 * left_fraction)
            / max(width_fraction, 1 - 2 * left_fraction)
        )
    return figure


def render_figure(figure: Figure, file_format: FigureFormat) -> bytes:
    """Return a figure as the bytes of a PNG, SVG or PDF file; call it within `figure_style`.

    SVG contains text as text, and the same identifiers each time. PDF embeds TrueType fonts, as
    journals require.
    """
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if not axis.get_label_text():
                # Otherwise the empty label is placed clear of the ticks: two more layouts.
                axis.set_label_coords(0, 0)
    image_buffer = io.BytesIO()
    if file_format == "png":
        # Fast compression: a tenth more bytes for a quarter of the time.
        figure.savefig(
            image_buffer,
            format=file_format,
            dpi=DPI,
            pil_kwargs={"compress_level": _PNG_COMPRESSION_LEVEL},
        )
    else:
        with rc_context(_VECTOR_FORMAT_SETTINGS):
            figure.savefig(
                image_buffer, format=file_format, metadata=_OMITTED_METADATA[file_format]
            )
    return image_buffer.getvalue()


def save_figure(figure: Figure, path: Path) -> bytes:
    """Write a figure in the format of the file's suffix; call it within `figure_style`.

    Return the content of the file. Raise `OutputError` if the file exists or cannot be written.
    """
    (file_format,) = (
        format_name for format_name in FIGURE_FORMATS if path.suffix == f".{format_name}"
    )
    figure_bytes = render_figure(figure, file_format)
    write_new_file(path, figure_bytes)
    return figure_bytes


# Pictures of a report


@dataclass(frozen=True, slots=True)
class Illustration:
    """Figure of a report before it is drawn: name, drawing function and caption."""

    name: str
    """Name of the figure's files without suffix."""
    draw: Callable[[], Figure]
    """Function that draws the figure; it is called within `figure_style`."""
    description: str
    """Text that is used as caption and as alternative text."""


@dataclass(frozen=True, slots=True)
class Picture:
    """Image of a figure on a page of a report.

    Attributes
    ----------
    name : str
        Name of the image file without its suffix.
    description : str
        Text that is used as caption and as alternative text.
    image : bytes
        Content of the image file.
    file_format : {"svg", "png"}
        Format of the image.
    """

    name: str
    description: str
    image: bytes
    file_format: FigureFormat = "svg"

    @property
    def source(self) -> str:
        """Image as a data URL, for an HTML page."""
        media_type = "image/svg+xml" if self.file_format == "svg" else f"image/{self.file_format}"
        return f"data:{media_type};base64,{base64.b64encode(self.image).decode('ascii')}"


def save_pictures(
    illustrations: Sequence[Illustration],
    folder: Path,
    formats: Collection[FigureFormat] = DEFAULT_FORMATS,
    on_step: Callable[[str], None] = lambda _step_text: None,
    drawn_images: ImagesByName | None = None,
) -> list[Picture]:
    """Draw figures, write each in several formats, and return them for a page.

    No two figures may have the same name. After each figure, `on_step` is called with a short text.
    Figures in `drawn_images`, from `draw_images` with the same formats, are not drawn again. A
    picture is an SVG image, which can be searched and is sharp on paper. It is a PNG image if SVG
    was not among the formats, or if the SVG image is large. Raise `OutputError` if a file exists or
    cannot be written.
    """
    images = dict(drawn_images or {})
    images |= _draw_in_two_processes(
        [illustration for illustration in illustrations if illustration.name not in images],
        formats,
        on_step,
    )
    pictures = []
    for illustration in illustrations:
        rendered_images = images[illustration.name]
        for file_format in formats:
            # The suffix is appended, because a name may contain dots.
            write_new_file(
                folder / f"{illustration.name}.{file_format}", rendered_images[file_format]
            )
        has_small_svg = "svg" in rendered_images and len(rendered_images["svg"]) <= _MAX_SVG_BYTES
        page_format: FigureFormat = "svg" if has_small_svg else "png"
        pictures.append(
            Picture(
                illustration.name,
                illustration.description,
                rendered_images[page_format],
                page_format,
            )
        )
    return pictures


def _draw_in_two_processes(
    illustrations: Sequence[Illustration],
    formats: Collection[FigureFormat],
    on_step: Callable[[str], None],
) -> ImagesByName:
    """Return the image files of each figure by its name; a forked process draws half of them."""
    own_count = (len(illustrations) + 1) // 2
    own_illustrations, copied_illustrations = illustrations[:own_count], illustrations[own_count:]
    background_drawing = (
        computed_in_parallel(partial(draw_images, copied_illustrations, formats))
        if copied_illustrations
        else nullcontext(dict)
    )
    with background_drawing as other_images:
        images = draw_images(own_illustrations, formats, on_step) | other_images()
    for illustration in copied_illustrations:
        on_step(f"figure {illustration.name}")
    return images


def draw_images(
    illustrations: Iterable[Illustration],
    formats: Collection[FigureFormat],
    on_step: Callable[[str], None] = lambda _step_text: None,
) -> ImagesByName:
    """Draw figures; return the image files of each by its name. `on_step` is as in `save_pictures`.

    The formats are the given ones, and one for the page.
    """
    images = {}
    for illustration in illustrations:
        images[illustration.name] = _draw_image(illustration, formats)
        on_step(f"figure {illustration.name}")
    return images


def _draw_image(
    illustration: Illustration, formats: Collection[FigureFormat]
) -> dict[FigureFormat, bytes]:
    """Return a figure's images by file format: the requested ones, and one for the page."""
    with figure_style():
        figure = illustration.draw()
        rendered_images: dict[FigureFormat, bytes] = {
            file_format: render_figure(figure, file_format) for file_format in formats
        }
        if not {"svg", "png"} & rendered_images.keys():
            rendered_images["svg"] = render_figure(figure, "svg")
        if len(rendered_images.get("svg", b"")) > _MAX_SVG_BYTES and "png" not in rendered_images:
            rendered_images["png"] = render_figure(figure, "png")
    return rendered_images


# Lines


def envelope(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    interval_count: int = SCREEN_COLUMNS,
    *,
    logarithmic: bool = False,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Decimate a line to the smallest and the largest y in each of equal intervals of x.

    The values of x increase. If `logarithmic`, for a logarithmic axis, x is positive and the
    intervals are equal in log x. A line of at most two points per interval is returned as it is.
    """
    if len(x) <= 2 * interval_count:
        return x, y
    axis_position = np.log(x) if logarithmic else x
    interval_edges = np.linspace(
        axis_position[0], axis_position[-1], interval_count, endpoint=False
    )
    interval_starts = np.unique(np.searchsorted(axis_position, interval_edges))
    extreme_pairs = np.empty((len(interval_starts), 2))
    extreme_pairs[:, 0] = np.minimum.reduceat(y, interval_starts)
    extreme_pairs[:, 1] = np.maximum.reduceat(y, interval_starts)
    return np.repeat(x[interval_starts], 2), extreme_pairs.ravel()


def log_spaced_indices(x: NDArray[np.float64], max_indices: int) -> NDArray[np.intp]:
    """Return the indices of about evenly spaced values on the logarithmic axis of x.

    x is positive and increasing. At most `max_indices` indices are returned.
    """
    spaced_values = np.geomspace(x[0], x[-1], max_indices)
    return np.unique(np.clip(np.searchsorted(x, spaced_values), 0, len(x) - 1))


def draw_dots(
    axes: Axes,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    *,
    size_pt: float,
    color: str,
) -> None:
    """Draw points as one line with round caps, which SVG writes faster than markers."""
    line_points = np.repeat(np.column_stack([x, y]), 2, axis=0)
    line_points[1::2, 0] *= 1 + 1e-9  # Agg draws no caps where nothing lies between them
    path_codes = np.tile([Outline.MOVETO, Outline.LINETO], len(x))
    axes.add_artist(
        PathPatch(
            Outline(line_points, path_codes),
            fill=False,
            color=color,
            linewidth=size_pt,
            capstyle="round",
        )
    )


def set_frequency_axis(
    axes: Axes, band_hz: tuple[float, float], *, with_labels: bool = True
) -> None:
    """Make the horizontal axis a logarithmic frequency axis, with labels at 1, 2 and 5."""
    axes.set_xscale("log")
    axes.set_xlim(band_hz)
    axes.xaxis.set_major_locator(
        FixedLocator([f for f in _FREQUENCY_TICKS_HZ if band_hz[0] <= f <= band_hz[1]])
    )
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(
        FuncFormatter(lambda f, _position: f"{f:g}") if with_labels else NullFormatter()
    )
    axes.tick_params(axis="x", which="both", labelbottom=with_labels)


def set_response_axes(magnitude_axes: Axes, phase_axes: Axes, *, with_labels: bool = True) -> None:
    """Label the axes of a frequency response, and set the range of the phase axis.

    The phase of the response from angle to torque is from 0 to 180°, well inside this range.
    """
    phase_axes.set_ylim(-60, 240)
    phase_axes.set_yticks((0, 90, 180))
    if with_labels:
        magnitude_axes.set_ylabel("Magnitude (dB re 1 N·m/rad)")
        phase_axes.set_ylabel("Phase (°)")


def type_panels(
    figure: Figure,
    grid_cells: GridSpec,
    type_names: Sequence[str],
    band_hz: tuple[float, float],
    db_limits: tuple[float, float],
) -> Iterator[tuple[str, Axes, Axes]]:
    """Yield each type's name and its new axes for magnitude and phase, in the cells of a grid."""
    for panel_number, type_name in enumerate(type_names):
        row, panel_column = divmod(panel_number, grid_cells.ncols)
        subgrid = grid_cells[row, panel_column].subgridspec(
            2, 1, height_ratios=(2.3, 1.0), hspace=0.07
        )
        magnitude_axes, phase_axes = figure.add_subplot(subgrid[0]), figure.add_subplot(subgrid[1])
        symbols = ", ".join(
            parameter_named(parameter_name).symbol for parameter_name in STRUCTURES[type_name].free
        )
        magnitude_axes.set_title(f"({ascii_lowercase[panel_number]}) Type {type_name}   {symbols}")
        magnitude_axes.set_ylim(db_limits)
        set_response_axes(magnitude_axes, phase_axes, with_labels=panel_column == 0)
        set_frequency_axis(magnitude_axes, band_hz, with_labels=False)
        set_frequency_axis(
            phase_axes, band_hz, with_labels=panel_number >= len(type_names) - grid_cells.ncols
        )
        for axes in (magnitude_axes, phase_axes):
            axes.tick_params(labelleft=panel_column == 0)
        yield type_name, magnitude_axes, phase_axes


def db_limits(
    measured_frf: Sequence[NDArray[np.complex128]],
    modelled_frf: Sequence[NDArray[np.complex128]],
    headroom_db: float,
) -> tuple[float, float]:
    """Return axis limits in dB that contain the measured responses and the models' peaks.

    Narrow zeros of the models may lie below the limits.
    """
    measured_db = magnitude_db(np.concatenate(measured_frf) + 1e-300)
    top_db = float(measured_db.max())
    peaks_db = max(float(magnitude_db(model_frf).max()) for model_frf in modelled_frf)
    low_db = float(np.quantile(measured_db, 0.002)) - 4.0
    return low_db, min(max(top_db, peaks_db), top_db + 15.0) + headroom_db


def add_legend(
    figure: Figure,
    legend_handles: Sequence[Artist],
    legend_labels: Sequence[str] | None = None,
    *,
    column_count: int,
) -> Legend:
    """Add a legend under the subtitle of a figure and return it."""
    width_in, height_in = figure.get_size_inches()
    return figure.legend(
        handles=legend_handles, labels=legend_labels, loc="upper left", ncols=column_count,
        borderaxespad=0.0,
        bbox_to_anchor=(0.3 / width_in, 1 - 0.62 / height_in),
    )  # fmt: skip


def axis_limits(*signal_arrays: NDArray[np.float64]) -> tuple[float, float]:
    """Return axis limits with a margin around the values of all signals.

    The limits differ even if all values are equal.
    """
    lowest_value = min(float(v.min()) for v in signal_arrays)
    highest_value = max(float(v.max()) for v in signal_arrays)
    limit_margin = 0.06 * (highest_value - lowest_value) or max(abs(highest_value), 1e-12)
    return lowest_value - limit_margin, highest_value + limit_margin
