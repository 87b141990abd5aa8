"""Resources of the operating system: runtime folder, addresses, locks, signals, process table.

The package offers the user's folder for sockets and addresses, and the detection of dead processes
(module `addresses`), the kernel's tables of processes and sockets (module `processes`), the lock of
a rig and other lock files that state their holder (module `locks`), work at low priority (module
`background`), computations in a copy of this process (module `computations`), the user's folders
for configuration and caches (module `user_folders`), safe opening of files whose names come from
users (`open_plain_file`), and the signals that request a program's end.
Commands use `raise_on_signals` for these signals, and the processes of a rig use `StopRequest`,
`ignore_end_signals` and `signals_blocked`. The package depends on no other package, and knows rigs
by name only.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
