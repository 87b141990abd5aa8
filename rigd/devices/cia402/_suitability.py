"""Suitability of a drive for torque control, checked by its EDS file before it is connected.

The file is compared with the table of :mod:`rigd.devices.cia402.requirements`, which the set-up
uses, too. What the file does not state is read from the drive when it is connected.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from rigd.devices.cia402 import objects
from rigd.devices.cia402.requirements import (
    POSSIBLY_WRITE_ONLY_INDICES,
    REQUIREMENTS,
    WATCHDOG,
    AllowedValue,
    ObjectAccess,
    Requirement,
    Watchdog,
    most_reliable_watchdog,
    profile_independent_values,
    required_values,
    requirement,
)
from rigd.devices.eds import Eds, EdsEntry

if TYPE_CHECKING:
    from rigd.devices.parameters import RigParameters, ServoDrive


class Grade(Enum):
    """Result of checking one requirement against a drive's EDS file."""

    FITS = "as needed"
    """The object is as needed."""
    SUBSTITUTED = "a substitute is used"
    """The object is absent, and something else replaces it."""
    ASK = "rigd reads it from the drive"
    """The file does not state the value; it is read from the drive when connected."""
    ACCEPTED = "the profile accepts that it is missing"
    """The object is absent, and the profile accepts that."""
    DOUBT = "a session can be run; check the object"
    """A session can be run, but the operator should check the object."""
    REFUSED = "no session with this drive"
    """No session is possible with this drive."""


@dataclass(frozen=True, slots=True)
class SuitabilityFinding:
    """Finding about one object of a drive, or about the drive as a whole."""

    checked_item: str
    """Object or property that was checked, such as ``6072 Max torque``."""
    stated_text: str
    """What the EDS file states about it."""
    required_text: str
    """Value that rigd needs; empty if every value is accepted or none is known."""
    grade: Grade
    """Result of the check."""
    consequence: str = ""
    """Consequence of a refusal or doubt, and the remedy, for the operator; else empty."""
    acceptance_name: str = ""
    """Name in ``cia402.accept_without`` by which a profile may accept the finding; else empty."""


@dataclass(frozen=True, slots=True)
class SuitabilityReport:
    """Result of checking a drive's EDS file against the requirements."""

    findings: tuple[SuitabilityFinding, ...]
    """One finding for each requirement, and for identity, bit rate, torque mode and watchdog."""

    @property
    def refusals(self) -> tuple[str, ...]:
        """Reasons why no session is possible with this drive, one sentence each."""
        return tuple(f.consequence for f in self.findings if f.grade is Grade.REFUSED)


_REQUIRED_ENTRIES_BY_MAPPING: Final = {
    objects.RPDO_MAPPING: objects.RPDO_ENTRIES,
    objects.TPDO_MAPPING: objects.TPDO_ENTRIES,
}
"""Required mapping entries by the index of the mapping."""
_LENGTH_BIT_BY_MAPPED_INDEX: Final = {
    entry >> 16: entry & 0xFF
    for entries in _REQUIRED_ENTRIES_BY_MAPPING.values()
    for entry in entries
}
"""Length in bits of each mapped object, by its index."""
_COB_ID_ADDRESSES: Final = (
    (objects.SYNC_COB_ID, 0),
    (objects.EMERGENCY_COB_ID, 0),
    (objects.TPDO_COMMUNICATION, 1),
    (objects.RPDO_COMMUNICATION, 1),
)
"""Index and sub-index of the objects that hold a CAN identifier."""
_UNCONFIGURED_WATCHDOGS: Final = (Watchdog.OWN, Watchdog.NONE)
"""Kinds of watchdog that rigd does not configure in the drive."""
_SEPARATELY_REPORTED_INDICES: Final = (objects.SUPPORTED_MODES, objects.IDENTITY)
"""Indices of objects in the table of requirements that have findings of their own."""


def check_suitability(eds: Eds, rig: "RigParameters | None" = None) -> SuitabilityReport:
    """Check a drive's EDS file against the requirements on its object dictionary.

    Parameters
    ----------
    eds
        Content of the drive's EDS file, read for the node number of the profile.
    rig
        Parameters of a profile with a section ``cia402``, whose values are compared, too. None:
        only the drive is checked, and what a profile could accept is not refused.
    """
    return SuitabilityReport(tuple(_SuitabilityCheck(eds, rig).findings()))


