"""What the processes of a user share with the system: folder, addresses, locks, signals.

Offers the folder for sockets and addresses, addresses in it and whether a process is still there
(module `addresses`), the kernel's tables of processes and sockets (module `processes`), a lock that
names its holder (`HeldFile`), one program at a time on a rig (`RigLock`, `holds_rig`), background
work that gives way (`begin_background`, `give_way`), opening a file that a user names
(`open_plain_file`), and the signals that ask for an end (`raise_on` for commands; `StopRequest`,
`ignore`, `held_back` for the processes of a rig). The ground floor: it knows nothing of rigs but
their names.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
