"""Verification and configuration of the drive, in pre-operational, before the loop starts.

The requirements are in :mod:`rigd.devices.cia402.requirements`. An object that holds the required
value is not written, because it may be read-only. If an object is absent or cannot be changed, its
requirement decides whether the drive is refused.
"""

from dataclasses import dataclass
from math import tau

from rigd.devices.canbus.port import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402._assignments import parse_assignment
from rigd.devices.cia402._sdo import (
    ALL_BITS_MASK,
    SdoAbortError,
    SdoAccess,
    ValueNotStoredError,
    value_text,
)
from rigd.devices.cia402._switch_off import (
    command_voltage_off,
    describe_remaining_torque,
    wait_for,
    wait_until_disabled,
)
from rigd.devices.cia402.requirements import (
    POSSIBLY_WRITE_ONLY_INDICES,
    TORQUE_LIMIT,
    WATCHDOG,
    ObjectAccess,
    Requirement,
    Watchdog,
    most_reliable_watchdog,
    required_values,
    requirement,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters, ServoDrive

_READ_ONLY_ABORT = 0x0601_0002
"""SDO abort code for writing a read-only object."""
_ABORT_MEANINGS = {
    0x0601_0000: "unsupported access",
    _READ_ONLY_ABORT: "read-only",
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
"""Short meanings of SDO abort codes, for messages."""

_MODE_DISPLAY_TIMEOUT_S = 0.3
"""Time in seconds to wait until the drive shows the commanded mode of operation."""
_MAX_RATED_TORQUE_DEVIATION = 0.02
"""Largest relative difference between the rated torques of the drive and of the profile."""
_GEAR_AND_ENCODER_TOLERANCE = 0.02
"""Largest relative difference between the gear ratios, or encoder steps, of drive and profile."""
_MAX_HEARTBEAT_CONSUMERS = 127
"""Largest number of heartbeat consumer entries in object 1016."""


@dataclass(frozen=True, slots=True)
class DriveCapabilities:
    """Capabilities of a drive, as found during set-up.

    Attributes
    ----------
    identity
        Identity that the drive reports.
    watchdog, watchdog_timeout_s
        Watchdog that removes the torque if this computer stops communicating, and its timeout in
        seconds, which is infinite if there is no watchdog.
    missing_objects
        Requirements that the drive does not meet: the object is absent or not usable.
    assigned_objects
        Manufacturer-specific objects that the profile has set.
    """

    identity: dict[str, object]
    watchdog: Watchdog
    watchdog_timeout_s: float
    missing_objects: tuple[Requirement, ...]
    assigned_objects: tuple[str, ...]

    def has_object(self, index: int, subindex: int = 0) -> bool:
        """Return whether the drive has a usable object of the table of requirements.

        Parameters
        ----------
        index, subindex
            Index and sub-index of the object.
        """
        return requirement(index, subindex) not in self.missing_objects

    @property
    def accepted_missing_functions(self) -> tuple[str, ...]:
        """Names in ``cia402.accept_without`` of functions that this drive lacks."""
        function_names = [
            missing_object.acceptance_name
            for missing_object in self.missing_objects
            if missing_object.acceptance_name and missing_object.acceptance_name != WATCHDOG
        ]
        if self.watchdog is Watchdog.NONE:
            function_names.insert(0, WATCHDOG)
        return tuple(function_names)


def set_up_drive(port: CanPort, rig: RigParameters, drive_name: str) -> DriveCapabilities:
    """Verify and configure the drive by SDO; the drive stays pre-operational and disabled.

    No other code receives from the open port meanwhile. The profile needs a section ``cia402``.
    Raise `DeviceError` if the drive does not answer, is not the one of the profile, is in fault,
    lacks a required object, or rejects the configuration.
    """
    settings = rig.cia402
    assert settings is not None
    required_value_by_address = required_values(rig)
    with SdoAccess(port, settings.node_id, drive_name) as sdo:
        # First, before the identity is known: a killed session may have left the motor turning.
        command_voltage_off(sdo)
        sdo.enter_pre_operational()
        command_voltage_off(sdo)
        identity = _read_identity(sdo)
        try:
            eds_identity = sdo.load_eds(settings.eds) if settings.eds else (0, 0)
            _check_identity(identity, settings, drive_name, eds_identity)
        except DeviceError as error:
            raise DeviceError(f"{error}{describe_remaining_torque(sdo)}") from None
        wait_until_disabled(sdo, rig, drive_name)
        configuration = _DriveConfiguration(sdo, settings, drive_name, required_value_by_address)
        configuration.write_assigned_objects()
        configuration.check_rated_torque(identity, rig)
        configuration.check_gear_and_encoder(identity, rig)
        configuration.configure_torque()
        configuration.configure_speed()
        configuration.configure_sync()
        active_watchdog = configuration.configure_watchdog()
        configuration.configure_pdos(active_watchdog)
        configuration.read_stop_options(identity)
        configuration.set_object(requirement(objects.MODE))
        # Some drives show the mode only when enabled: it is checked again then.
        wait_for(
            lambda: sdo.read(objects.MODE_DISPLAY) == objects.CYCLIC_TORQUE_MODE,
            _MODE_DISPLAY_TIMEOUT_S,
        )
    return DriveCapabilities(
        identity,
        active_watchdog,
        {
            Watchdog.OWN: settings.own_watchdog_s,
            Watchdog.NONE: float("inf"),
        }.get(active_watchdog, settings.heartbeat_timeout_s),
        tuple(configuration.missing_objects),
        settings.set_objects,
    )


def _read_identity(sdo: SdoAccess) -> dict[str, object]:
    """Read the drive's identity by SDO: numbers, names and supported modes, by key.

    A number that the drive lacks is None, and a name that it lacks is an empty text.
    """
    identity: dict[str, object] = {}
    for subindex, key in enumerate(("vendor_id", "product_code", "revision", "serial_number"), 1):
        identity[key] = sdo.read_or_none(objects.IDENTITY, subindex)
    identity["device_name"] = sdo.read_text(objects.DEVICE_NAME)
    identity["software_version"] = sdo.read_text(objects.SOFTWARE_VERSION)
    identity["supported_modes"] = sdo.read_or_none(objects.SUPPORTED_MODES)
    return identity


def _check_identity(
    identity: dict[str, object],
    settings: ServoDrive,
    drive_name: str,
    eds_identity: tuple[int, int],
) -> None:
    """Raise if the drive's identity differs from that of the profile or of its EDS file.

    A drive without cyclic synchronous torque mode is refused as well.
    """
    eds_vendor, eds_product = eds_identity
    for key, requirement_source, required_number in (
        ("vendor_id", "cia402.vendor_id", settings.vendor_id),
        ("product_code", "cia402.product_code", settings.product_code),
        ("vendor_id", f"VendorNumber in {settings.eds}", eds_vendor),
        ("product_code", f"ProductNumber in {settings.eds}", eds_product),
    ):
        reported_number = identity[key]
        if required_number and reported_number != required_number:
            reported_text = "nothing" if reported_number is None else f"0x{reported_number:08X}"
            raise DeviceError(
                f"{drive_name}: it is another drive: {requirement_source} is "
                f"0x{required_number:08X}, but it reports {reported_text}. Check cia402.node_id, "
                "or enter the actual drive in the profile."
            )
    supported_mode_bits = identity["supported_modes"]
    if not (
        isinstance(supported_mode_bits, int)
        and supported_mode_bits & objects.CYCLIC_TORQUE_MODE_BIT
    ):
        raise DeviceError(
            f"{drive_name}: it has no cyclic synchronous torque mode over CANopen (object 6502 = "
            f"{value_text(supported_mode_bits)}, bit 9 is not set); this drive or its firmware "
            "cannot be used."
        )


class _DriveConfiguration:
    """Set-up of one disabled drive by SDO, which collects the objects that the drive lacks.

    `required_value_by_address` are the required values of the drive's objects, by index and
    sub-index.
    """

    def __init__(
        self,
        sdo: SdoAccess,
        settings: ServoDrive,
        drive_name: str,
        required_value_by_address: dict[tuple[int, int], int],
    ) -> None:
        self._sdo = sdo
        self._settings = settings
        self._name = drive_name
        self._required_value_by_address = required_value_by_address
        self.missing_objects: list[Requirement] = []

    def set_object(self, required_object: Requirement, required_value: int | None = None) -> bool:
        """Set an object to a value, unless it has that value; return whether the object exists.

        A write-only object is written and not read back, if `POSSIBLY_WRITE_ONLY_INDICES` lists it.
        If `required_value` is None, the value is the one that the constructor was given for the
        object. Raise `DeviceError` if the object is indispensable, or the drive stores a value that
        is not acceptable.
        """
        if required_value is None:
            required_value = self._required_value_by_address[
                required_object.index, required_object.subindex
            ]
        try:
            present_value = self._sdo.read_or_none(required_object.index, required_object.subindex)
        except SdoAbortError as refusal:
            if not (
                refusal.is_object_write_only
                and required_object.index in POSSIBLY_WRITE_ONLY_INDICES
            ):
                raise
            self._sdo.write(required_object.index, required_object.subindex, required_value)
            return True
        if present_value == required_value:
            return True
        try:
            self._sdo.configure(required_object.index, required_object.subindex, required_value)
        except ValueNotStoredError as not_stored:
            present_value = not_stored.value_read
            readback_error: DeviceError = not_stored
        except SdoAbortError as refusal:
            if present_value is None and refusal.is_object_absent:
                self._record_missing_object(required_object)
                return False
            if present_value is None:
                raise
            readback_error = DeviceError(
                f"{self._name}: object {required_object.address} ({required_object.name}) is "
                f"{value_text(present_value)} but must be {value_text(required_value)}, and the "
                f"drive refuses to change it (abort code 0x{refusal.code:08X}: "
                f"{_abort_meaning(refusal)}). {required_object.consequence}"
            )
        else:
            return True
        if required_object.value_rule.allows(present_value, required_value):
            return True
        if (
            required_object.acceptance_name == TORQUE_LIMIT
            and present_value >= required_value
            and self._accepts_absence(required_object)
        ):
            self._record_missing_object(required_object)
            return False
        raise readback_error

    def write_assigned_objects(self) -> None:
        """Write the manufacturer-specific objects that ``cia402.set_objects`` names."""
        for text in self._settings.set_objects:
            try:
                self._sdo.assign(parse_assignment(text))
            except (DeviceError, ValueError) as error:
                raise DeviceError(f'{error} (cia402.set_objects: "{text}")') from None

    def check_rated_torque(self, identity: dict[str, object], rig: RigParameters) -> None:
        """Raise if the drive's rated torque differs from that of the profile by more than 2 %.

        The rated torque is added to `identity`.
        """
        settings = self._settings
        rated_torque_counts = self._sdo.read_or_none(objects.RATED_TORQUE)
        identity["rated_torque_counts"] = rated_torque_counts
        required_object = requirement(objects.RATED_TORQUE)
        if rated_torque_counts is None:
            self.missing_objects.append(required_object)
        if settings.rated_torque_unit_nm == 0:
            return
        if rated_torque_counts is None:
            raise DeviceError(
                f"{self._name}: it has no object {required_object.address} "
                f"({required_object.name}). {required_object.consequence}"
            )
        reported_torque_nm = (
            rated_torque_counts * settings.rated_torque_unit_nm * settings.gear_ratio
        )
        profile_torque_nm = rig.motor.rated_torque_nm
        identity["rated_torque_nm"] = reported_torque_nm
        if (
            abs(reported_torque_nm - profile_torque_nm)
            > _MAX_RATED_TORQUE_DEVIATION * profile_torque_nm
        ):
            raise DeviceError(
                f"{self._name}: its rated torque (object 6076 = {rated_torque_counts}) is "
                f"{reported_torque_nm:.4g} N·m at the output shaft, but motor.rated_torque_nm is "
                f"{profile_torque_nm:.4g} N·m; every torque would be wrong by that ratio. Correct "
                "the profile or the drive."
            )

    def check_gear_and_encoder(self, identity: dict[str, object], rig: RigParameters) -> None:
        """Raise if the drive's gear ratio or encoder step differs from the profile's by over 2 %.

        Only values that the drive states are compared. Both values are added to `identity`.
        """
        drive_gear_ratio = self._read_ratio(objects.GEAR_RATIO)
        increments_per_turn = self._read_ratio(objects.ENCODER_RESOLUTION)
        feed_units_per_turn = self._read_ratio(objects.FEED_CONSTANT)
        profile_gear_ratio = self._settings.gear_ratio
        identity["gear_ratio"] = drive_gear_ratio
        if drive_gear_ratio is not None and not _is_ratio_equal(
            drive_gear_ratio, profile_gear_ratio
        ):
            raise DeviceError(
                f"{self._name}: its gear (object 6091) is {drive_gear_ratio:.5g} turns of the "
                "motor in one of the output shaft, but cia402.gear_ratio is "
                f"{profile_gear_ratio:.5g}. Correct the profile or the drive."
            )
        # Position units per revolution of the output shaft: encoder increments, unless the drive
        # has a feed constant that defines other units.
        increments_per_output_turn = (
            None
            if increments_per_turn is None
            else increments_per_turn * (drive_gear_ratio or profile_gear_ratio)
        )
        stated_units_per_turn = [
            units_per_turn
            for units_per_turn in (feed_units_per_turn, increments_per_output_turn)
            if units_per_turn is not None
        ]
        identity["encoder_step_rad"] = (
            tau / stated_units_per_turn[0] if stated_units_per_turn else None
        )
        profile_step_rad = rig.encoder.resolution_rad
        if not stated_units_per_turn or any(
            _is_ratio_equal(tau / units_per_turn, profile_step_rad)
            for units_per_turn in stated_units_per_turn
        ):
            return
        step_objects_text = (
            "6092"
            if feed_units_per_turn is not None
            else "608F"
            if drive_gear_ratio is None
            else "608F and 6091"
        )
        raise DeviceError(
            f"{self._name}: its encoder step (object {step_objects_text}) is "
            f"{tau / stated_units_per_turn[0]:.4g} rad at the output shaft "
            f"({stated_units_per_turn[0]:.6g} steps a turn), but encoder.resolution_rad is "
            f"{profile_step_rad:.4g} rad; every angle, speed and limit would be wrong by the ratio "
            f"{tau / stated_units_per_turn[0] / profile_step_rad:.3g}. Correct the profile or the "
            "drive."
        )

    def _read_ratio(self, index: int) -> float | None:
        """Return an object's sub-index 1 divided by its sub-index 2, or None if not stated.

        A ratio of 1 to 1 counts as not stated, since drives that were never configured have that
        value.
        """
        try:
            numerator = self._sdo.read_or_none(index, 1)
            denominator = self._sdo.read_or_none(index, 2)
        except SdoAbortError:
            return None
        if (
            numerator is None
            or denominator is None
            or numerator <= 0
            or denominator <= 0
            or numerator == denominator == 1
        ):
            return None
        return numerator / denominator

    def configure_torque(self) -> None:
        """Set the torque limits, and clear the torque offset and the polarity."""
        self.set_object(requirement(objects.MAX_TORQUE))
        for index in objects.TORQUE_LIMITS:
            if self._sdo.read_or_none(index) is not None:
                self.set_object(requirement(index))
        self._clear_object(requirement(objects.TORQUE_OFFSET))
        self._clear_object(requirement(objects.POLARITY))

    def configure_speed(self) -> None:
        """Write the profile's limit of the motor speed, in rpm, to the drive, if there is one."""
        if self._settings.max_speed_rad_s == 0:
            return
        required_object = requirement(objects.MAX_SPEED_RPM)
        if not self.set_object(required_object):
            raise DeviceError(
                f"{self._name}: it has no object {required_object.address} "
                f"({required_object.name}). {required_object.consequence}"
            )

    def configure_sync(self) -> None:
        """Set the SYNC period, and clear the SYNC window and counter."""
        sdo = self._sdo
        cob_id = sdo.read_or_none(objects.SYNC_COB_ID)
        required_object = requirement(objects.SYNC_COB_ID)
        if (
            cob_id is not None
            and cob_id & ~objects.PDO_DISABLED_BIT
            != self._required_value_by_address[required_object.index, 0]
        ):
            self.set_object(required_object)
        if sdo.read_or_none(objects.SYNC_OVERFLOW):
            # It may be changed only while the period is 0 (CiA 301).
            if sdo.read_or_none(objects.SYNC_PERIOD_US):
                self.set_object(requirement(objects.SYNC_PERIOD_US), 0)
            self._clear_object(requirement(objects.SYNC_OVERFLOW))
        self._clear_object(requirement(objects.SYNC_WINDOW_US))
        self.set_object(requirement(objects.SYNC_PERIOD_US))
        for subindex in (1, 2):
            self.set_object(requirement(objects.INTERPOLATION_TIME, subindex))

    def configure_watchdog(self) -> Watchdog:
        """Set up the watchdog by which the drive monitors this computer, and the drive's heartbeat.

        Return the kind of watchdog that is active.
        """
        settings, sdo = self._settings, self._sdo
        deadline_object = requirement(objects.RPDO_COMMUNICATION, objects.EVENT_TIMER_SUBINDEX)
        has_heartbeat_consumer = self._configure_heartbeat_consumer()
        has_rpdo_deadline = (
            sdo.read_or_none(deadline_object.index, deadline_object.subindex) is not None
        )
        active_watchdog = most_reliable_watchdog(
            has_heartbeat_consumer=has_heartbeat_consumer,
            has_rpdo_deadline=has_rpdo_deadline,
            has_own_watchdog=settings.own_watchdog_s > 0,
        )
        required_object = requirement(objects.HEARTBEAT_CONSUMER, 1)
        if not has_heartbeat_consumer:
            self.missing_objects.append(required_object)
        if active_watchdog is Watchdog.NONE and not self._accepts_absence(required_object):
            raise DeviceError(f"{self._name}: {required_object.refusal_reason()}")
        if active_watchdog in (Watchdog.HEARTBEAT, Watchdog.RPDO_DEADLINE):
            # The drive's own watchdog acts as its manufacturer defines, whatever is set here.
            self.set_object(requirement(objects.ABORT_OPTION))
        required_object = requirement(objects.COMMUNICATION_ERROR, 1)
        if not self.set_object(required_object) and settings.communication_error_option:
            raise DeviceError(
                f"{self._name}: it has no object {required_object.address} "
                f"({required_object.name}), so that it goes pre-operational on a lost connection; "
                "set cia402.communication_error_option = 0."
            )
        self.set_object(requirement(objects.HEARTBEAT_PRODUCER_MS))
        required_object = requirement(objects.EMERGENCY_COB_ID)
        if sdo.read_or_none(required_object.index) not in (
            None,
            self._required_value_by_address[required_object.index, 0],
        ):
            self.set_object(required_object)
        return active_watchdog

    def configure_pdos(self, active_watchdog: Watchdog) -> None:
        """Map and enable the one RPDO and the one TPDO that the rig uses; disable all others."""
        settings, sdo = self._settings, self._sdo
        for communication_index in (objects.TPDO_COMMUNICATION, objects.RPDO_COMMUNICATION):
            _disable_unused_pdos(sdo, communication_index)
        tpdo_entries: tuple[int, ...] = objects.TPDO_ENTRIES
        required_object = requirement(objects.ACTUAL_TORQUE)
        if sdo.read_or_none(objects.ACTUAL_TORQUE) is None and self._accepts_absence(
            required_object
        ):
            self._record_missing_object(required_object)
            tpdo_entries = tpdo_entries[:-1]
        self._configure_pdo(
            objects.TPDO_COMMUNICATION,
            objects.NO_REMOTE_REQUEST_BIT,
            tpdo_entries,
            {objects.INHIBIT_TIME_SUBINDEX: 0},
        )
        rpdo_deadline_ms = round(settings.heartbeat_timeout_s * 1000)
        self._configure_pdo(
            objects.RPDO_COMMUNICATION,
            0,
            objects.RPDO_ENTRIES,
            {objects.EVENT_TIMER_SUBINDEX: rpdo_deadline_ms}
            if active_watchdog is Watchdog.RPDO_DEADLINE
            else {},
        )

    def read_stop_options(self, identity: dict[str, object]) -> None:
        """Read the options for quick stop and fault reaction, and add them to `identity`."""
        for key, index in (
            ("quick_stop_option", objects.QUICK_STOP_OPTION),
            ("fault_reaction_option", objects.FAULT_REACTION_OPTION),
        ):
            option_value = self._sdo.read_or_none(index)
            if option_value is not None:
                identity[key] = option_value

    def _accepts_absence(self, required_object: Requirement) -> bool:
        """Return whether the profile accepts a drive that lacks an object."""
        return required_object.acceptance_name in self._settings.accept_without

    def _record_missing_object(self, required_object: Requirement) -> None:
        """Record that the drive lacks an object, or raise if it is indispensable."""
        refusal_reason = required_object.refusal_reason(self._settings.accept_without)
        if refusal_reason:
            raise DeviceError(f"{self._name}: {refusal_reason}")
        self.missing_objects.append(required_object)

    def _clear_object(self, required_object: Requirement) -> None:
        """Set an object to 0 if the drive has it; raise if rigd may not write to it."""
        present_value = self._sdo.read_or_none(required_object.index, required_object.subindex)
        if not present_value:
            return
        if ObjectAccess.WRITTEN_BY_SDO in required_object.access:
            self.set_object(required_object, 0)
            return
        raise DeviceError(
            f"{self._name}: object {required_object.address} ({required_object.name}) is "
            f"0x{present_value:02X}, not 0. {required_object.consequence}"
        )

    def _configure_heartbeat_consumer(self) -> bool:
        """Make the drive monitor this computer's heartbeat; return whether the drive can do so."""
        settings, sdo = self._settings, self._sdo
        index, host_id = objects.HEARTBEAT_CONSUMER, settings.host_node_id
        required_value = host_id << 16 | round(settings.heartbeat_timeout_s * 1000)
        present_value = sdo.read_or_none(index, 1)
        if present_value != required_value:
            # A second entry for one node is refused (0x06040043): clear stored entries first.
            for subindex in range(
                2, min(sdo.read_or_none(index) or 0, _MAX_HEARTBEAT_CONSUMERS) + 1
            ):
                stored_value = sdo.read_or_none(index, subindex)
                if stored_value is not None and stored_value >> 16 & 0x7F == host_id:
                    sdo.configure(index, subindex, 0)
            try:
                sdo.configure(index, 1, required_value)
            except SdoAbortError as refusal:
                if refusal.is_object_absent or refusal.code == _READ_ONLY_ABORT:
                    return False
                raise
        return True

    def _configure_pdo(
        self,
        communication_index: int,
        cob_id_flags: int,
        pdo_entries: tuple[int, ...],
        value_by_subindex: dict[int, int],
    ) -> None:
        """Map objects into a PDO and enable it; nothing is written if the PDO already is as needed.

        `communication_index` is the index of the PDO's communication parameters; the index of its
        mapping is 0x200 higher. `cob_id_flags` are additional bits of the PDO's COB-ID, and
        `pdo_entries` the mapping entries of the objects that it carries. `value_by_subindex` are
        the required values of further communication parameters by sub-index; a parameter that the
        drive does not have is skipped.
        """
        sdo, mapping_index = self._sdo, communication_index + 0x200
        required_cob_id = self._required_value_by_address[communication_index, 1] | cob_id_flags
        transmission_type = self._required_value_by_address[communication_index, 2]
        cob_id_mask = ALL_BITS_MASK & ~objects.NO_REMOTE_REQUEST_BIT
        is_mapped = self._holds_values(mapping_index, (len(pdo_entries), *pdo_entries))
        is_transmission_type_set = sdo.read_or_none(communication_index, 2) == transmission_type
        present_cob_id = sdo.read_or_none(communication_index, 1)
        wrong_parameters = {
            subindex: parameter_value
            for subindex, parameter_value in value_by_subindex.items()
            if sdo.read_or_none(communication_index, subindex) not in (None, parameter_value)
        }
        is_cob_id_set = (
            present_cob_id is not None and not (present_cob_id ^ required_cob_id) & cob_id_mask
        )
        if is_cob_id_set and is_mapped and is_transmission_type_set and not wrong_parameters:
            return
        sdo.configure(
            communication_index, 1, required_cob_id | objects.PDO_DISABLED_BIT, cob_id_mask
        )
        if not is_mapped:
            self._write_mapping(communication_index, mapping_index, pdo_entries)
        if not is_transmission_type_set:
            sdo.configure(communication_index, 2, transmission_type)
        for subindex, parameter_value in wrong_parameters.items():
            self.set_object(requirement(communication_index, subindex), parameter_value)
        sdo.configure(communication_index, 1, required_cob_id, cob_id_mask)

    def _write_mapping(
        self, communication_index: int, mapping_index: int, pdo_entries: tuple[int, ...]
    ) -> None:
        """Write the mapping entries of a disabled PDO."""
        sdo = self._sdo
        pdo_name = "RPDO1" if communication_index == objects.RPDO_COMMUNICATION else "TPDO1"
        try:
            sdo.configure(mapping_index, 0, 0)
        except SdoAbortError as refusal:
            raise DeviceError(f"{refusal} {requirement(mapping_index).consequence}") from None
        for subindex, mapping_entry in enumerate(pdo_entries, 1):
            try:
                sdo.configure(mapping_index, subindex, mapping_entry)
            except SdoAbortError as refusal:
                required_object = requirement(mapping_entry >> 16)
                if refusal.is_object_absent:
                    raise DeviceError(f"{self._name}: {required_object.refusal_reason()}") from None
                raise DeviceError(
                    f"{self._name}: it does not take object {required_object.address} "
                    f"({required_object.name}) into {pdo_name} (abort code 0x{refusal.code:08X}: "
                    f"{_abort_meaning(refusal)}). {required_object.consequence}"
                ) from None
        sdo.configure(mapping_index, 0, len(pdo_entries))

    def _holds_values(self, index: int, required_values: tuple[int, ...]) -> bool:
        """Return whether the sub-indices of an object, from 0 on, hold the given values."""
        return all(
            self._sdo.read_or_none(index, subindex) == held_value
            for subindex, held_value in enumerate(required_values)
        )


def _is_ratio_equal(drive_value: float, profile_value: float) -> bool:
    """Return whether a drive's value agrees with the profile's value within 2 %."""
    return abs(drive_value - profile_value) <= _GEAR_AND_ENCODER_TOLERANCE * profile_value


def _disable_unused_pdos(sdo: SdoAccess, communication_index: int) -> None:
    """Disable all PDOs of the drive except the first, which the rig uses."""
    for pdo_offset in range(1, objects.MAX_PDO_COUNT):
        cob_id = sdo.read_or_none(communication_index + pdo_offset, 1)
        if cob_id is None:
            # Above the PDOs that CiA 301 predefines, indices are used without gaps.
            if pdo_offset >= objects.PREDEFINED_PDO_COUNT:
                return
        elif not cob_id & objects.PDO_DISABLED_BIT:
            sdo.configure(communication_index + pdo_offset, 1, cob_id | objects.PDO_DISABLED_BIT)


def _abort_meaning(refusal: SdoAbortError) -> str:
    """Return the meaning of a refusal's SDO abort code in a few words."""
    return _ABORT_MEANINGS.get(refusal.code, "see CiA 301")
