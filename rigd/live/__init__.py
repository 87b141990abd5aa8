"""The live view: a process that shows the samples in Rerun without delaying other processes.

The public interface is the windows (`Viewer` for a live view, `FileWindow` for a file), the page of
a file for browsers (`PageOfFile`), the addresses of running views (module `address`) and the
messages to the publisher (module `messages`). The publisher process, `rigd.live.publisher`, only
observes the ring buffers, so it affects neither the loop nor the recorder. `rigd.view` has the
functions that draw.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
