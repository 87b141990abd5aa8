"""Library of session files: the sessions of a folder with their metadata and modes.

The package offers a filtered list of the sessions in a folder (`list_sessions`) and, in its public
module `trend`, the changes of a specimen's modes over its sessions. Thanks to the index file
`library.sqlite` in the folder, unchanged session files are not read again. The index may be removed
at any time.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
