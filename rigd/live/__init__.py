"""The live view: a process that shows the samples in Rerun and that nothing waits for.

Offers the viewer's window (`Viewer`, `Window`), the page for browsers (`PageOfFile`), the views
that run (`LiveAddress`, `running`) and the jobs of the publisher (`LiveJob`, `LiveSession`). The
publisher, `rigd.live.publisher`, only looks at the rings: neither the loop nor the recorder can
feel it. What is drawn is in `rigd.view`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