class _SuitabilityCheck:
    """Check of one EDS file against the requirements, and against a profile if there is one."""

    def __init__(self, eds: Eds, rig: "RigParameters | None") -> None:
        self._eds = eds
        self._rig = rig if rig is not None and rig.cia402 is not None else None
        self._settings: ServoDrive | None = self._rig.cia402 if self._rig else None
        self._required_value_by_address = (
            required_values(self._rig) if self._rig else profile_independent_values(eds.node_id)
        )

    def findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the findings on identity, bit rate, torque mode, watchdog and all other objects."""
        yield from self._identity_findings()
        yield from self._bit_rate_findings()
        yield self._torque_mode_finding()
        yield self._watchdog_finding()
        for required_object in REQUIREMENTS:
            if (
                required_object.index in _SEPARATELY_REPORTED_INDICES
                or required_object.acceptance_name == WATCHDOG
            ):
                continue
            eds_entry = self._eds.get(required_object.index, required_object.subindex)
            yield (
                self._absent_object_finding(required_object)
                if eds_entry is None
                else self._present_object_finding(required_object, eds_entry)
            )

    def _identity_findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the findings on vendor and product code."""
        for key, stated_number, identity_name in (
            ("vendor_id", self._eds.vendor_id, self._eds.vendor_name),
            ("product_code", self._eds.product_code, self._eds.product_name),
        ):
            object_text = key.replace("_", " ")
            wanted_number = getattr(self._settings, key) if self._settings else 0
            value_text = f"0x{stated_number:08X}" if stated_number else "not stated"
            found_text = f"{value_text} ({identity_name})" if identity_name else value_text
            if not (stated_number and wanted_number and stated_number != wanted_number):
                yield SuitabilityFinding(
                    object_text,
                    found_text,
                    f"0x{wanted_number:08X}" if wanted_number else "any",
                    Grade.FITS,
                )
                continue
            consequence = (
                f"The file describes another drive than the profile: cia402.{key} is "
                f"0x{wanted_number:08X}, but the file states {value_text}."
            )
            yield SuitabilityFinding(
                object_text,
                found_text,
                f"0x{wanted_number:08X}",
                Grade.REFUSED,
                consequence,
            )

    def _bit_rate_findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the finding on the bit rates that the drive supports."""
        supported_rates = self._eds.bit_rates_bit_s
        bit_rates_text = ", ".join(
            f"{supported_rate // 1000}" for supported_rate in supported_rates
        )
        bit_rates_text = f"{bit_rates_text} kbit/s" if supported_rates else "not stated"
        if self._rig is None or self._rig.can is None:
            yield SuitabilityFinding("bit rates", bit_rates_text, "", Grade.FITS)
            return
        profile_rate = self._rig.can.bitrate_bit_s
        wanted_text = f"{profile_rate / 1000:g} kbit/s"
        if not supported_rates or profile_rate in supported_rates:
            yield SuitabilityFinding("bit rates", bit_rates_text, wanted_text, Grade.FITS)
            return
        consequence = (
            f"The drive has no bit rate of {wanted_text} (can.bitrate_bit_s); "
            f"choose one of {bit_rates_text}."
        )
        yield SuitabilityFinding(
            "bit rates", bit_rates_text, wanted_text, Grade.REFUSED, consequence
        )

    def _torque_mode_finding(self) -> SuitabilityFinding:
        """Return the finding on the cyclic synchronous torque mode."""
        object_text, wanted_text = (
            f"{objects.SUPPORTED_MODES:04X} Supported drive modes",
            "bit 9 (cyclic torque)",
        )
        modes_entry = self._eds.get(objects.SUPPORTED_MODES)
        object_address = f"object {objects.SUPPORTED_MODES:04X}"
        if modes_entry is None:
            consequence = f"No cyclic synchronous torque mode: {object_address} is missing."
            return SuitabilityFinding(
                object_text, "absent", wanted_text, Grade.REFUSED, consequence
            )
        if modes_entry.default_value:
            value_text = f"0x{modes_entry.default_value:X}"
            if modes_entry.default_value & objects.CYCLIC_TORQUE_MODE_BIT:
                return SuitabilityFinding(object_text, value_text, wanted_text, Grade.FITS)
            consequence = (
                f"No cyclic synchronous torque mode: {object_address} = {value_text} lacks bit 9; "
                "this drive or its firmware cannot be used."
            )
            return SuitabilityFinding(
                object_text, value_text, wanted_text, Grade.REFUSED, consequence
            )
        return SuitabilityFinding(
            object_text,
            "the file does not state it; rigd reads it from the drive",
            wanted_text,
            Grade.ASK,
        )

    def _watchdog_finding(self) -> SuitabilityFinding:
        """Return the finding on the watchdog that removes the torque if the computer is silent."""
        expected_watchdog = self._expected_watchdog()
        checked_item, wanted_text = "watchdog", "one of three"
        if expected_watchdog is Watchdog.HEARTBEAT:
            return SuitabilityFinding(
                checked_item, expected_watchdog.value, wanted_text, Grade.FITS
            )
        if expected_watchdog is not Watchdog.NONE:
            return SuitabilityFinding(
                checked_item,
                f"1016:1 absent; {expected_watchdog.value}",
                wanted_text,
                Grade.SUBSTITUTED,
            )
        return self._acceptable_absence_finding(
            requirement(objects.HEARTBEAT_CONSUMER, 1), checked_item, "absent", wanted_text
        )

    def _expected_watchdog(self) -> Watchdog:
        """Return the kind of watchdog that the drive will use, judging by EDS file and profile."""
        heartbeat_entry = self._eds.get(objects.HEARTBEAT_CONSUMER, 1)
        deadline_entry = self._eds.get(objects.RPDO_COMMUNICATION, objects.EVENT_TIMER_SUBINDEX)
        return most_reliable_watchdog(
            has_heartbeat_consumer=heartbeat_entry is not None and heartbeat_entry.is_writable,
            has_rpdo_deadline=deadline_entry is not None and deadline_entry.is_writable,
            has_own_watchdog=self._settings is not None and self._settings.own_watchdog_s > 0,
        )

    def _absent_object_finding(self, required_object: Requirement) -> SuitabilityFinding:
        """Return the finding on a required object that the EDS file does not contain."""
        object_text = f"{required_object.address} {required_object.name}"
        if required_object.is_core:
            return SuitabilityFinding(
                object_text,
                "absent",
                "core",
                Grade.REFUSED,
                _capitalise(required_object.refusal_reason()),
            )
        if (
            required_object.index == objects.ABORT_OPTION
            and self._expected_watchdog() in _UNCONFIGURED_WATCHDOGS
        ):
            found_text = "absent; in its place: the manufacturer's own watchdog"
            return SuitabilityFinding(object_text, found_text, "", Grade.SUBSTITUTED)
        if required_object.acceptance_name:
            return self._acceptable_absence_finding(required_object, object_text, "absent", "")
        if self._is_set_by_profile(required_object):
            consequence = (
                f"it has no object {required_object.address} ({required_object.name}). "
                f"{required_object.consequence}"
            )
            return SuitabilityFinding(
                object_text, "absent", "", Grade.REFUSED, _capitalise(consequence)
            )
        replacement_text = (
            f"; in its place: {required_object.replacement}"
            if required_object.replacement.strip("–")
            else ""
        )
        return SuitabilityFinding(object_text, f"absent{replacement_text}", "", Grade.SUBSTITUTED)

    def _acceptable_absence_finding(
        self, required_object: Requirement, object_text: str, found_text: str, wanted_text: str
    ) -> SuitabilityFinding:
        """Return the finding on a missing object that the profile may accept by name."""
        replacement_text = (
            f" In its place: {required_object.replacement}." if required_object.replacement else ""
        )
        if (
            self._settings is not None
            and required_object.acceptance_name in self._settings.accept_without
        ):
            found_text = f"{found_text}, accepted by the profile"
            consequence = f"{object_text}: {found_text}.{replacement_text}"
            return SuitabilityFinding(
                object_text,
                found_text,
                wanted_text,
                Grade.ACCEPTED,
                consequence,
                required_object.acceptance_name,
            )
        consequence = _capitalise(required_object.refusal_reason()) + replacement_text
        # Without a profile, nobody could accept the missing object yet.
        grade = Grade.DOUBT if self._settings is None else Grade.REFUSED
        return SuitabilityFinding(
            object_text,
            found_text,
            wanted_text,
            grade,
            consequence,
            required_object.acceptance_name,
        )

    def _is_set_by_profile(self, required_object: Requirement) -> bool:
        """Return whether the profile sets a value that only this object can give the drive."""
        settings = self._settings
        if settings is None:
            return False
        return {
            (objects.MAX_SPEED_RPM, 0): settings.max_speed_rad_s > 0,
            (objects.RATED_TORQUE, 0): settings.rated_torque_unit_nm > 0,
            (objects.COMMUNICATION_ERROR, 1): settings.communication_error_option > 0,
        }.get((required_object.index, required_object.subindex), False)

    def _present_object_finding(
        self, required_object: Requirement, eds_entry: EdsEntry
    ) -> SuitabilityFinding:
        """Return the finding on a required object that the EDS file contains."""
        object_text = f"{required_object.address} {required_object.name}"
        wanted_value = self._required_value_by_address.get(
            (required_object.index, required_object.subindex)
        )
        wanted_text = "" if wanted_value is None else _format_value(required_object, wanted_value)
        default_text = (
            ""
            if eds_entry.default_value is None
            else f", {_format_value(required_object, eds_entry.default_value)}"
        )
        found_text = f"{eds_entry.access_right}{default_text}"

        def doubt_or_refusal(objection_text: str, *, is_doubt: bool = False) -> SuitabilityFinding:
            consequence = _capitalise(
                f"its object {required_object.address} ({required_object.name}) {objection_text}"
            )
            grade = Grade.DOUBT if is_doubt else Grade.REFUSED
            return SuitabilityFinding(object_text, found_text, wanted_text, grade, consequence)

        if required_object.access & (ObjectAccess.SENT_IN_TPDO | ObjectAccess.RECEIVED_IN_RPDO):
            mapping_refusal = self._describe_unmappable_object(eds_entry)
            if mapping_refusal and required_object.acceptance_name:
                return self._acceptable_absence_finding(
                    required_object, object_text, f"{found_text}, {mapping_refusal}", wanted_text
                )
            if mapping_refusal:
                return doubt_or_refusal(f"{mapping_refusal}. {required_object.consequence}")
        if ObjectAccess.WRITTEN_BY_SDO in required_object.access and not eds_entry.is_writable:
            return self._read_only_object_finding(
                required_object, eds_entry, found_text, wanted_value
            )
        if ObjectAccess.READ_BY_SDO in required_object.access and eds_entry.access_right == "wo":
            return doubt_or_refusal(
                "is write-only: its value cannot be checked. "
                f"{required_object.consequence}".rstrip(),
                is_doubt=required_object.index in POSSIBLY_WRITE_ONLY_INDICES,
            )
        if wanted_value is not None and not _is_within_limits(eds_entry, wanted_value):
            limits_text = (
                f"{_format_limit(required_object, eds_entry.lower_limit)} to "
                f"{_format_limit(required_object, eds_entry.upper_limit)}"
            )
            return doubt_or_refusal(
                f"takes {limits_text}, not {wanted_text}. {required_object.consequence}",
                is_doubt=not required_object.is_core,
            )
        return SuitabilityFinding(object_text, found_text, wanted_text, Grade.FITS)

    def _read_only_object_finding(
        self,
        required_object: Requirement,
        eds_entry: EdsEntry,
        found_text: str,
        required_value: int | None,
    ) -> SuitabilityFinding:
        """Return the finding on a read-only object, whose fixed value may be acceptable."""
        object_text = f"{required_object.address} {required_object.name}"
        if required_object.value_rule is AllowedValue.AT_LEAST:
            wanted_text = f"at least {required_value or 'motor.peak_torque_nm'}"
        else:
            wanted_text = (
                "" if required_value is None else _format_value(required_object, required_value)
            )
        if required_object.index in _REQUIRED_ENTRIES_BY_MAPPING:
            default_entries = self._default_mapping(required_object.index)
            is_acceptable = (
                None
                if None in default_entries
                else default_entries == _REQUIRED_ENTRIES_BY_MAPPING[required_object.index]
            )
        elif required_value is None or eds_entry.default_value is None:
            is_acceptable = None
        elif (required_object.index, required_object.subindex) in _COB_ID_ADDRESSES:
            # Drives are free to set the bit that forbids remote requests.
            is_acceptable = (
                eds_entry.default_value ^ required_value
            ) & ~objects.NO_REMOTE_REQUEST_BIT == 0
            mapping_index = required_object.index + 0x200
            if (
                is_acceptable
                and mapping_index in _REQUIRED_ENTRIES_BY_MAPPING
                and self._default_mapping(mapping_index)
                != _REQUIRED_ENTRIES_BY_MAPPING[mapping_index]
            ):
                consequence = (
                    f"its object {required_object.address} ({required_object.name}) is read-only, "
                    "so that the PDO cannot be switched off to be remapped. "
                    f"{required_object.consequence}"
                )
                return SuitabilityFinding(
                    object_text,
                    found_text,
                    wanted_text,
                    Grade.REFUSED,
                    _capitalise(consequence),
                )
        else:
            is_acceptable = required_object.value_rule.allows(
                eds_entry.default_value, required_value
            )
        if is_acceptable:
            return SuitabilityFinding(
                object_text, f"{found_text}: it does", wanted_text, Grade.FITS
            )
        if is_acceptable is None and required_object.index != objects.CONTROLWORD:
            return SuitabilityFinding(
                object_text, f"{found_text}: rigd reads it from the drive", wanted_text, Grade.ASK
            )
        consequence = (
            f"its object {required_object.address} ({required_object.name}) is read-only and does "
            f"not have the required value{f' ({wanted_text})' if wanted_text else ''}. "
            f"{required_object.consequence}"
        )
        return SuitabilityFinding(
            object_text, found_text, wanted_text, Grade.REFUSED, _capitalise(consequence)
        )

    def _describe_unmappable_object(self, eds_entry: EdsEntry) -> str:
        """Return why an object cannot be mapped into its PDO, or an empty text if it can."""
        required_length_bit = _LENGTH_BIT_BY_MAPPED_INDEX[eds_entry.index]
        if eds_entry.length_bit not in (None, required_length_bit):
            return f"has {eds_entry.length_bit} bits, not {required_length_bit}"
        mapped_indices = {
            mapping_entry >> 16
            for index in _REQUIRED_ENTRIES_BY_MAPPING
            for mapping_entry in self._default_mapping(index)
            if mapping_entry
        }
        if not eds_entry.is_mappable and eds_entry.index not in mapped_indices:
            return "cannot be mapped into a PDO"
        return ""

    def _default_mapping(self, mapping_index: int) -> tuple[int | None, ...]:
        """Return a PDO's default mapping entries in the EDS file; None for an unstated entry."""
        count_entry = self._eds.get(mapping_index, 0)
        default_entries = [
            self._eds.get(mapping_index, subindex)
            for subindex in range(1, 1 + min(_default_value(count_entry) or 0, 64))
        ]
        return (
            tuple(map(_default_value, default_entries))
            if _default_value(count_entry) is not None
            else (None,)
        )


