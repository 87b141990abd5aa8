"""What people and programs are shown of an analysis: tables, figures, a JSON document."""

import logging

# Of its cache of fonts, which is slow to make or just being made by another process: no figure
# suffers, and nobody who reads it in a log can tell.
logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)
