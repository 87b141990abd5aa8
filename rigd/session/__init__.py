"""Session files: format, writer, reader, recovery.

The names below are imported on first use, so that the control process, which needs the message
layout only (:mod:`rigd.session._format`), does not pay for the container.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
