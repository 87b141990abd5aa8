"""Library of session files: what a folder holds, who recorded it, and the modes that were found.

Offers the sessions of a folder, filtered (`list_sessions`), and in its public module `trend` the
course of a specimen's modes over time. The files are the truth. In the same folder is an index
(`library.sqlite`), which spares reading what has not changed; it may be removed at any time.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
