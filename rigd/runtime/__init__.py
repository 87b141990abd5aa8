"""System resources of the processes: runtime folder, addresses, locks, signals, process table.

The package offers the folder for sockets and addresses, addresses and the detection of dead
processes (module `addresses`), the kernel's tables of processes and sockets (module `processes`), a
lock with the name of its holder (`HeldFile`), the lock of a rig (`RigLock`, `holds_rig`),
background work at low priority (`begin_background`, `give_way`), opening of files named by users
(`open_plain_file`), and the signals that request an end: `raise_on` for commands; `StopRequest`,
`ignore`, `signals_blocked` for the processes of a rig. The package depends on no other package. It
knows rigs by name only.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
