"""The live view: a process that shows the samples in Rerun without delaying other processes.

The public interface is the viewer's window (`Viewer`, `FileWindow`), the page for browsers
(`PageOfFile`), the running views (`LiveAddress`, `running`) and the jobs of the publisher
(`LiveJob`, `LiveSession`). The publisher, `rigd.live.publisher`, only observes the rings, so it
affects neither the loop nor the recorder. `rigd.view` has the drawings.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
