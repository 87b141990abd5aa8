"""Set-up of the drive, in pre-operational, before the cycle starts.

The requirements are in :mod:`rigd.devices.cia402.requirements`. An object that holds the required
value is not written, because it may be read-only; its row there decides what follows if it is
absent or cannot be changed.
"""

from dataclasses import dataclass
from math import tau

from rigd.devices.canbus.port import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402._assignments import parse_assignment
from rigd.devices.cia402._sdo import EVERY_BIT, SdoAccess, SdoRefusal, ValueNotStored, show_value
from rigd.devices.cia402._standing import command_off, require_off, still_on, wait_for
from rigd.devices.cia402.requirements import (
    MAY_BE_WRITE_ONLY,
    TORQUE_LIMIT,
    WATCHDOG,
    ObjectAccess,
    Requirement,
    Watchdog,
    requirement,
    wanted_values,
    watchdog,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters, ServoDrive

_READ_ONLY = 0x0601_0002
_ABORTS = {
    0x0601_0000: "unsupported access",
    _READ_ONLY: "read-only",
    0x0602_0000: "no such object",
    0x0604_0041: "it cannot be mapped",
    0x0604_0042: "the PDO gets too long",
    0x0604_0043: "incompatible parameters",
    0x0609_0030: "value out of range",
    0x0609_0031: "value too great",
    0x0609_0032: "value too small",
    0x0800_0000: "general error",
    0x0800_0022: "not in this state of the device",
}
"""SDO abort codes in short."""

_MODE_PATIENCE_S = 0.3
_RATED_TORQUE_TOLERANCE = 0.02
_SCALE_TOLERANCE = 0.02
_DUPLICATE_WATCHES = 127
"""Most entries that 1016 can have."""


@dataclass(frozen=True, slots=True)
class DriveCapabilities:
    """Capabilities of a drive, as found during set-up.

    Attributes
    ----------
    identity
        Identity that the drive reports.
    watchdog, watchdog_s
        What takes the torque off when this computer falls silent, and after how long; infinite
        where nothing does.
    lacks
        Rows of the objects that are absent or not usable.
    assigned
        Manufacturer-specific objects that the profile has set.
    """

    identity: dict[str, object]
    watchdog: Watchdog
    watchdog_s: float
    lacks: tuple[Requirement, ...]
    assigned: tuple[str, ...]

    def has(self, index: int, sub: int = 0) -> bool:
        """Whether the drive has an object of the table.

        Parameters
        ----------
        index, sub
            Index and sub-index of the object.
        """
        return requirement(index, sub) not in self.lacks

    @property
    def accepted(self) -> tuple[str, ...]:
        """Names under which the profile accepted that something is missing, where it is."""
        names = [each.accept for each in self.lacks if each.accept and each.accept != WATCHDOG]
        if self.watchdog is Watchdog.NONE:
            names.insert(0, WATCHDOG)
        return tuple(names)


def set_up(port: CanPort, rig: RigParameters, name: str) -> DriveCapabilities:
    """Verify and configure the drive; it stays pre-operational and disabled.

    Parameters
    ----------
    port
        Open port; no other code receives from it meanwhile.
    rig
        Parameters with a section ``cia402``.
    name
        Name of the drive, for messages.

    Returns
    -------
    DriveCapabilities
        Identity and capabilities of the drive.

    Raises
    ------
    DeviceError
        If it does not answer, is not the drive of the profile, is in fault, lacks a required
        object, or rejects the configuration.
    """
    settings = rig.cia402
    assert settings is not None
    wanted = wanted_values(rig)
    with SdoAccess(port, settings.node_id, name) as sdo:
        # First of all, before its identity is known: a killed session may have left it turning.
        command_off(sdo)
        sdo.to_pre_operational()
        command_off(sdo)
        identity = _read_identity(sdo)
        try:
            eds_identity = sdo.use_eds(settings.eds) if settings.eds else (0, 0)
            _check_identity(identity, settings, name, eds_identity)
        except DeviceError as error:
            raise DeviceError(f"{error}{still_on(sdo)}") from None
        require_off(sdo, rig, name)
        work = _SetUp(sdo, settings, name, wanted)
        work.assign()
        work.check_torque(identity, rig)
        work.check_scales(identity, rig)
        work.configure_torque()
        work.configure_speed()
        work.configure_sync()
        active = work.configure_guards()
        work.configure_pdos(active)
        work.check_other_objects(identity)
        work.settle(requirement(objects.MODE))
        # Some drives show the mode only when enabled: it is checked again then.
        wait_for(lambda: sdo.read(objects.MODE_DISPLAY) == objects.CYCLIC_TORQUE, _MODE_PATIENCE_S)
    return DriveCapabilities(
        identity,
        active,
        {
            Watchdog.OWN: settings.own_watchdog_s,
            Watchdog.NONE: float("inf"),
        }.get(active, settings.heartbeat_timeout_s),
        tuple(work.lacks),
        settings.set_objects,
    )


def _read_identity(sdo: SdoAccess) -> dict[str, object]:
    identity: dict[str, object] = {}
    for sub, key in enumerate(("vendor_id", "product_code", "revision", "serial_number"), 1):
        identity[key] = sdo.read_if_there(objects.IDENTITY, sub)
    identity["device_name"] = sdo.read_text(objects.DEVICE_NAME)
    identity["software_version"] = sdo.read_text(objects.SOFTWARE_VERSION)
    identity["supported_modes"] = sdo.read_if_there(objects.SUPPORTED_MODES)
    return identity


def _check_identity(
    identity: dict[str, object], settings: ServoDrive, name: str, eds_identity: tuple[int, int]
) -> None:
    vendor, product = eds_identity
    for key, where, wanted in (
        ("vendor_id", "cia402.vendor_id", settings.vendor_id),
        ("product_code", "cia402.product_code", settings.product_code),
        ("vendor_id", f"VendorNumber in {settings.eds}", vendor),
        ("product_code", f"ProductNumber in {settings.eds}", product),
    ):
        got = identity[key]
        if wanted and got != wanted:
            got_text = "nothing" if got is None else f"0x{got:08X}"
            raise DeviceError(
                f"{name}: it is another drive: {where} is 0x{wanted:08X}, it says {got_text}. "
                "Check cia402.node_id, or write into the profile what is really there."
            )
    modes = identity["supported_modes"]
    if not (isinstance(modes, int) and modes & objects.SUPPORTS_CYCLIC_TORQUE):
        raise DeviceError(
            f"{name}: it has no cyclic synchronous torque mode over CANopen (object 6502 = "
            f"{show_value(modes)}, bit 9 is not set); this drive or its firmware cannot be used."
        )


class _SetUp:
    """Set-up of one drive that is disabled; collects the objects that it lacks.

    Parameters
    ----------
    sdo
        The way to it.
    settings
        Settings of the profile.
    name
        Name of the drive, for messages.
    wanted
        Values that its objects are to hold, by index and sub-index.
    """

    def __init__(
        self, sdo: SdoAccess, settings: ServoDrive, name: str, wanted: dict[tuple[int, int], int]
    ) -> None:
        self._sdo = sdo
        self._settings = settings
        self._name = name
        self._wanted = wanted
        self.lacks: list[Requirement] = []

    def settle(self, row: Requirement, wanted: int | None = None) -> bool:
        """Set an object to a value, and return whether the drive has the object.

        A write-only one is written and not read back, where that may be.

        Parameters
        ----------
        row
            Row of the object in the table of requirements.
        wanted
            The value; the one of the table of values if it is not given.

        Raises
        ------
        DeviceError
            If the object is indispensable, or the drive stores a value that is not acceptable.
        """
        if wanted is None:
            wanted = self._wanted[row.index, row.sub]
        try:
            found = self._sdo.read_if_there(row.index, row.sub)
        except SdoRefusal as refusal:
            if not (refusal.is_write_only and row.index in MAY_BE_WRITE_ONLY):
                raise
            self._sdo.write(row.index, row.sub, wanted)
            return True
        if found == wanted:
            return True
        try:
            self._sdo.configure(row.index, row.sub, wanted)
        except ValueNotStored as not_stored:
            found = not_stored.got
            why: DeviceError = not_stored
        except SdoRefusal as refusal:
            if found is None and refusal.is_absent:
                self._do_without(row)
                return False
            if found is None:
                raise
            why = DeviceError(
                f"{self._name}: object {row.address} ({row.name}) is {show_value(found)}, needed "
                f"is {show_value(wanted)}, and it refuses to change it (abort code "
                f"0x{refusal.code:08X}: {_words(refusal)}). {row.sentence}"
            )
        else:
            return True
        if row.fit.allows(found, wanted):
            return True
        if row.accept == TORQUE_LIMIT and found >= wanted and self._accepts(row):
            self._do_without(row)
            return False
        raise why

    def assign(self) -> None:
        """Set the manufacturer-specific objects that the profile names."""
        for text in self._settings.set_objects:
            try:
                self._sdo.assign(parse_assignment(text))
            except (DeviceError, ValueError) as error:
                raise DeviceError(f'{error} (cia402.set_objects: "{text}")') from None

    def check_torque(self, identity: dict[str, object], rig: RigParameters) -> None:
        """Compare the rated torque of the drive with that of the profile."""
        settings = self._settings
        counts = self._sdo.read_if_there(objects.RATED_TORQUE)
        identity["rated_torque_counts"] = counts
        row = requirement(objects.RATED_TORQUE)
        if counts is None:
            self.lacks.append(row)
        if settings.rated_torque_unit_nm == 0:
            return
        if counts is None:
            raise DeviceError(
                f"{self._name}: it has no object {row.address} ({row.name}). {row.sentence}"
            )
        reported_nm = counts * settings.rated_torque_unit_nm * settings.gear_ratio
        wanted_nm = rig.motor.rated_torque_nm
        identity["rated_torque_nm"] = reported_nm
        if abs(reported_nm - wanted_nm) > _RATED_TORQUE_TOLERANCE * wanted_nm:
            raise DeviceError(
                f"{self._name}: its rated torque (object 6076 = {counts}) is {reported_nm:.4g} N·m "
                f"at the output shaft, motor.rated_torque_nm says {wanted_nm:.4g} N·m; every "
                "torque would be wrong by that ratio. Correct the profile or the drive."
            )

    def check_scales(self, identity: dict[str, object], rig: RigParameters) -> None:
        """Compare gear and encoder step with the profile's, as far as the drive states them.

        Raises
        ------
        DeviceError
            If they differ by more than 2 %.
        """
        gear = self._ratio(objects.GEAR_RATIO)
        increments = self._ratio(objects.ENCODER_RESOLUTION)
        units = self._ratio(objects.FEED_CONSTANT)
        stated_gear = self._settings.gear_ratio
        identity["gear_ratio"] = gear
        if gear is not None and not _is_near(gear, stated_gear):
            raise DeviceError(
                f"{self._name}: its gear (object 6091) is {gear:.5g} turns of the motor in one of "
                f"the output shaft, cia402.gear_ratio says {stated_gear:.5g}. Correct the profile "
                "or the drive."
            )
        # Units of the position in a turn of the output shaft: increments, unless the drive has a
        # feed constant that makes them others.
        increments_a_turn = None if increments is None else increments * (gear or stated_gear)
        turns = [turn for turn in (units, increments_a_turn) if turn is not None]
        identity["encoder_step_rad"] = tau / turns[0] if turns else None
        step_rad = rig.encoder.resolution_rad
        if not turns or any(_is_near(tau / turn, step_rad) for turn in turns):
            return
        gear_objects = "6092" if units is not None else "608F" if gear is None else "608F and 6091"
        raise DeviceError(
            f"{self._name}: its encoder step (object {gear_objects}) is {tau / turns[0]:.4g} rad "
            f"at the output shaft ({turns[0]:.6g} steps a turn), encoder.resolution_rad says "
            f"{step_rad:.4g} rad; every angle, speed and limit would be wrong by the ratio "
            f"{tau / turns[0] / step_rad:.3g}. Correct the profile or the drive."
        )

    def _ratio(self, index: int) -> float | None:
        """Return the ratio of an object's two numbers; None where it states none.

        Drives that were never set up for it have it as 1 to 1.
        """
        try:
            above = self._sdo.read_if_there(index, 1)
            below = self._sdo.read_if_there(index, 2)
        except SdoRefusal:
            return None
        if above is None or below is None or above <= 0 or below <= 0 or above == below == 1:
            return None
        return above / below

    def configure_torque(self) -> None:
        """Configure the torque limit, and clear offsets that add to the target torque."""
        self.settle(requirement(objects.MAX_TORQUE))
        for index in objects.TORQUE_LIMITS:
            if self._sdo.read_if_there(index) is not None:
                self.settle(requirement(index))
        self._clear(requirement(objects.TORQUE_OFFSET))
        self._clear(requirement(objects.POLARITY))

    def configure_speed(self) -> None:
        """Configure the speed limit, which bounds the effect of a constant torque."""
        if self._settings.max_speed_rad_s == 0:
            return
        row = requirement(objects.MAX_SPEED_RPM)
        if not self.settle(row):
            raise DeviceError(
                f"{self._name}: it has no object {row.address} ({row.name}). {row.sentence}"
            )

    def configure_sync(self) -> None:
        """Configure SYNC: its period, no window, no counter."""
        sdo = self._sdo
        cob_id = sdo.read_if_there(objects.SYNC_COB_ID)
        row = requirement(objects.SYNC_COB_ID)
        if cob_id is not None and cob_id & ~objects.PDO_DISABLED != self._wanted[row.index, 0]:
            self.settle(row)
        if sdo.read_if_there(objects.SYNC_OVERFLOW):
            # It may be changed only while the period is 0 (CiA 301).
            if sdo.read_if_there(objects.SYNC_PERIOD_US):
                self.settle(requirement(objects.SYNC_PERIOD_US), 0)
            self._clear(requirement(objects.SYNC_OVERFLOW))
        self._clear(requirement(objects.SYNC_WINDOW_US))
        self.settle(requirement(objects.SYNC_PERIOD_US))
        for sub in (1, 2):
            self.settle(requirement(objects.INTERPOLATION_TIME, sub))

    def configure_guards(self) -> Watchdog:
        """Set the drive's reaction to this computer's silence, and its own heartbeat.

        Returns
        -------
        Watchdog
            Watchdog that is active.
        """
        settings, sdo = self._settings, self._sdo
        deadline = requirement(objects.RPDO_COMMUNICATION, objects.EVENT_TIMER)
        heartbeat = self._configure_heartbeat_consumer()
        has_deadline = sdo.read_if_there(deadline.index, deadline.sub) is not None
        active = watchdog(
            heartbeat=heartbeat, rpdo_deadline=has_deadline, own=settings.own_watchdog_s > 0
        )
        row = requirement(objects.HEARTBEAT_CONSUMER, 1)
        if not heartbeat:
            self.lacks.append(row)
        if active is Watchdog.NONE and not self._accepts(row):
            raise DeviceError(f"{self._name}: {row.missing()}")
        if active in (Watchdog.HEARTBEAT, Watchdog.RPDO_DEADLINE):
            # The drive's own watchdog acts as its manufacturer defines, whatever is set here.
            self.settle(requirement(objects.ABORT_OPTION))
        row = requirement(objects.COMMUNICATION_ERROR, 1)
        if not self.settle(row) and settings.communication_error_option:
            raise DeviceError(
                f"{self._name}: it has no object {row.address} ({row.name}), so that it goes "
                "pre-operational on a lost connection; set cia402.communication_error_option = 0."
            )
        self.settle(requirement(objects.HEARTBEAT_PRODUCER_MS))
        row = requirement(objects.EMERGENCY_COB_ID)
        if sdo.read_if_there(row.index) not in (None, self._wanted[row.index, 0]):
            self.settle(row)
        return active

    def configure_pdos(self, active: Watchdog) -> None:
        """Map one PDO each way and switch all others off."""
        settings, sdo = self._settings, self._sdo
        for communication in (objects.TPDO_COMMUNICATION, objects.RPDO_COMMUNICATION):
            _disable_others(sdo, communication)
        entries: tuple[int, ...] = objects.TPDO_ENTRIES
        row = requirement(objects.ACTUAL_TORQUE)
        if sdo.read_if_there(objects.ACTUAL_TORQUE) is None and self._accepts(row):
            self._do_without(row)
            entries = entries[:-1]
        self._configure_pdo(
            objects.TPDO_COMMUNICATION,
            objects.NO_REMOTE_REQUEST,
            entries,
            {objects.INHIBIT_TIME: 0},
        )
        deadline_ms = round(settings.heartbeat_timeout_s * 1000)
        self._configure_pdo(
            objects.RPDO_COMMUNICATION,
            0,
            objects.RPDO_ENTRIES,
            {objects.EVENT_TIMER: deadline_ms} if active is Watchdog.RPDO_DEADLINE else {},
        )

    def check_other_objects(self, identity: dict[str, object]) -> None:
        """Check the objects that are only read."""
        for key, index in (
            ("quick_stop_option", objects.QUICK_STOP_OPTION),
            ("fault_reaction_option", objects.FAULT_REACTION_OPTION),
        ):
            value = self._sdo.read_if_there(index)
            if value is not None:
                identity[key] = value

    def _accepts(self, row: Requirement) -> bool:
        return row.accept in self._settings.accept_without

    def _do_without(self, row: Requirement) -> None:
        """Record a missing object if it is dispensable.

        Raises
        ------
        DeviceError
            If it is indispensable.
        """
        reason = row.missing(self._settings.accept_without)
        if reason:
            raise DeviceError(f"{self._name}: {reason}")
        self.lacks.append(row)

    def _clear(self, row: Requirement) -> None:
        """Set an object to 0 if the drive has it; raise if rigd does not set it."""
        found = self._sdo.read_if_there(row.index, row.sub)
        if not found:
            return
        if ObjectAccess.WRITE in row.access:
            self.settle(row, 0)
            return
        raise DeviceError(
            f"{self._name}: object {row.address} ({row.name}) is 0x{found:02X}, not 0. "
            f"{row.sentence}"
        )

    def _configure_heartbeat_consumer(self) -> bool:
        """Configure the monitoring of this computer's heartbeat; return whether there is one."""
        settings, sdo = self._settings, self._sdo
        index, host = objects.HEARTBEAT_CONSUMER, settings.host_node_id
        wanted = host << 16 | round(settings.heartbeat_timeout_s * 1000)
        found = sdo.read_if_there(index, 1)
        if found != wanted:
            # One node twice is refused (0x06040043): what was stored before goes first.
            for sub in range(2, min(sdo.read_if_there(index) or 0, _DUPLICATE_WATCHES) + 1):
                stored = sdo.read_if_there(index, sub)
                if stored is not None and stored >> 16 & 0x7F == host:
                    sdo.configure(index, sub, 0)
            try:
                sdo.configure(index, 1, wanted)
            except SdoRefusal as refusal:
                if refusal.is_absent or refusal.code == _READ_ONLY:
                    return False
                raise
        return True

    def _configure_pdo(
        self,
        communication: int,
        flags: int,
        entries: tuple[int, ...],
        parameters: dict[int, int],
    ) -> None:
        """Map entries into a PDO; one that has them already is not written.

        Parameters
        ----------
        communication
            Index of its communication parameters; those of its mapping are 0x200 further.
        flags
            Further bits of its COB-ID.
        entries
            Objects that it carries, as mapping entries.
        parameters
            Further sub-indices of the communication parameters, and what they are to hold where
            the drive has them and they are not 0, or are wanted.
        """
        sdo, mapping = self._sdo, communication + 0x200
        can_id = self._wanted[communication, 1] | flags
        transmission = self._wanted[communication, 2]
        cob_id_bits = EVERY_BIT & ~objects.NO_REMOTE_REQUEST
        mapped = self._reads(mapping, (len(entries), *entries))
        typed = sdo.read_if_there(communication, 2) == transmission
        identified = sdo.read_if_there(communication, 1)
        others = {
            sub: value
            for sub, value in parameters.items()
            if sdo.read_if_there(communication, sub) not in (None, value)
        }
        right = identified is not None and not (identified ^ can_id) & cob_id_bits
        if right and mapped and typed and not others:
            return
        sdo.configure(communication, 1, can_id | objects.PDO_DISABLED, cob_id_bits)
        if not mapped:
            self._map(communication, mapping, entries)
        if not typed:
            sdo.configure(communication, 2, transmission)
        for sub, value in others.items():
            self.settle(requirement(communication, sub), value)
        sdo.configure(communication, 1, can_id, cob_id_bits)

    def _map(self, communication: int, mapping: int, entries: tuple[int, ...]) -> None:
        sdo = self._sdo
        what = "RPDO1" if communication == objects.RPDO_COMMUNICATION else "TPDO1"
        try:
            sdo.configure(mapping, 0, 0)
        except SdoRefusal as refusal:
            raise DeviceError(f"{refusal} {requirement(mapping).sentence}") from None
        for sub, entry in enumerate(entries, 1):
            try:
                sdo.configure(mapping, sub, entry)
            except SdoRefusal as refusal:
                row = requirement(entry >> 16)
                if refusal.is_absent:
                    raise DeviceError(f"{self._name}: {row.missing()}") from None
                raise DeviceError(
                    f"{self._name}: it does not take object {row.address} ({row.name}) into {what} "
                    f"(abort code 0x{refusal.code:08X}: {_words(refusal)}). {row.sentence}"
                ) from None
        sdo.configure(mapping, 0, len(entries))

    def _reads(self, index: int, values: tuple[int, ...]) -> bool:
        """Whether sub-indices 0 and on of an object read as given."""
        return all(self._sdo.read_if_there(index, sub) == value for sub, value in enumerate(values))


def _is_near(stated: float, wanted: float) -> bool:
    return abs(stated - wanted) <= _SCALE_TOLERANCE * wanted


def _disable_others(sdo: SdoAccess, communication: int) -> None:
    """Disable the PDOs that the rig does not use, as many as the drive has."""
    for later in range(1, objects.PDO_COUNT_AT_MOST):
        cob_id = sdo.read_if_there(communication + later, 1)
        if cob_id is None:
            # Beyond those that CiA 301 sets beforehand there are no gaps.
            if later >= objects.PDO_COUNT:
                return
        elif not cob_id & objects.PDO_DISABLED:
            sdo.configure(communication + later, 1, cob_id | objects.PDO_DISABLED)


def _words(refusal: SdoRefusal) -> str:
    return _ABORTS.get(refusal.code, "see CiA 301")
