"""What has come from the drive: handlers of its frames, which take any content and never raise."""

from struct import error as LengthError  # noqa: N812

from rigd.devices.cia402.faults import describe_error
from rigd.devices.cia402.frames import (
    BOOT_UP,
    NMT_STATES,
    OPERATIONAL,
    read_emergency,
    unpack_short_tpdo,
    unpack_tpdo,
)
from rigd.devices.contracts import wired_stop_dropped

_TOGGLE_BIT = 0x80


class Inbox:
    """The drive's last words. A frame of the wrong length changes nothing but counts.

    Parameters
    ----------
    name
        Of the drive, for messages.
    sto_error_code
        Of the emergency message that says that its STO was dropped; 0 if it has none.

    Attributes
    ----------
    statusword, position, torque
        Of the last TPDO; position in counts, torque in 1/1000 of the rated one.
    strayed : int or None
        First statusword that was not as :meth:`guard` asks, in whichever TPDO it came: the drive
        may be back in the next one.
    replies : int
        TPDOs since somebody set this to zero, whatever was in them.
    legible : bool
        The last TPDO had the right length.
    nmt_state : int or None
        Of the last heartbeat.
    heard : bool
        A heartbeat has come since somebody set this to False.
    watching : bool
        The drive is meant to stay operational.
    alarm : str
        Why a session has to end, as a sentence for the operator: an emergency message, a restart,
        a drive that has left operational. The first reason stays; empty: none.
    emergency : bool
        An emergency message has come.
    reply : bytes
        The last SDO reply.
    malformed : int
        Frames of the wrong length.
    with_torque : bool
        TPDOs end in the actual torque, which not every drive tells.
    """

    __slots__ = (
        "_mask",
        "_value",
        "alarm",
        "emergency",
        "heard",
        "legible",
        "malformed",
        "name",
        "nmt_state",
        "position",
        "replies",
        "reply",
        "statusword",
        "sto_error_code",
        "strayed",
        "torque",
        "watching",
        "with_torque",
    )

    def __init__(self, name: str, sto_error_code: int = 0) -> None:
        self.name = name
        self.sto_error_code = sto_error_code
        self.malformed = 0
        self.with_torque = True
        self.clear()

    def clear(self) -> None:
        """Forget everything but the number of malformed frames."""
        self.statusword = 0
        self.guard(0, 0)
        self.position = 0
        self.torque = 0
        self.replies = 0
        self.legible = False
        self.nmt_state: int | None = None
        self.heard = False
        self.watching = False
        self.alarm = ""
        self.emergency = False
        self.reply = b""

    def guard(self, mask: int, value: int) -> None:
        """Have each statusword from the present one on looked at: `value` in the bits of `mask`."""
        self._mask, self._value = mask, value
        self.strayed: int | None = None
        if self.statusword & mask != value:
            self.strayed = self.statusword

    def take_tpdo(self, data: bytes) -> None:
        """Take statusword and position."""
        self.replies += 1
        try:
            if self.with_torque:
                self.statusword, self.position, self.torque = unpack_tpdo(data)
            else:
                self.statusword, self.position = unpack_short_tpdo(data)
            self.legible = True
            if self.statusword & self._mask != self._value and self.strayed is None:
                self.strayed = self.statusword
        except LengthError:
            self.legible = False
            self.malformed += 1

    def take_emergency(self, data: bytes) -> None:
        """Take an emergency message; a code of zero only ends one."""
        message = read_emergency(data)
        if message is None:
            self.malformed += 1
            return
        code, _, vendor = message
        if code >> 8 == 0:
            return
        self.emergency = True
        if self.alarm:
            return
        if code == self.sto_error_code:
            shown = f" (emergency message, error code 0x{code:04X})"
            self.alarm = str(wired_stop_dropped(self.name, shown))
        else:
            own = f", vendor's bytes {vendor.hex(' ')}" if any(vendor) else ""
            self.alarm = f"{self.name}: emergency message: {describe_error(code)}{own}."

    def take_heartbeat(self, data: bytes) -> None:
        """Take a heartbeat, or the message that the drive has started."""
        if not data:
            self.malformed += 1
            return
        state = data[0] & ~_TOGGLE_BIT
        self.nmt_state = state
        self.heard = True
        if self.watching and state != OPERATIONAL and not self.alarm:
            if state == BOOT_UP:
                what = "it has restarted by itself; look at its supply"
            else:
                words = NMT_STATES.get(state, f"state {state}")
                what = (
                    f"it has left operational for {words}, as it does when it misses heartbeats, "
                    "or when another master on the bus tells it to"
                )
            self.alarm = f"{self.name}: {what}."

    def take_reply(self, data: bytes) -> None:
        """Take an SDO reply."""
        self.reply = data
