"""Errors of a simulated CANopen node: error register, history and EMCY messages."""

from collections.abc import Callable
from struct import Struct

from rigd.sim.wire.canopen_objects import Abort, AbortCode, Entry, ObjectDictionary
from rigd.sim.wire.canopen_pdo import DISABLED, is_free_id

_FRAME = Struct("<HB5s")
_GENERIC = 0x01
_HISTORY = 8


class Emergencies:
    """What is wrong at present, and what was.

    Parameters
    ----------
    objects
        Gets the objects 1001, 1003 and 1014.
    node_id
        Of the node.
    send
        Takes identifier and data of an EMCY message, where one may be sent.

    Attributes
    ----------
    active : dict
        Error codes that stand, and their bits in the error register.
    """

    def __init__(
        self, objects: ObjectDictionary, node_id: int, send: Callable[[int, bytes], None]
    ) -> None:
        self._send = send
        self.active: dict[int, int] = {}
        self._history: list[int] = []
        objects.add(0x1001, Entry("B", access="ro", mapping="t", live=self._register))
        count = Entry("B", live=lambda: len(self._history), high=0, wrote=self._history.clear)
        objects.add(0x1003, count)
        for sub in range(1, _HISTORY + 1):
            objects.add(0x1003, Entry("I", access="ro", live=self._past(sub)), sub)
        self._cob_id = objects.add(0x1014, Entry("I", 0x80 + node_id, check=self._check_cob_id))

    def reset(self) -> None:
        """Forget all, as at power-on."""
        self.active.clear()
        self._history.clear()

    def report(self, code: int, register: int, vendor: bytes = b"") -> bool:
        """Note an error and send its message, unless it stands already.

        Parameters
        ----------
        code
            Error code.
        register
            Its bits in the error register; the generic bit is added.
        vendor
            Up to five bytes of the message.

        Returns
        -------
        bool
            Whether it is new.
        """
        if code in self.active:
            return False
        self.active[code] = register | _GENERIC
        self._history.insert(0, code)
        del self._history[_HISTORY:]
        self._transmit(code, vendor)
        return True

    def clear(self, *codes: int) -> None:
        """Note that errors are gone, and say so if any of them stood."""
        gone = [code for code in codes if self.active.pop(code, None) is not None]
        if gone:
            self._transmit(0, b"")

    def _transmit(self, code: int, vendor: bytes) -> None:
        if not self._cob_id.value & DISABLED:
            frame = _FRAME.pack(code, self._register(), vendor[:5])
            self._send(self._cob_id.value & 0x7FF, frame)

    def _register(self) -> int:
        register = 0
        for bits in self.active.values():
            register |= bits
        return register

    def _past(self, sub: int) -> Callable[[], int]:
        def read() -> int:
            if sub > len(self._history):
                raise Abort(AbortCode.NO_DATA)
            return self._history[sub - 1]

        return read

    def _check_cob_id(self, value: int) -> None:
        standing = self._cob_id.value
        if value & 0x7FFF_F800 or not is_free_id(value & 0x7FF):
            raise Abort(AbortCode.VALUE)
        if not (standing | value) & DISABLED and (standing ^ value) & 0x7FF:
            raise Abort(AbortCode.STATE)
