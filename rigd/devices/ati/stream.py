"""The record stream of a Digital F/T sensor: finding the records, and keeping hold of them.

A record has 13 bytes: gauges 0, 2, 4, 1, 3, 5 as big-endian int16, then the sum of these bytes in
seven bits, with the sensor's error bit above. Nothing marks where a record begins and nothing
counts them, and the sum also fits one of 128 false beginnings. Worse, the records of a load at
rest are nearly alike, so that a false beginning that fits once may well fit again. Hence:

* after a disturbance a beginning counts only once several records in a row fit it, and these are
  then delivered, too;
* the beginning that held before the disturbance (or that the sensor's last message gives) has
  precedence: most disturbances damage bytes and lose none;
* any other beginning must be the only one that fits.
"""

RECORD_SIZE = 13
RECORD_BITS = RECORD_SIZE * 11
"""On the line: each byte with start, parity and stop bit."""
SYNC_RECORDS = 6
"""Records in a row that must fit. Less than come in a tick of 1 ms, so that one damaged record
makes no tick go without any."""
ERROR_BIT = 0x80
"""In the last byte of a record: the sensor's status word has something to say."""

_SUM_AT = RECORD_SIZE - 1
_SUM_MASK = 0x7F
_SYNC_SIZE = SYNC_RECORDS * RECORD_SIZE


class RecordStream:
    """Cuts what arrives, in whatever pieces, into records.

    Attributes
    ----------
    synchronised : bool
        It is known where the next record begins.
    records : int
        Delivered so far.
    checksum_errors : int
        How often a record did not fit where one had to begin.
    dropped_bytes : int
        That belonged to no record.
    pending : int
        Bytes that are held until it is clear which record they belong to.
    """

    __slots__ = ("_held", "_phase", "checksum_errors", "dropped_bytes", "records", "synchronised")

    def __init__(self) -> None:
        self.records = 0
        self.checksum_errors = 0
        self.dropped_bytes = 0
        self.start(aligned=False)

    def start(self, *, aligned: bool) -> None:
        """Begin afresh.

        Parameters
        ----------
        aligned
            The next byte is the first of a record, as far as one can tell.
        """
        self._held = b""
        self._phase = 0 if aligned else None
        self.synchronised = False

    @property
    def pending(self) -> int:
        """Bytes held back."""
        return len(self._held)

    def feed(self, chunk: bytes) -> bytes:
        """Take what has arrived; return the records in it, end to end, oldest first."""
        data = self._held + chunk if self._held else chunk
        found = b""
        while True:
            if not self.synchronised:
                begin = self._search(data)
                if begin is None:
                    break
                self.dropped_bytes += begin
                data = data[begin:]
                self.synchronised = True
            whole = len(data) - len(data) % RECORD_SIZE
            good = _length_of_good(data, whole)
            found = found + data[:good] if found else data[:good]
            data = data[good:]
            if good == whole:
                self._held = data
                break
            self.checksum_errors += 1
            self.synchronised = False
            self._phase = 0
        self.records += len(found) // RECORD_SIZE
        return found

    def _search(self, data: bytes) -> int | None:
        """Return where the records begin; or None, having kept what may still tell."""
        last = len(data) - _SYNC_SIZE
        undecided = max(0, last + 1)
        for begin in range(last + 1):
            if not _fits(data, begin):
                continue
            if self._phase is not None and (begin - self._phase) % RECORD_SIZE == 0:
                return begin
            if begin + _SUM_AT > last:
                # Its rivals are not all here yet.
                undecided = min(undecided, begin)
            elif not any(_fits(data, begin + shift) for shift in range(1, RECORD_SIZE)):
                return begin
        self.dropped_bytes += undecided
        self._held = data[undecided:]
        if self._phase is not None:
            self._phase = (self._phase - undecided) % RECORD_SIZE
        return None


def _length_of_good(data: bytes, whole: int) -> int:
    """Return how many bytes of ``data[:whole]`` are sound records, up to the first that is not."""
    for begin in range(0, whole, RECORD_SIZE):
        if (sum(data[begin : begin + _SUM_AT]) ^ data[begin + _SUM_AT]) & _SUM_MASK:
            return begin
    return whole


def _fits(data: bytes, begin: int) -> bool:
    part = data[begin : begin + _SYNC_SIZE]
    return _length_of_good(part, _SYNC_SIZE) == _SYNC_SIZE
