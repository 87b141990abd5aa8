"""Set-up of the drive by SDO, in pre-operational, before the cycle starts.

The canopen library does it, with a thread that receives; both are gone when a function here
returns. What it takes of an object's type stands in ``drive.eds``.
"""

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import can
import canopen
from canopen.network import MessageListener
from canopen.objectdictionary import ObjectDictionaryError

from rigd.devices.canbus import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402.faults import describe_error
from rigd.devices.cia402.frames import NMT_PRE_OPERATIONAL
from rigd.devices.cia402.states import (
    DISABLE_VOLTAGE,
    FAULT_BIT,
    FAULT_RESET,
    DriveState,
    state_of,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters, ServoDrive

_EDS = Path(__file__).with_name("drive.eds")
_SDO_TIMEOUT_S = 0.5
_SDO_TRIES = 2
_POLL_S = 0.01
_MODE_PATIENCE_S = 0.3
_RECEIVER_POLL_S = 0.02
_EVERY_BIT = 0xFFFF_FFFF
_ABSENT = (0x0602_0000, 0x0609_0011)
"""SDO abort codes: no such object, no such sub-index."""
_RATED_TORQUE_TOLERANCE = 0.02
_ROUNDING = 1e-9


class SdoRefusal(DeviceError):
    """The drive refused to read or write an object; carries the abort code."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class _Receiver(MessageListener):
    """Canopen's receiver; it keeps its thread quiet when the bus is cut.

    The next request reports the failure.
    """

    def on_error(self, exc: Exception) -> None:  # noqa: ARG002
        """Let the thread go on until the network ends it; it would ask again at once."""
        time.sleep(_RECEIVER_POLL_S)


class SdoAccess:
    """Reading and writing of one drive's objects, as a context.

    Parameters
    ----------
    port
        Open; nobody else receives from it meanwhile.
    node_id
        Of the drive.
    name
        Of the drive, for messages.
    """

    def __init__(self, port: CanPort, node_id: int, name: str) -> None:
        for library in ("can", "canopen"):
            # What goes wrong is raised; without a handler they would also print it.
            logging.getLogger(library).addHandler(logging.NullHandler())
        self._name = name
        self._bus_name = port.name
        self._node = canopen.RemoteNode(node_id, canopen.import_od(str(_EDS), node_id))
        self._node.sdo.RESPONSE_TIMEOUT = _SDO_TIMEOUT_S
        self._node.sdo.MAX_RETRIES = _SDO_TRIES
        port.accept(None)  # a sensor on the same bus may have narrowed it to its own frames
        self._network = canopen.Network(port.open_bus())
        self._network.NOTIFIER_CYCLE = _RECEIVER_POLL_S
        self._network.listeners = [_Receiver(self._network)]

    def __enter__(self) -> "SdoAccess":
        self._network.add_node(self._node)
        self._network.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # It reports a cut bus once more, when everything has ended.
        with suppress(DeviceError, OSError, can.CanError):
            self._network.disconnect()

    def to_pre_operational(self) -> None:
        """Have the drive leave operational, and make sure that it answers.

        Raises
        ------
        DeviceError
            If it does not.
        """
        self._node.nmt.send_command(NMT_PRE_OPERATIONAL)
        try:
            self.read(objects.IDENTITY, 1)
        except SdoRefusal:
            return
        except DeviceError as error:
            others = sorted(set(self._network.scanner.nodes) - {self._node.id})
            heard = f"; heard of node {', '.join(map(str, others))}" if others else ""
            raise DeviceError(
                f"{error} Look at its supply, its node id (cia402.node_id) and bit rate{heard}."
            ) from None

    def read(self, index: int, sub: int = 0) -> int:
        """Return the value of an object.

        Raises
        ------
        DeviceError
            If the drive does not answer, or refuses (:class:`SdoRefusal`).
        """
        value = self._transfer(index, sub, None)
        if not isinstance(value, int):
            raise DeviceError(f"{self._name}: {self._title(index, sub)} is not a number.")
        return value

    def read_text(self, index: int) -> str:
        """Return a text, empty if the drive has none; as :meth:`read` otherwise."""
        try:
            return str(self._transfer(index, 0, None)).strip("\0 ")
        except SdoRefusal:
            return ""

    def write(self, index: int, sub: int, value: int) -> None:
        """Write an object without reading it back.

        Raises
        ------
        DeviceError
            If the drive does not answer, or refuses.
        """
        self._transfer(index, sub, value)

    def configure(self, index: int, sub: int, value: int, mask: int = _EVERY_BIT) -> None:
        """Write an object and read it back.

        Raises
        ------
        DeviceError
            If the drive does not answer, refuses, or keeps another value in the bits of `mask`.
        """
        self.write(index, sub, value)
        got = self.read(index, sub)
        if (got ^ value) & mask:
            raise DeviceError(
                f"{self._name}: {self._title(index, sub)} was set to {_show(value)} and reads "
                f"{_show(got)}; check with the drive's own tool why it does not keep it."
            )

    def last_emergency(self) -> int:
        """Return the code of the last emergency message heard, or 0."""
        log = self._node.emcy.log
        return log[-1].code if log else 0

    def _transfer(self, index: int, sub: int, value: int | None) -> object:
        """Write a value, or read one."""
        variable = self._node.sdo.get_variable(index, sub)
        assert variable is not None, f"0x{index:04X}:{sub} is missing in {_EDS.name}"
        what = "reading" if value is None else f"writing {_show(value)} to"
        try:
            if value is None:
                return variable.raw
            variable.raw = value
            return value
        except canopen.SdoAbortedError as error:
            raise SdoRefusal(
                f"{self._name}: it refuses {what} {self._title(index, sub)}: {error}.", error.code
            ) from None
        except (canopen.SdoCommunicationError, can.CanError):
            raise DeviceError(
                f"{self._name}: no answer on CAN bus {self._bus_name} to {what} "
                f"{self._title(index, sub)}."
            ) from None
        except (ObjectDictionaryError, ValueError) as error:
            raise DeviceError(
                f"{self._name}: unusable answer to {what} {self._title(index, sub)} ({error})."
            ) from None

    def _title(self, index: int, sub: int) -> str:
        entry = self._node.object_dictionary.get_variable(index, sub)
        place = f"{index:04X}:{sub}" if sub else f"{index:04X}"
        return f"object {place}" + (f" ({entry.name})" if entry is not None else "")


def set_up(port: CanPort, rig: RigParameters, name: str) -> dict[str, object]:
    """Verify and configure the drive; it stays pre-operational and disabled.

    Parameters
    ----------
    port
        Open; nobody else receives from it meanwhile.
    rig
        With a section ``cia402``.
    name
        Of the drive, for messages.

    Returns
    -------
    dict
        What the drive says of itself.

    Raises
    ------
    DeviceError
        If it does not answer, is not the drive of the profile, is in fault, or does not take the
        configuration.
    """
    settings = rig.cia402
    assert settings is not None
    period_us = sync_period_us(rig.rate_hz)
    interpolation = interpolation_time(rig.rate_hz)
    with SdoAccess(port, settings.node_id, name) as sdo:
        sdo.to_pre_operational()
        identity = _read_identity(sdo)
        _check_identity(identity, settings, name)
        _switch_off(sdo, rig, name)
        _check_torque(sdo, identity, rig, name)
        sdo.configure(objects.MAX_TORQUE, 0, torque_limit_per_mille(rig))
        _configure_sync(sdo, period_us, interpolation)
        _configure_guards(sdo, settings)
        _configure_pdos(sdo, settings)
        sdo.configure(objects.MODE, 0, objects.CYCLIC_TORQUE)
        # Some drives show it only once they are enabled: it is looked at again then.
        _wait_for(lambda: sdo.read(objects.MODE_DISPLAY) == objects.CYCLIC_TORQUE, _MODE_PATIENCE_S)
    return identity


def reset_fault(port: CanPort, rig: RigParameters, name: str) -> str | None:
    """Reset a fault; the drive is left pre-operational and disabled.

    Returns
    -------
    str or None
        What the fault was, in words; None if there was none.

    Raises
    ------
    DeviceError
        If the drive does not answer, or the fault stands.
    """
    settings = rig.cia402
    assert settings is not None
    with SdoAccess(port, settings.node_id, name) as sdo:
        sdo.to_pre_operational()
        with suppress(SdoRefusal):
            # Nobody sends a heartbeat now, whose absence would be the next fault.
            sdo.write(objects.HEARTBEAT_CONSUMER, 1, 0)
        if not sdo.read(objects.STATUSWORD) & FAULT_BIT:
            return None
        fault = _fault(sdo)
        patience_s = settings.enable_timeout_s
        _wait_for(lambda: _state(sdo) is DriveState.FAULT, patience_s)
        for controlword in (DISABLE_VOLTAGE, FAULT_RESET):
            sdo.write(objects.CONTROLWORD, 0, controlword)
        gone = _wait_for(lambda: _state(sdo) is DriveState.SWITCH_ON_DISABLED, patience_s)
        sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE)
        if not gone:
            raise DeviceError(
                f"{name}: the fault cannot be reset: {_fault(sdo)}. It is in the state "
                f'"{_state(sdo).value}"; remove the cause, or switch the drive off and on.'
            )
    return fault


def sync_period_us(rate_hz: float) -> int:
    """Return the period in whole microseconds, for object 1006.

    Raises
    ------
    DeviceError
        If it is none.
    """
    period_us = 1e6 / rate_hz
    if abs(period_us - round(period_us)) > _ROUNDING * period_us:
        raise DeviceError(
            f"rig.rate_hz = {rate_hz:g} Hz: its period is no whole number of microseconds, which "
            "a CANopen drive needs; choose another rate, such as 1000 Hz."
        )
    return round(period_us)


def interpolation_time(rate_hz: float) -> tuple[int, int]:
    """Return value (1 to 255) and power of ten in s of the period, for object 60C2.

    Milliseconds come first: some drives take nothing else.

    Raises
    ------
    DeviceError
        If there is no such pair.
    """
    for exponent in (-3, -4, -5, -6, -2, -1, 0):
        value = 10.0**-exponent / rate_hz
        if 0.5 < value < 255.5 and abs(value - round(value)) <= _ROUNDING * value:
            return round(value), exponent
    raise DeviceError(
        f"rig.rate_hz = {rate_hz:g} Hz: its period cannot be told to a CANopen drive (object 60C2: "
        "1 to 255 times a power of ten of a second); choose another rate, such as 1000 Hz."
    )


def torque_limit_per_mille(rig: RigParameters) -> int:
    """Return the peak torque in 1/1000 of the rated torque, rounded down, within 16 bits."""
    motor = rig.motor
    return min(int(1000 * motor.peak_torque_nm / motor.rated_torque_nm + _ROUNDING), 32767)


def _read_identity(sdo: SdoAccess) -> dict[str, object]:
    identity: dict[str, object] = {}
    for sub, key in enumerate(("vendor_id", "product_code", "revision", "serial_number"), 1):
        identity[key] = _read_if_there(sdo, objects.IDENTITY, sub)
    identity["device_name"] = sdo.read_text(objects.DEVICE_NAME)
    identity["software_version"] = sdo.read_text(objects.SOFTWARE_VERSION)
    identity["supported_modes"] = sdo.read(objects.SUPPORTED_MODES)
    return identity


def _check_identity(identity: dict[str, object], settings: ServoDrive, name: str) -> None:
    for key, wanted in (
        ("vendor_id", settings.vendor_id),
        ("product_code", settings.product_code),
    ):
        got = identity[key]
        if wanted and got != wanted:
            told = "nothing" if got is None else f"0x{got:08X}"
            raise DeviceError(
                f"{name}: it is another drive: cia402.{key} is 0x{wanted:08X}, it says {told}. "
                "Check cia402.node_id, or write into the profile what is really there."
            )
    modes = identity["supported_modes"]
    if not (isinstance(modes, int) and modes & objects.SUPPORTS_CYCLIC_TORQUE):
        raise DeviceError(
            f"{name}: it has no cyclic synchronous torque mode over CANopen (object 6502 = "
            f"{_show(modes)}, bit 9 is not set); this drive or its firmware cannot be used."
        )


def _check_torque(
    sdo: SdoAccess, identity: dict[str, object], rig: RigParameters, name: str
) -> None:
    """Compare the torque that 1000 per mille stand for with the profile's."""
    settings = rig.cia402
    assert settings is not None
    if settings.rated_torque_unit_nm == 0:
        identity["rated_torque_counts"] = _read_if_there(sdo, objects.RATED_TORQUE)
        return
    counts = sdo.read(objects.RATED_TORQUE)
    identity["rated_torque_counts"] = counts
    told_nm = counts * settings.rated_torque_unit_nm * settings.gear_ratio
    wanted_nm = rig.motor.rated_torque_nm
    identity["rated_torque_nm"] = told_nm
    if abs(told_nm - wanted_nm) > _RATED_TORQUE_TOLERANCE * wanted_nm:
        raise DeviceError(
            f"{name}: its rated torque (object 6076 = {counts}) is {told_nm:.4g} N·m at the output "
            f"shaft, motor.rated_torque_nm says {wanted_nm:.4g} N·m; every torque would be wrong "
            "by that ratio. Correct the profile or the drive."
        )


def _switch_off(sdo: SdoAccess, rig: RigParameters, name: str) -> None:
    """Have the drive disabled, as a session that was killed may have left it."""
    settings = rig.cia402
    assert settings is not None
    if not sdo.read(objects.STATUSWORD) & FAULT_BIT:
        sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE)
        if (
            _wait_for(
                lambda: _state(sdo) in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT),
                settings.enable_timeout_s,
            )
            and _state(sdo) is DriveState.SWITCH_ON_DISABLED
        ):
            return
    statusword = sdo.read(objects.STATUSWORD)
    if statusword & FAULT_BIT:
        raise DeviceError(
            f"{name}: it is in fault: {_fault(sdo)}. Remove the cause, then: rigd reset --profile "
            f"{rig.name}"
        )
    raise DeviceError(
        f'{name}: expected in the state "{DriveState.SWITCH_ON_DISABLED.value}", it is in '
        f'"{state_of(statusword).value}" (statusword 0x{statusword:04X}); switch it off and on.'
    )


