"""Display of a session in Rerun: its layout, and the drawing of samples, events and health.

The package offers the scene of a session (`Scene`), which turns records into functions that draw,
recorded sessions and Rerun files (`draw_session`, `new_rrd_file`), and charts over frequency
(`Chart`). Rerun takes half a second to import, so only the functions that need it import it.
Viewers, servers and processes are in `rigd.live`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
