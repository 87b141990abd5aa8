"""Display of a session in Rerun: layout of the window, and drawing of samples, events and health.

`Scene` turns the records of a session into functions that draw them, `draw_session` draws a
recorded session, `rrd_file` writes Rerun files, and `Chart` is a chart over frequency or another
quantity. Rerun takes half a second to import, so only the functions that need it import it.
Viewers, servers and processes are in `rigd.live`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
