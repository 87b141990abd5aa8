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
    SUBSTITUTED = "something else does its work"
    """The object is absent, and something else replaces it."""
    ASK = "the drive will be asked"
    """The file does not state the value; it is read from the drive when connected."""
    ACCEPTED = "the profile accepts that it is missing"
    """The object is absent, and the profile accepts that."""
    DOUBT = "a session can be run; somebody should check it"
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
_REPORTED_ELSEWHERE: Final = (objects.SUPPORTED_MODES, objects.IDENTITY)
"""Indices of objects that findings other than those of the table report."""


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
            if row.index in _REPORTED_ELSEWHERE or row.accept == WATCHDOG:
                continue
            entry = self._eds.get(row.index, row.sub)
            yield (self._absent_object(row) if entry is None else self._present_object(row, entry))

    def _identity_findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the findings on vendor and product code."""
        for key, stated, name in (
            ("vendor_id", self._eds.vendor_id, self._eds.vendor_name),
            ("product_code", self._eds.product_code, self._eds.product_name),
        ):
            what = key.replace("_", " ")
            wanted = getattr(self._settings, key) if self._settings else 0
            value_text = f"0x{stated:08X}" if stated else "not stated"
            found = f"{value_text} ({name})" if name else value_text
            if not (stated and wanted and stated != wanted):
                yield SuitabilityFinding(
                    what, found, f"0x{wanted:08X}" if wanted else "any", Grade.FITS
                )
                continue
            sentence = (
                f"The file is of another drive than the profile's: cia402.{key} is 0x{wanted:08X}, "
                f"the file says {value_text}."
            )
            yield SuitabilityFinding(what, found, f"0x{wanted:08X}", Grade.REFUSED, sentence)

    def _bit_rate_findings(self) -> Iterator[SuitabilityFinding]:
        """Yield the finding on the bit rates that the drive supports."""
        rates = self._eds.bit_rates_bit_s
        found = ", ".join(f"{rate // 1000}" for rate in rates)
        found = f"{found} kbit/s" if rates else "not stated"
        if self._rig is None or self._rig.can is None:
            yield SuitabilityFinding("bit rates", found, "", Grade.FITS)
            return
        rate = self._rig.can.bitrate_bit_s
        wanted = f"{rate / 1000:g} kbit/s"
        if not rates or rate in rates:
            yield SuitabilityFinding("bit rates", found, wanted, Grade.FITS)
            return
        sentence = (
            f"The drive has no bit rate of {wanted} (can.bitrate_bit_s); choose one of {found}."
        )
        yield SuitabilityFinding("bit rates", found, wanted, Grade.REFUSED, sentence)

    def _torque_mode_finding(self) -> SuitabilityFinding:
        """Return the finding on the cyclic synchronous torque mode."""
        what, wanted = (
            f"{objects.SUPPORTED_MODES:04X} Supported drive modes",
            "bit 9 (cyclic torque)",
        )
        modes = self._eds.get(objects.SUPPORTED_MODES)
        address = f"object {objects.SUPPORTED_MODES:04X}"
        if modes is None:
            sentence = f"No cyclic synchronous torque mode: {address} is missing."
            return SuitabilityFinding(what, "absent", wanted, Grade.REFUSED, sentence)
        if modes.default:
            value_text = f"0x{modes.default:X}"
            if modes.default & objects.SUPPORTS_CYCLIC_TORQUE:
                return SuitabilityFinding(what, value_text, wanted, Grade.FITS)
            sentence = (
                f"No cyclic synchronous torque mode: {address} = {value_text} lacks bit 9; this "
                "drive or its firmware cannot be used."
            )
            return SuitabilityFinding(what, value_text, wanted, Grade.REFUSED, sentence)
        return SuitabilityFinding(
            what, "the file does not state it; the drive will be asked", wanted, Grade.ASK
        )

    def _watchdog_finding(self) -> SuitabilityFinding:
        """Return the finding on the watchdog that removes the torque if this computer is silent."""
        found = self._expected_watchdog()
        what, wanted = "watchdog", "one of three"
        if found is Watchdog.HEARTBEAT:
            return SuitabilityFinding(what, found.value, wanted, Grade.FITS)
        if found is not Watchdog.NONE:
            return SuitabilityFinding(
                what, f"1016:1 absent; {found.value}", wanted, Grade.SUBSTITUTED
            )
        return self._missing_unless_accepted(
            requirement(objects.HEARTBEAT_CONSUMER, 1), what, "absent", wanted
        )

    def _expected_watchdog(self) -> Watchdog:
        """Return the kind of watchdog that the drive will use, according to file and profile."""
        heartbeat = self._eds.get(objects.HEARTBEAT_CONSUMER, 1)
        deadline = self._eds.get(objects.RPDO_COMMUNICATION, objects.EVENT_TIMER)
        return watchdog(
            heartbeat=heartbeat is not None and heartbeat.writable,
            rpdo_deadline=deadline is not None and deadline.writable,
            own=self._settings is not None and self._settings.own_watchdog_s > 0,
        )

    def _absent_object(self, row: Requirement) -> SuitabilityFinding:
        """Return the finding on a required object that the file does not contain."""
        what = f"{row.address} {row.name}"
        if row.core:
            return SuitabilityFinding(
                what, "absent", "core", Grade.REFUSED, _capitalise(row.refusal_reason())
            )
        if (
            row.index == objects.ABORT_OPTION
            and self._expected_watchdog() in _UNCONFIGURED_WATCHDOGS
        ):
            found = "absent; in its place: the manufacturer's own watchdog"
            return SuitabilityFinding(what, found, "", Grade.SUBSTITUTED)
        if row.accept:
            return self._missing_unless_accepted(row, what, "absent", "")
        if self._is_set_by_profile(row):
            sentence = f"it has no object {row.address} ({row.name}). {row.sentence}"
            return SuitabilityFinding(what, "absent", "", Grade.REFUSED, _capitalise(sentence))
        stand_in = f"; in its place: {row.stand_in}" if row.stand_in.strip("–") else ""
        return SuitabilityFinding(what, f"absent{stand_in}", "", Grade.SUBSTITUTED)

    def _missing_unless_accepted(
        self, row: Requirement, what: str, found: str, wanted: str
    ) -> SuitabilityFinding:
        """Return the finding on a missing object that the profile may accept by name."""
        stand_in = f" In its place: {row.stand_in}." if row.stand_in else ""
        if self._settings is not None and row.accept in self._settings.accept_without:
            found = f"{found}, accepted by the profile"
            sentence = f"{what}: {found}.{stand_in}"
            return SuitabilityFinding(what, found, wanted, Grade.ACCEPTED, sentence, row.accept)
        sentence = _capitalise(row.refusal_reason()) + stand_in
        # Without a profile, nobody could accept the missing object yet.
        grade = Grade.DOUBT if self._settings is None else Grade.REFUSED
        return SuitabilityFinding(what, found, wanted, grade, sentence, row.accept)

    def _is_set_by_profile(self, row: Requirement) -> bool:
        """Return whether the profile needs this object, because nothing else can do its work."""
        settings = self._settings
        if settings is None:
            return False
        return {
            (objects.MAX_SPEED_RPM, 0): settings.max_speed_rad_s > 0,
            (objects.RATED_TORQUE, 0): settings.rated_torque_unit_nm > 0,
            (objects.COMMUNICATION_ERROR, 1): settings.communication_error_option > 0,
        }.get((row.index, row.sub), False)

    def _present_object(self, row: Requirement, entry: EdsEntry) -> SuitabilityFinding:
        """Return the finding on a required object that the file contains."""
        what = f"{row.address} {row.name}"
        wanted = self._required_values.get((row.index, row.sub))
        wanted_text = "" if wanted is None else _format_value(row, wanted)
        default = "" if entry.default is None else f", {_format_value(row, entry.default)}"
        found = f"{entry.access}{default}"

        def objection(text: str, *, doubt: bool = False) -> SuitabilityFinding:
            sentence = _capitalise(f"its object {row.address} ({row.name}) {text}")
            grade = Grade.DOUBT if doubt else Grade.REFUSED
            return SuitabilityFinding(what, found, wanted_text, grade, sentence)

        if row.access & (ObjectAccess.SENT | ObjectAccess.RECEIVED):
            mapping_obstacle = self._describe_mapping_obstacle(entry)
            if mapping_obstacle and row.accept:
                return self._missing_unless_accepted(
                    row, what, f"{found}, {mapping_obstacle}", wanted_text
                )
            if mapping_obstacle:
                return objection(f"{mapping_obstacle}. {row.sentence}")
        if ObjectAccess.WRITE in row.access and not entry.writable:
            return self._read_only_object(row, entry, found, wanted)
        if ObjectAccess.READ in row.access and entry.access == "wo":
            return objection(
                f"is write-only: what it holds cannot be checked. {row.sentence}".rstrip(),
                doubt=row.index in MAY_BE_WRITE_ONLY,
            )
        if wanted is not None and not _is_within_limits(entry, wanted):
            limits = f"{_format_limit(row, entry.low)} to {_format_limit(row, entry.high)}"
            return objection(
                f"takes {limits}, not {wanted_text}. {row.sentence}", doubt=not row.core
            )
        return SuitabilityFinding(what, found, wanted_text, Grade.FITS)

    def _read_only_object(
        self, row: Requirement, entry: EdsEntry, found: str, wanted: int | None
    ) -> SuitabilityFinding:
        """Return the finding on a read-only object, whose fixed value may be acceptable."""
        what = f"{row.address} {row.name}"
        if row.value_rule is AllowedValue.AT_LEAST:
            wanted_text = f"at least {wanted or 'motor.peak_torque_nm'}"
        else:
            wanted_text = "" if wanted is None else _format_value(row, wanted)
        if row.index in _PDO_ENTRIES:
            default_entries = self._default_mapping(row.index)
            is_acceptable = (
                None if None in default_entries else default_entries == _PDO_ENTRIES[row.index]
            )
        elif wanted is None or entry.default is None:
            is_acceptable = None
        elif (row.index, row.sub) in _COB_ID_ADDRESSES:
            # Drives are free to set the bit that forbids remote requests.
            is_acceptable = (entry.default ^ wanted) & ~objects.NO_REMOTE_REQUEST == 0
            mapping = row.index + 0x200
            if (
                is_acceptable
                and mapping in _PDO_ENTRIES
                and self._default_mapping(mapping) != _PDO_ENTRIES[mapping]
            ):
                sentence = (
                    f"its object {row.address} ({row.name}) is read-only, so that the PDO "
                    f"cannot be switched off to be remapped. {row.sentence}"
                )
                return SuitabilityFinding(
                    what, found, wanted_text, Grade.REFUSED, _capitalise(sentence)
                )
        else:
            is_acceptable = row.value_rule.allows(entry.default, wanted)
        if is_acceptable:
            return SuitabilityFinding(what, f"{found}: it does", wanted_text, Grade.FITS)
        if is_acceptable is None and row.index != objects.CONTROLWORD:
            return SuitabilityFinding(
                what, f"{found}: the drive will be asked", wanted_text, Grade.ASK
            )
        sentence = (
            f"its object {row.address} ({row.name}) is read-only and does not hold what is "
            f"needed{f' ({wanted_text})' if wanted_text else ''}. {row.sentence}"
        )
        return SuitabilityFinding(what, found, wanted_text, Grade.REFUSED, _capitalise(sentence))

    def _describe_mapping_obstacle(self, entry: EdsEntry) -> str:
        """Return why an object cannot be mapped into its PDO, or an empty text if it can."""
        bits = _PDO_LENGTHS_BIT[entry.index]
        if entry.bits not in (None, bits):
            return f"has {entry.bits} bits, not {bits}"
        mapped_indices = {
            mapping_entry >> 16
            for index in _PDO_ENTRIES
            for mapping_entry in self._default_mapping(index)
            if mapping_entry
        }
        if not entry.mappable and entry.index not in mapped_indices:
            return "cannot be mapped into a PDO"
        return ""

    def _default_mapping(self, mapping: int) -> tuple[int | None, ...]:
        """Return the default mapping entries of a PDO in the file; None for a missing default."""
        count = self._eds.get(mapping, 0)
        default_entries = [
            self._eds.get(mapping, sub) for sub in range(1, 1 + min(_default_value(count) or 0, 64))
        ]
        return (
            tuple(map(_default_value, default_entries))
            if _default_value(count) is not None
            else (None,)
        )


def _default_value(entry: EdsEntry | None) -> int | None:
    """Return the default value of an entry, or None if entry or default are missing."""
    return None if entry is None else entry.default


def _is_within_limits(entry: EdsEntry, value: int) -> bool:
    """Return whether a value is within the limits of an object; inconsistent limits are ignored."""
    low, high = entry.low, entry.high
    if low is not None and high is not None and low > high:
        return True
    return (low is None or low <= value) and (high is None or value <= high)


def _format_value(row: Requirement, value: int) -> str:
    """Format a value for messages: CAN identifiers and large values in hexadecimal."""
    in_hex = value > 0xFFFF or (row.index, row.sub) in _COB_ID_ADDRESSES
    return f"0x{value:X}" if in_hex and value >= 0 else str(value)


def _format_limit(row: Requirement, value: int | None) -> str:
    """Format a limit of an object's value for messages."""
    return "anything" if value is None else _format_value(row, value)


def _capitalise(text: str) -> str:
    """Capitalise the first letter of a text that was meant to follow the name of a drive."""
    return text[0].upper() + text[1:]
