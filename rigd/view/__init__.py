"""What Rerun shows of a session: its layout, and the drawing of samples, events and health.

Offers the scene of a session (`Scene`), which turns records into drawings, recorded sessions and
Rerun's files (`draw_session`, `new_rrd_file`), and charts over frequency (`Chart`). Rerun takes
half a second to import, so it is imported by the functions that need it. Viewers, servers and
processes are in `rigd.live`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
