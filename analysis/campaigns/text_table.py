"""The look of a campaign's tables on the terminal."""

from rich import box
from rich.table import Table
from rich.text import Text


def text_table(title: str) -> Table:
    """Make a table without rows, as wide as its title at least."""
    return Table(
        min_width=len(title),
        title=Text(title, style="bold"), title_justify="left", caption_justify="left",
        box=box.SIMPLE_HEAD, padding=(0, 1), header_style="bold", show_edge=False, pad_edge=False,
    )  # fmt: skip