def _configure_sync(sdo: SdoAccess, period_us: int, interpolation: tuple[int, int]) -> None:
    cob_id = _read_if_there(sdo, objects.SYNC_COB_ID)
    if cob_id is not None and cob_id & ~objects.PDO_DISABLED != objects.SYNC_ID:
        sdo.configure(objects.SYNC_COB_ID, 0, objects.SYNC_ID)
    sdo.configure(objects.SYNC_PERIOD_US, 0, period_us)
    value, exponent = interpolation
    sdo.configure(objects.INTERPOLATION_TIME, 1, value)
    sdo.configure(objects.INTERPOLATION_TIME, 2, exponent)


def _configure_guards(sdo: SdoAccess, settings: ServoDrive) -> None:
    """Set what the drive does when this computer falls silent, and how it is heard itself."""
    watched = settings.host_node_id << 16 | round(settings.heartbeat_timeout_s * 1000)
    sdo.configure(objects.HEARTBEAT_CONSUMER, 1, watched)
    sdo.configure(objects.HEARTBEAT_PRODUCER_MS, 0, round(settings.drive_heartbeat_period_s * 1000))
    sdo.configure(objects.ABORT_OPTION, 0, settings.abort_option)
    sdo.configure(objects.COMMUNICATION_ERROR, 1, settings.communication_error_option)


