"""Library of session files: what a folder holds, who recorded it, and the modes that were found.

Offers the sessions of a folder, filtered (`list_sessions`), and the course of a specimen's modes
over time (`mode_trends`). The files are the truth. Beside them stands an index (`INDEX_NAME`), an
SQLite file that spares reading what has not changed; it may be removed at any time.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
