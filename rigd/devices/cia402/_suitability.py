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
    MAY_BE_WRITE_ONLY,
    REQUIREMENTS,
    WATCHDOG,
    AllowedValue,
    ObjectAccess,
    Requirement,
    Watchdog,
    profile_independent_values,
    required_values,
    requirement,
    watchdog,
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

    what: str
    """Object or property that was checked, such as ``6072 Max torque``."""
    found: str
    """What the EDS file states about it."""
    wanted: str
    """Value that rigd needs; empty if every value is accepted or none is known."""
    grade: Grade
    """Result of the check."""
    sentence: str = ""
    """Consequence of a refusal or doubt, and the remedy, for the operator; else empty."""
    accept: str = ""
    """Name in ``cia402.accept_without`` by which a profile may accept the finding; else empty."""


@dataclass(frozen=True, slots=True)
class SuitabilityReport:
    """Result of checking a drive's EDS file against the requirements."""

    findings: tuple[SuitabilityFinding, ...]
    """One finding for each requirement, and for identity, bit rate, torque mode and watchdog."""

    @property
    def refusals(self) -> tuple[str, ...]:
        """Reasons why no session is possible with this drive, one sentence each."""
        return tuple(f.sentence for f in self.findings if f.grade is Grade.REFUSED)


_PDO_ENTRIES: Final = {
    objects.RPDO_MAPPING: objects.RPDO_ENTRIES,
    objects.TPDO_MAPPING: objects.TPDO_ENTRIES,
}
"""Required mapping entries by the index of the mapping."""
_PDO_LENGTHS_BIT: Final = {
    entry >> 16: entry & 0xFF for entries in _PDO_ENTRIES.values() for entry in entries
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
        self._required_values = (
            required_values(self._rig) if self._rig else profile_independent_values(eds.node_id)
        )

    def findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the findings on identity, bit rate, torque mode, watchdog and all other objects."""
        yield from self._identity_findings()
        yield from self._bit_rate_findings()
        yield self._torque_mode_finding()
        yield self._watchdog_finding()
        for row in REQUIREMENTS:
            if row.index in _SEPARATELY_REPORTED_INDICES or row.accept == WATCHDOG:
                continue
            eds_entry = self._eds.get(row.index, row.sub)
            yield (
                self._absent_object(row)
                if eds_entry is None
                else self._present_object(row, eds_entry)
            )

    def _identity_findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the findings on vendor and product code."""
        for key, stated_number, identity_key in (
            ("vendor_id", self._eds.vendor_id, self._eds.vendor_name),
            ("product_code", self._eds.product_code, self._eds.product_name),
        ):
            object_text = key.replace("_", " ")
            wanted_text = getattr(self._settings, key) if self._settings else 0
            value_text = f"0x{stated_number:08X}" if stated_number else "not stated"
            found_text = f"{value_text} ({identity_key})" if identity_key else value_text
            if not (stated_number and wanted_text and stated_number != wanted_text):
                yield SuitabilityFinding(
                    object_text,
                    found_text,
                    f"0x{wanted_text:08X}" if wanted_text else "any",
                    Grade.FITS,
                )
                continue
            sentence = (
                f"The file describes another drive than the profile: cia402.{key} is "
                f"0x{wanted_text:08X}, but the file states {value_text}."
            )
            yield SuitabilityFinding(
                object_text, found_text, f"0x{wanted_text:08X}", Grade.REFUSED, sentence
            )

    def _bit_rate_findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the finding on the bit rates that the drive supports."""
        supported_rates = self._eds.bit_rates_bit_s
        found = ", ".join(f"{profile_rate // 1000}" for profile_rate in supported_rates)
        found = f"{found} kbit/s" if supported_rates else "not stated"
        if self._rig is None or self._rig.can is None:
            yield SuitabilityFinding("bit rates", found, "", Grade.FITS)
            return
        profile_rate = self._rig.can.bitrate_bit_s
        wanted_text = f"{profile_rate / 1000:g} kbit/s"
        if not supported_rates or profile_rate in supported_rates:
            yield SuitabilityFinding("bit rates", found, wanted_text, Grade.FITS)
            return
        sentence = (
            f"The drive has no bit rate of {wanted_text} (can.bitrate_bit_s); "
            f"choose one of {found}."
        )
        yield SuitabilityFinding("bit rates", found, wanted_text, Grade.REFUSED, sentence)

    def _torque_mode_finding(self) -> SuitabilityFinding:
        """Return the finding on the cyclic synchronous torque mode."""
        object_text, wanted_text = (
            f"{objects.SUPPORTED_MODES:04X} Supported drive modes",
            "bit 9 (cyclic torque)",
        )
        modes_entry = self._eds.get(objects.SUPPORTED_MODES)
        object_address = f"object {objects.SUPPORTED_MODES:04X}"
        if modes_entry is None:
            sentence = f"No cyclic synchronous torque mode: {object_address} is missing."
            return SuitabilityFinding(object_text, "absent", wanted_text, Grade.REFUSED, sentence)
        if modes_entry.default:
            value_text = f"0x{modes_entry.default:X}"
            if modes_entry.default & objects.CYCLIC_TORQUE_MODE_BIT:
                return SuitabilityFinding(object_text, value_text, wanted_text, Grade.FITS)
            sentence = (
                f"No cyclic synchronous torque mode: {object_address} = {value_text} lacks bit 9; "
                "this drive or its firmware cannot be used."
            )
            return SuitabilityFinding(object_text, value_text, wanted_text, Grade.REFUSED, sentence)
        return SuitabilityFinding(
            object_text,
            "the file does not state it; rigd reads it from the drive",
            wanted_text,
            Grade.ASK,
        )

    def _watchdog_finding(self) -> SuitabilityFinding:
        """Return the finding on the watchdog that removes the torque if the computer is silent."""
        found_watchdog = self._expected_watchdog()
        checked_item, wanted_text = "watchdog", "one of three"
        if found_watchdog is Watchdog.HEARTBEAT:
            return SuitabilityFinding(checked_item, found_watchdog.value, wanted_text, Grade.FITS)
        if found_watchdog is not Watchdog.NONE:
            return SuitabilityFinding(
                checked_item,
                f"1016:1 absent; {found_watchdog.value}",
                wanted_text,
                Grade.SUBSTITUTED,
            )
        return self._missing_unless_accepted(
            requirement(objects.HEARTBEAT_CONSUMER, 1), checked_item, "absent", wanted_text
        )

    def _expected_watchdog(self) -> Watchdog:
        """Return the kind of watchdog that the drive will use, judging by EDS file and profile."""
        heartbeat_entry = self._eds.get(objects.HEARTBEAT_CONSUMER, 1)
        deadline_entry = self._eds.get(objects.RPDO_COMMUNICATION, objects.EVENT_TIMER)
        return watchdog(
            heartbeat=heartbeat_entry is not None and heartbeat_entry.writable,
            rpdo_deadline=deadline_entry is not None and deadline_entry.writable,
            own=self._settings is not None and self._settings.own_watchdog_s > 0,
        )

    def _absent_object(self, row: Requirement) -> SuitabilityFinding:
        """Return the finding on a required object that the EDS file does not contain."""
        object_text = f"{row.address} {row.name}"
        if row.core:
            return SuitabilityFinding(
                object_text, "absent", "core", Grade.REFUSED, _capitalise(row.refusal_reason())
            )
        if (
            row.index == objects.ABORT_OPTION
            and self._expected_watchdog() in _UNCONFIGURED_WATCHDOGS
        ):
            found_text = "absent; in its place: the manufacturer's own watchdog"
            return SuitabilityFinding(object_text, found_text, "", Grade.SUBSTITUTED)
        if row.accept:
            return self._missing_unless_accepted(row, object_text, "absent", "")
        if self._is_set_by_profile(row):
            sentence = f"it has no object {row.address} ({row.name}). {row.sentence}"
            return SuitabilityFinding(
                object_text, "absent", "", Grade.REFUSED, _capitalise(sentence)
            )
        stand_in = f"; in its place: {row.stand_in}" if row.stand_in.strip("–") else ""
        return SuitabilityFinding(object_text, f"absent{stand_in}", "", Grade.SUBSTITUTED)

    def _missing_unless_accepted(
        self, row: Requirement, object_text: str, found_text: str, wanted_text: str
    ) -> SuitabilityFinding:
        """Return the finding on a missing object that the profile may accept by name."""
        stand_in = f" In its place: {row.stand_in}." if row.stand_in else ""
        if self._settings is not None and row.accept in self._settings.accept_without:
            found_text = f"{found_text}, accepted by the profile"
            sentence = f"{object_text}: {found_text}.{stand_in}"
            return SuitabilityFinding(
                object_text, found_text, wanted_text, Grade.ACCEPTED, sentence, row.accept
            )
        sentence = _capitalise(row.refusal_reason()) + stand_in
        # Without a profile, nobody could accept the missing object yet.
        grade = Grade.DOUBT if self._settings is None else Grade.REFUSED
        return SuitabilityFinding(object_text, found_text, wanted_text, grade, sentence, row.accept)

    def _is_set_by_profile(self, row: Requirement) -> bool:
        """Return whether the profile sets a value that only this object can give the drive."""
        settings = self._settings
        if settings is None:
            return False
        return {
            (objects.MAX_SPEED_RPM, 0): settings.max_speed_rad_s > 0,
            (objects.RATED_TORQUE, 0): settings.rated_torque_unit_nm > 0,
            (objects.COMMUNICATION_ERROR, 1): settings.communication_error_option > 0,
        }.get((row.index, row.sub), False)

    def _present_object(self, row: Requirement, eds_entry: EdsEntry) -> SuitabilityFinding:
        """Return the finding on a required object that the EDS file contains."""
        object_text = f"{row.address} {row.name}"
        wanted_value = self._required_values.get((row.index, row.sub))
        wanted_text = "" if wanted_value is None else _format_value(row, wanted_value)
        default_text = (
            "" if eds_entry.default is None else f", {_format_value(row, eds_entry.default)}"
        )
        found_text = f"{eds_entry.access}{default_text}"

        def objection(objection_text: str, *, doubt: bool = False) -> SuitabilityFinding:
            sentence = _capitalise(f"its object {row.address} ({row.name}) {objection_text}")
            grade = Grade.DOUBT if doubt else Grade.REFUSED
            return SuitabilityFinding(object_text, found_text, wanted_text, grade, sentence)

        if row.access & (ObjectAccess.SENT | ObjectAccess.RECEIVED):
            mapping_obstacle = self._describe_mapping_obstacle(eds_entry)
            if mapping_obstacle and row.accept:
                return self._missing_unless_accepted(
                    row, object_text, f"{found_text}, {mapping_obstacle}", wanted_text
                )
            if mapping_obstacle:
                return objection(f"{mapping_obstacle}. {row.sentence}")
        if ObjectAccess.WRITE in row.access and not eds_entry.writable:
            return self._read_only_object(row, eds_entry, found_text, wanted_value)
        if ObjectAccess.READ in row.access and eds_entry.access == "wo":
            return objection(
                f"is write-only: its value cannot be checked. {row.sentence}".rstrip(),
                doubt=row.index in MAY_BE_WRITE_ONLY,
            )
        if wanted_value is not None and not _is_within_limits(eds_entry, wanted_value):
            limits_text = (
                f"{_format_limit(row, eds_entry.low)} to {_format_limit(row, eds_entry.high)}"
            )
            return objection(
                f"takes {limits_text}, not {wanted_text}. {row.sentence}", doubt=not row.core
            )
        return SuitabilityFinding(object_text, found_text, wanted_text, Grade.FITS)

    def _read_only_object(
        self, row: Requirement, eds_entry: EdsEntry, found_text: str, wanted: int | None
    ) -> SuitabilityFinding:
        """Return the finding on a read-only object, whose fixed value may be acceptable."""
        object_text = f"{row.address} {row.name}"
        if row.value_rule is AllowedValue.AT_LEAST:
            wanted_text = f"at least {wanted or 'motor.peak_torque_nm'}"
        else:
            wanted_text = "" if wanted is None else _format_value(row, wanted)
        if row.index in _PDO_ENTRIES:
            default_entries = self._default_mapping(row.index)
            is_acceptable = (
                None if None in default_entries else default_entries == _PDO_ENTRIES[row.index]
            )
        elif wanted is None or eds_entry.default is None:
            is_acceptable = None
        elif (row.index, row.sub) in _COB_ID_ADDRESSES:
            # Drives are free to set the bit that forbids remote requests.
            is_acceptable = (eds_entry.default ^ wanted) & ~objects.NO_REMOTE_REQUEST_BIT == 0
            mapping_index = row.index + 0x200
            if (
                is_acceptable
                and mapping_index in _PDO_ENTRIES
                and self._default_mapping(mapping_index) != _PDO_ENTRIES[mapping_index]
            ):
                sentence = (
                    f"its object {row.address} ({row.name}) is read-only, so that the PDO "
                    f"cannot be switched off to be remapped. {row.sentence}"
                )
                return SuitabilityFinding(
                    object_text, found_text, wanted_text, Grade.REFUSED, _capitalise(sentence)
                )
        else:
            is_acceptable = row.value_rule.allows(eds_entry.default, wanted)
        if is_acceptable:
            return SuitabilityFinding(
                object_text, f"{found_text}: it does", wanted_text, Grade.FITS
            )
        if is_acceptable is None and row.index != objects.CONTROLWORD:
            return SuitabilityFinding(
                object_text, f"{found_text}: rigd reads it from the drive", wanted_text, Grade.ASK
            )
        sentence = (
            f"its object {row.address} ({row.name}) is read-only and does not have the required "
            f"value{f' ({wanted_text})' if wanted_text else ''}. {row.sentence}"
        )
        return SuitabilityFinding(
            object_text, found_text, wanted_text, Grade.REFUSED, _capitalise(sentence)
        )

    def _describe_mapping_obstacle(self, eds_entry: EdsEntry) -> str:
        """Return why an object cannot be mapped into its PDO, or an empty text if it can."""
        length_bit = _PDO_LENGTHS_BIT[eds_entry.index]
        if eds_entry.bits not in (None, length_bit):
            return f"has {eds_entry.bits} bits, not {length_bit}"
        mapped_indices = {
            mapping_entry >> 16
            for index in _PDO_ENTRIES
            for mapping_entry in self._default_mapping(index)
            if mapping_entry
        }
        if not eds_entry.mappable and eds_entry.index not in mapped_indices:
            return "cannot be mapped into a PDO"
        return ""

    def _default_mapping(self, mapping_index: int) -> tuple[int | None, ...]:
        """Return a PDO's default mapping entries in the EDS file; None for an unstated entry."""
        count_entry = self._eds.get(mapping_index, 0)
        default_entries = [
            self._eds.get(mapping_index, sub)
            for sub in range(1, 1 + min(_default_value(count_entry) or 0, 64))
        ]
        return (
            tuple(map(_default_value, default_entries))
            if _default_value(count_entry) is not None
            else (None,)
        )


def _default_value(eds_entry: EdsEntry | None) -> int | None:
    """Return the default value of an EDS entry, or None if entry or default is missing."""
    return None if eds_entry is None else eds_entry.default


def _is_within_limits(eds_entry: EdsEntry, value: int) -> bool:
    """Return whether a value is within the limits of an object; inconsistent limits are ignored."""
    lower_limit, upper_limit = eds_entry.low, eds_entry.high
    if lower_limit is not None and upper_limit is not None and lower_limit > upper_limit:
        return True
    return (lower_limit is None or lower_limit <= value) and (
        upper_limit is None or value <= upper_limit
    )


def _format_value(row: Requirement, value: int) -> str:
    """Format a value for messages: CAN identifiers and large values in hexadecimal."""
    in_hex = value > 0xFFFF or (row.index, row.sub) in _COB_ID_ADDRESSES
    return f"0x{value:X}" if in_hex and value >= 0 else str(value)


def _format_limit(row: Requirement, value: int | None) -> str:
    """Format a limit of an object's value for messages."""
    return "anything" if value is None else _format_value(row, value)


def _capitalise(sentence: str) -> str:
    """Return a text with a capital first letter, so that it can begin a sentence."""
    return sentence[0].upper() + sentence[1:]
