"""One program at a time runs a rig: ``rigd run`` or ``rigd serve``."""

from typing import Self

from rigd.devices.held_file import HeldError, HeldFile


class RigBusyError(Exception):
    """Another program runs the rig; the message says which."""


class RigLock:
    """Held as long as its context lasts.

    Parameters
    ----------
    rig
        The profile's name.
    holder
        Which program this is, for whoever comes second.
    hardware
        The rig is none of a user's own: all users of this computer have to be asked.
    alone
        Refuse everybody else; otherwise only those who want to be alone: sessions on simulated rigs
        of their own, each in its own process and time, do not disturb each other.
    """

    def __init__(self, rig: str, holder: str, *, hardware: bool, alone: bool = True) -> None:
        self._rig = rig
        self._holder = holder
        self._alone = alone
        self._file = HeldFile(f"rig-{rig}", everybody=hardware)

    def acquire(self) -> None:
        """Take the rig.

        Raises
        ------
        RigBusyError
            If another program has it, or it cannot be told.
        """
        try:
            self._file.acquire(self._holder, alone=self._alone)
        except HeldError as holder:
            raise RigBusyError(
                f"The rig {self._rig} is in use ({holder}). Wait until it is free; if a daemon has "
                "it, use rigd start."
            ) from None
        except OSError as error:
            raise RigBusyError(
                f"The rig {self._rig} cannot be reserved in {self._file.path.parent} "
                f"({error.strerror}); set XDG_RUNTIME_DIR to a folder that is yours."
            ) from None

    def release(self) -> None:
        """Give the rig up."""
        self._file.release()

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()
