"""What Rerun shows: samples turned into named columns, and the one layout of the views.

Rerun takes half a second to import, so it is imported by the functions that need it.
"""

from rigd.view.layout import APPLICATION_ID, WINDOW_S, blueprint
from rigd.view.samples import PLOTS, TIMELINE, Curve, Plot, columns, send_samples

__all__ = [
    "APPLICATION_ID",
    "PLOTS",
    "TIMELINE",
    "WINDOW_S",
    "Curve",
    "Plot",
    "blueprint",
    "columns",
    "send_samples",
]
