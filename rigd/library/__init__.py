"""Library of session files: the sessions of a folder with their metadata and modes.

The package offers the filtered list of the sessions of a folder (`list_sessions`) and, in its
public module `trend`, the course of a specimen's modes over time. The index `library.sqlite` in the
folder avoids reading unchanged files; it may be removed at any time.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