def _configure_pdos(sdo: SdoAccess, settings: ServoDrive) -> None:
    delivery = (
        objects.AT_EVERY_SYNC if settings.torque_delivery == "at_sync" else objects.ON_ARRIVAL
    )
    node_id = settings.node_id
    for communication, mapping, can_id, entries, transmission in (
        (
            objects.TPDO_COMMUNICATION,
            objects.TPDO_MAPPING,
            0x180 + node_id | objects.NO_REMOTE_REQUEST,
            objects.TPDO_ENTRIES,
            objects.AT_EVERY_SYNC,
        ),
        (
            objects.RPDO_COMMUNICATION,
            objects.RPDO_MAPPING,
            0x200 + node_id,
            objects.RPDO_ENTRIES,
            delivery,
        ),
    ):
        for later in range(1, objects.PDO_COUNT):
            _disable_pdo(sdo, communication + later)
        cob_id_bits = _EVERY_BIT & ~objects.NO_REMOTE_REQUEST
        sdo.configure(communication, 1, can_id | objects.PDO_DISABLED, cob_id_bits)
        sdo.configure(mapping, 0, 0)
        for sub, entry in enumerate(entries, 1):
            sdo.configure(mapping, sub, entry)
        sdo.configure(mapping, 0, len(entries))
        sdo.configure(communication, 2, transmission)
        sdo.configure(communication, 1, can_id, cob_id_bits)


