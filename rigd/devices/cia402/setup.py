"""Set-up of the drive, in pre-operational, before the cycle starts."""

from rigd.devices.canbus import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402.sdo import EVERY_BIT, SdoAccess, show_value
from rigd.devices.cia402.standing import command_off, require_off, still_on, wait_for
from rigd.devices.cia402.values import (
    interpolation_time,
    max_speed_rpm,
    sync_period_us,
    torque_limit_per_mille,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters, ServoDrive

_MODE_PATIENCE_S = 0.3
_RATED_TORQUE_TOLERANCE = 0.02


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
        # Before anything else, whoever it is: a session that was killed may have left it turning.
        command_off(sdo)
        sdo.to_pre_operational()
        command_off(sdo)
        identity = _read_identity(sdo)
        try:
            _check_identity(identity, settings, name)
        except DeviceError as error:
            raise DeviceError(f"{error}{still_on(sdo)}") from None
        require_off(sdo, rig, name)
        _check_torque(sdo, identity, rig, name)
        _configure_torque(sdo, torque_limit_per_mille(rig))
        _configure_speed(sdo, settings, name)
        _configure_sync(sdo, period_us, interpolation)
        _configure_guards(sdo, settings)
        _configure_pdos(sdo, settings)
        sdo.configure(objects.MODE, 0, objects.CYCLIC_TORQUE)
        # Some drives show it only once they are enabled: it is looked at again then.
        wait_for(lambda: sdo.read(objects.MODE_DISPLAY) == objects.CYCLIC_TORQUE, _MODE_PATIENCE_S)
    return identity


def _read_identity(sdo: SdoAccess) -> dict[str, object]:
    identity: dict[str, object] = {}
    for sub, key in enumerate(("vendor_id", "product_code", "revision", "serial_number"), 1):
        identity[key] = sdo.read_if_there(objects.IDENTITY, sub)
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
            f"{show_value(modes)}, bit 9 is not set); this drive or its firmware cannot be used."
        )


def _check_torque(
    sdo: SdoAccess, identity: dict[str, object], rig: RigParameters, name: str
) -> None:
    """Compare the torque that 1000 per mille stand for with the profile's."""
    settings = rig.cia402
    assert settings is not None
    if settings.rated_torque_unit_nm == 0:
        identity["rated_torque_counts"] = sdo.read_if_there(objects.RATED_TORQUE)
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


def _configure_torque(sdo: SdoAccess, limit_per_mille: int) -> None:
    """Have the drive exert what it is told: up to the limit, and nothing on top of it."""
    sdo.configure(objects.MAX_TORQUE, 0, limit_per_mille)
    others = {objects.TORQUE_OFFSET: 0, **dict.fromkeys(objects.TORQUE_LIMITS, limit_per_mille)}
    for index, value in others.items():
        found = sdo.read_if_there(index)
        if found is not None and found != value:
            sdo.configure(index, 0, value)


def _configure_speed(sdo: SdoAccess, settings: ServoDrive, name: str) -> None:
    """Have the drive not make the shaft ever faster, should nobody take a torque back."""
    if settings.max_speed_rad_s == 0:
        return
    if sdo.read_if_there(objects.MAX_SPEED_RPM) is None:
        raise DeviceError(
            f"{name}: it has no limit of its own for the speed (object 6080); set "
            "cia402.max_speed_rad_s = 0, and see what rigd check then says of the worst travel."
        )
    sdo.configure(objects.MAX_SPEED_RPM, 0, max_speed_rpm(settings))


def _configure_sync(sdo: SdoAccess, period_us: int, interpolation: tuple[int, int]) -> None:
    cob_id = sdo.read_if_there(objects.SYNC_COB_ID)
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
        cob_id_bits = EVERY_BIT & ~objects.NO_REMOTE_REQUEST
        sdo.configure(communication, 1, can_id | objects.PDO_DISABLED, cob_id_bits)
        sdo.configure(mapping, 0, 0)
        for sub, entry in enumerate(entries, 1):
            sdo.configure(mapping, sub, entry)
        sdo.configure(mapping, 0, len(entries))
        sdo.configure(communication, 2, transmission)
        sdo.configure(communication, 1, can_id, cob_id_bits)


def _disable_pdo(sdo: SdoAccess, communication: int) -> None:
    """Disable a PDO that the rig does not use, if the drive has it."""
    cob_id = sdo.read_if_there(communication, 1)
    if cob_id is not None and not cob_id & objects.PDO_DISABLED:
        sdo.configure(communication, 1, cob_id | objects.PDO_DISABLED)