def _default_value(eds_entry: EdsEntry | None) -> int | None:
    """Return the default value of an EDS entry, or None if entry or default is missing."""
    return None if eds_entry is None else eds_entry.default_value


def _is_within_limits(eds_entry: EdsEntry, required_value: int) -> bool:
    """Return whether a value is within the limits of an object; inconsistent limits are ignored."""
    lower_limit, upper_limit = eds_entry.lower_limit, eds_entry.upper_limit
    if lower_limit is not None and upper_limit is not None and lower_limit > upper_limit:
        return True
    return (lower_limit is None or lower_limit <= required_value) and (
        upper_limit is None or required_value <= upper_limit
    )


def _format_value(required_object: Requirement, object_value: int) -> str:
    """Format a value for messages: CAN identifiers and large values in hexadecimal."""
    is_shown_in_hex = (
        object_value > 0xFFFF
        or (required_object.index, required_object.subindex) in _COB_ID_ADDRESSES
    )
    return f"0x{object_value:X}" if is_shown_in_hex and object_value >= 0 else str(object_value)


def _format_limit(required_object: Requirement, limit_value: int | None) -> str:
    """Format a limit of an object's value for messages."""
    return "anything" if limit_value is None else _format_value(required_object, limit_value)


def _capitalise(sentence: str) -> str:
    """Return a text with a capital first letter, so that it can begin a sentence."""
    return sentence[0].upper() + sentence[1:]