def _disable_pdo(sdo: SdoAccess, communication: int) -> None:
    """Disable a PDO that the rig does not use, if the drive has it."""
    cob_id = _read_if_there(sdo, communication, 1)
    if cob_id is not None and not cob_id & objects.PDO_DISABLED:
        sdo.configure(communication, 1, cob_id | objects.PDO_DISABLED)


def _read_if_there(sdo: SdoAccess, index: int, sub: int = 0) -> int | None:
    """Return the value of an object, or None where the drive has no such object."""
    try:
        return sdo.read(index, sub)
    except SdoRefusal as refusal:
        if refusal.code in _ABSENT:
            return None
        raise


def _state(sdo: SdoAccess) -> DriveState:
    return state_of(sdo.read(objects.STATUSWORD))


def _fault(sdo: SdoAccess) -> str:
    """Return in words why the drive is in fault."""
    try:
        code = sdo.read(objects.ERROR_CODE)
    except SdoRefusal:
        code = 0
    code = code or sdo.last_emergency()
    return describe_error(code) if code else "the drive names no cause"


def _wait_for(reached: Callable[[], bool], patience_s: float) -> bool:
    deadline = time.monotonic() + patience_s
    while not reached():
        if time.monotonic() > deadline:
            return False
        time.sleep(_POLL_S)
    return True


def _show(value: object) -> str:
    if isinstance(value, int) and not -65536 < value < 65536:
        return f"0x{value:08X}"
    return str(value)
