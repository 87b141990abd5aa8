"""SDO server of a simulated CANopen node: expedited and segmented transfers, one at a time."""

from collections.abc import Callable
from struct import Struct

from rigd.sim.wire.canopen_objects import Abort, AbortCode, ObjectDictionary

_HEAD = Struct("<BHB")
_ABORT = Struct("<BHBI")

# Client command specifiers, in the three upper bits of the first byte.
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORTED = range(5)

_EXPEDITED = 0x02
_SIZE_GIVEN = 0x01
_LAST_SEGMENT = 0x01
_TOGGLE = 0x10
_EXPEDITED_SIZE = 4
_SEGMENT_SIZE = 7


class SdoServer:
    """Answers one client.

    Parameters
    ----------
    objects
        What is read and written.
    reply
        Takes the eight bytes of an answer.
    wrote
        Called after each successful write with index, sub-index, and what was written: a number, or
        bytes in hexadecimal.
    """

    def __init__(
        self,
        objects: ObjectDictionary,
        reply: Callable[[bytes], None],
        wrote: Callable[[int, int, int | str], None],
    ) -> None:
        self._objects = objects
        self._reply = reply
        self._wrote = wrote
        self.reset()

    def reset(self) -> None:
        """Forget a transfer that has not ended."""
        self._index = self._sub = 0
        self._awaited: int | None = None  # specifier of the segments of a transfer under way
        self._buffer = b""
        self._toggle = 0

    def receive(self, data: bytes) -> None:
        """Take a request; what does not have eight bytes is none."""
        if len(data) != 8:
            return
        specifier = data[0] >> 5
        is_segment = specifier in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT)
        if not is_segment:
            self.reset()
            _, self._index, self._sub = _HEAD.unpack_from(data)
        try:
            if is_segment:
                self._go_on(specifier, data)
            elif specifier == _DOWNLOAD:
                self._start_download(data)
            elif specifier == _UPLOAD:
                self._start_upload()
            elif specifier != _ABORTED:  # block transfers, and what is no request at all
                raise Abort(AbortCode.COMMAND)
        except Abort as abort:
            self._reply(_ABORT.pack(0x80, self._index, self._sub, abort.code))
            self.reset()

    def _start_download(self, data: bytes) -> None:
        command = data[0]
        entry = self._objects.find_writable(self._index, self._sub)
        if command & _EXPEDITED:
            size = min(entry.most_bytes, _EXPEDITED_SIZE)
            if command & _SIZE_GIVEN:
                size = _EXPEDITED_SIZE - (command >> 2 & 0x03)
            self._write(data[4 : 4 + size])
        else:
            # A number has one length, so that the segments need not be held against this one.
            stated = int.from_bytes(data[4:8], "little")
            if command & _SIZE_GIVEN and not entry.fits(stated):
                raise Abort(AbortCode.LENGTH)
            self._awaited = _DOWNLOAD_SEGMENT
        self._reply(_HEAD.pack(0x60, self._index, self._sub).ljust(8, b"\0"))

    def _start_upload(self) -> None:
        value = self._objects.read(self._index, self._sub)
        size = len(value)
        if 0 < size <= _EXPEDITED_SIZE:
            head = _HEAD.pack(0x43 | (_EXPEDITED_SIZE - size) << 2, self._index, self._sub)
            self._reply(head + value.ljust(_EXPEDITED_SIZE, b"\0"))
            return
        self._awaited = _UPLOAD_SEGMENT
        self._buffer = value
        self._reply(_HEAD.pack(0x41, self._index, self._sub) + size.to_bytes(4, "little"))

    def _go_on(self, specifier: int, data: bytes) -> None:
        """Take or give the next segment."""
        command = data[0]
        if specifier != self._awaited:
            raise Abort(AbortCode.COMMAND)
        if command & _TOGGLE != self._toggle:
            raise Abort(AbortCode.TOGGLE)
        toggle, self._toggle = self._toggle, self._toggle ^ _TOGGLE
        if specifier == _UPLOAD_SEGMENT:
            segment, self._buffer = self._buffer[:_SEGMENT_SIZE], self._buffer[_SEGMENT_SIZE:]
            is_last = not self._buffer
            head = toggle | (_SEGMENT_SIZE - len(segment)) << 1 | (_LAST_SEGMENT if is_last else 0)
            self._reply(bytes([head]) + segment.ljust(_SEGMENT_SIZE, b"\0"))
        else:
            self._buffer += data[1 : 1 + _SEGMENT_SIZE - (command >> 1 & 0x07)]
            # No entry that can be written is longer: else a client could fill the memory.
            if len(self._buffer) > self._objects.find_writable(self._index, self._sub).most_bytes:
                raise Abort(AbortCode.LENGTH)
            is_last = bool(command & _LAST_SEGMENT)
            if is_last:
                self._write(self._buffer)
            self._reply(bytes([0x20 | toggle]).ljust(8, b"\0"))
        if is_last:
            self.reset()

    def _write(self, data: bytes) -> None:
        self._wrote(self._index, self._sub, self._objects.write(self._index, self._sub, data))
