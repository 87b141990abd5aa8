"""Suitability of a drive for torque control, checked by its EDS file before it is connected.

The file is compared with the table of :mod:`rigd.devices.cia402.requirements`, which the set-up
goes by. What it does not state is read from the drive when it is connected.
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
    fixed_values,
    requirement,
    wanted_values,
    watchdog,
)
from rigd.devices.eds import Eds, EdsEntry

if TYPE_CHECKING:
    from rigd.devices.parameters import RigParameters, ServoDrive


class Grade(Enum):
    """Grade of an object by the file."""

    FITS = "as needed"
    SUBSTITUTED = "something else does its work"
    ASK = "the drive will be asked"
    ACCEPTED = "the profile accepts that it is missing"
    DOUBT = "a session can be run; somebody should check it"
    REFUSED = "no session with this drive"


@dataclass(frozen=True, slots=True)
class SuitabilityFinding:
    """Finding about one object, or about the drive as a whole."""

    what: str
    """``6072 Max torque``, or in words."""
    found: str
    """What the file states."""
    wanted: str
    """What rigd needs; empty: nothing certain."""
    grade: Grade
    """What that means for the drive."""
    sentence: str = ""
    """What follows from a refusal or doubt, and the remedy, for the operator."""
    accept: str = ""
    """Name by which the profile may accept it (``cia402.accept_without``)."""


@dataclass(frozen=True, slots=True)
class SuitabilityReport:
    """All findings on one file."""

    findings: tuple[SuitabilityFinding, ...]

    @property
    def refusals(self) -> tuple[str, ...]:
        """Sentences, one for each reason against this drive."""
        return tuple(f.sentence for f in self.findings if f.grade is Grade.REFUSED)


_PDO_ENTRIES: Final = {
    objects.RPDO_MAPPING: objects.RPDO_ENTRIES,
    objects.TPDO_MAPPING: objects.TPDO_ENTRIES,
}
_LENGTHS: Final = {
    entry >> 16: entry & 0xFF for entries in _PDO_ENTRIES.values() for entry in entries
}
"""Bits that each mapped object has in its PDO."""
_COB_IDS: Final = (
    (objects.SYNC_COB_ID, 0),
    (objects.EMERGENCY_COB_ID, 0),
    (objects.TPDO_COMMUNICATION, 1),
    (objects.RPDO_COMMUNICATION, 1),
)
_NOT_SET_BY_RIGD: Final = (Watchdog.OWN, Watchdog.NONE)
_REPORTED_ELSEWHERE: Final = (objects.SUPPORTED_MODES, objects.IDENTITY)


def check_suitability(eds: Eds, rig: "RigParameters | None" = None) -> SuitabilityReport:
    """Check a drive's EDS file against the requirements.

    Parameters
    ----------
    eds
        Read for the node id of the profile.
    rig
        Parameters of a profile with a section ``cia402``, whose values are compared too; None: the
        drive alone is judged, and what a profile may accept counts as accepted.
    """
    return SuitabilityReport(tuple(_SuitabilityCheck(eds, rig).findings()))


class _SuitabilityCheck:
    def __init__(self, eds: Eds, rig: "RigParameters | None") -> None:
        self._eds = eds
        self._rig = rig if rig is not None and rig.cia402 is not None else None
        self._settings: ServoDrive | None = self._rig.cia402 if self._rig else None
        self._wanted = wanted_values(self._rig) if self._rig else fixed_values(eds.node_id)

    def findings(self) -> Iterator[SuitabilityFinding]:
        yield from self._identity()
        yield from self._bit_rates()
        yield self._torque_mode()
        yield self._watchdog()
        for needed in REQUIREMENTS:
            if needed.index in _REPORTED_ELSEWHERE or needed.accept == WATCHDOG:
                continue
            entry = self._eds.get(needed.index, needed.sub)
            yield self._absent(needed) if entry is None else self._present(needed, entry)

    def _identity(self) -> Iterator[SuitabilityFinding]:
        for key, stated, name in (
            ("vendor_id", self._eds.vendor_id, self._eds.vendor_name),
            ("product_code", self._eds.product_code, self._eds.product_name),
        ):
            what = key.replace("_", " ")
            wanted = getattr(self._settings, key) if self._settings else 0
            shown = f"0x{stated:08X}" if stated else "not stated"
            found = f"{shown} ({name})" if name else shown
            if not (stated and wanted and stated != wanted):
                yield SuitabilityFinding(
                    what, found, f"0x{wanted:08X}" if wanted else "any", Grade.FITS
                )
                continue
            sentence = (
                f"The file is of another drive than the profile's: cia402.{key} is 0x{wanted:08X}, "
                f"the file says {shown}."
            )
            yield SuitabilityFinding(what, found, f"0x{wanted:08X}", Grade.REFUSED, sentence)

    def _bit_rates(self) -> Iterator[SuitabilityFinding]:
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

    def _torque_mode(self) -> SuitabilityFinding:
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
            shown = f"0x{modes.default:X}"
            if modes.default & objects.SUPPORTS_CYCLIC_TORQUE:
                return SuitabilityFinding(what, shown, wanted, Grade.FITS)
            sentence = (
                f"No cyclic synchronous torque mode: {address} = {shown} lacks bit 9; this drive "
                "or its firmware cannot be used."
            )
            return SuitabilityFinding(what, shown, wanted, Grade.REFUSED, sentence)
        return SuitabilityFinding(
            what, "the file does not state it; the drive will be asked", wanted, Grade.ASK
        )

    def _watchdog(self) -> SuitabilityFinding:
        """Check which watchdog removes the torque when this computer falls silent."""
        found = self._expected_watchdog()
        what, wanted = "watchdog", "one of three"
        if found is Watchdog.HEARTBEAT:
            return SuitabilityFinding(what, found.value, wanted, Grade.FITS)
        if found is not Watchdog.NONE:
            return SuitabilityFinding(
                what, f"1016:1 absent; {found.value}", wanted, Grade.SUBSTITUTED
            )
        return self._to_accept(requirement(objects.HEARTBEAT_CONSUMER, 1), what, "absent", wanted)

    def _expected_watchdog(self) -> Watchdog:
        heartbeat = self._eds.get(objects.HEARTBEAT_CONSUMER, 1)
        deadline = self._eds.get(objects.RPDO_COMMUNICATION, objects.EVENT_TIMER)
        return watchdog(
            heartbeat=heartbeat is not None and heartbeat.writable,
            rpdo_deadline=deadline is not None and deadline.writable,
            own=self._settings is not None and self._settings.own_watchdog_s > 0,
        )

    def _absent(self, needed: Requirement) -> SuitabilityFinding:
        what = f"{needed.address} {needed.name}"
        if needed.core:
            return SuitabilityFinding(
                what, "absent", "core", Grade.REFUSED, _sentence(needed.missing())
            )
        if needed.index == objects.ABORT_OPTION and self._expected_watchdog() in _NOT_SET_BY_RIGD:
            found = "absent; in its place: the manufacturer's own watchdog"
            return SuitabilityFinding(what, found, "", Grade.SUBSTITUTED)
        if needed.accept:
            return self._to_accept(needed, what, "absent", "")
        if self._is_set_by_profile(needed):
            sentence = f"it has no object {needed.address} ({needed.name}). {needed.sentence}"
            return SuitabilityFinding(what, "absent", "", Grade.REFUSED, _sentence(sentence))
        stand_in = f"; in its place: {needed.stand_in}" if needed.stand_in.strip("–") else ""
        return SuitabilityFinding(what, f"absent{stand_in}", "", Grade.SUBSTITUTED)

    def _to_accept(
        self, needed: Requirement, what: str, found: str, wanted: str
    ) -> SuitabilityFinding:
        """Return the finding on a missing object that the profile may accept by name."""
        stand_in = f" In its place: {needed.stand_in}." if needed.stand_in else ""
        if self._settings is not None and needed.accept in self._settings.accept_without:
            found = f"{found}, accepted by the profile"
            sentence = f"{what}: {found}.{stand_in}"
            return SuitabilityFinding(what, found, wanted, Grade.ACCEPTED, sentence, needed.accept)
        sentence = _sentence(needed.missing()) + stand_in
        # Without a profile there was no chance to accept it.
        grade = Grade.DOUBT if self._settings is None else Grade.REFUSED
        return SuitabilityFinding(what, found, wanted, grade, sentence, needed.accept)

    def _is_set_by_profile(self, needed: Requirement) -> bool:
        """Whether the profile asks for what only this object can do."""
        settings = self._settings
        if settings is None:
            return False
        return {
            (objects.MAX_SPEED_RPM, 0): settings.max_speed_rad_s > 0,
            (objects.RATED_TORQUE, 0): settings.rated_torque_unit_nm > 0,
            (objects.COMMUNICATION_ERROR, 1): settings.communication_error_option > 0,
        }.get((needed.index, needed.sub), False)

    def _present(self, needed: Requirement, entry: EdsEntry) -> SuitabilityFinding:
        what = f"{needed.address} {needed.name}"
        wanted = self._wanted.get((needed.index, needed.sub))
        wanted_text = "" if wanted is None else _shown(needed, wanted)
        default = "" if entry.default is None else f", {_shown(needed, entry.default)}"
        found = f"{entry.access}{default}"

        def objection(text: str, *, doubt: bool = False) -> SuitabilityFinding:
            sentence = _sentence(f"its object {needed.address} ({needed.name}) {text}")
            grade = Grade.DOUBT if doubt else Grade.REFUSED
            return SuitabilityFinding(what, found, wanted_text, grade, sentence)

        if needed.access & (ObjectAccess.SENT | ObjectAccess.RECEIVED):
            trouble = self._unmappable(entry)
            if trouble and needed.accept:
                return self._to_accept(needed, what, f"{found}, {trouble}", wanted_text)
            if trouble:
                return objection(f"{trouble}. {needed.sentence}")
        if ObjectAccess.WRITE in needed.access and not entry.writable:
            return self._read_only(needed, entry, found, wanted)
        if ObjectAccess.READ in needed.access and entry.access == "wo":
            return objection(
                f"is write-only: what it holds cannot be checked. {needed.sentence}".rstrip(),
                doubt=needed.index in MAY_BE_WRITE_ONLY,
            )
        if wanted is not None and not _takes(entry, wanted):
            limits = f"{_limit(needed, entry.low)} to {_limit(needed, entry.high)}"
            return objection(
                f"takes {limits}, not {wanted_text}. {needed.sentence}", doubt=not needed.core
            )
        return SuitabilityFinding(what, found, wanted_text, Grade.FITS)

    def _read_only(
        self, needed: Requirement, entry: EdsEntry, found: str, wanted: int | None
    ) -> SuitabilityFinding:
        """Return the finding on a read-only object: its value may be acceptable."""
        what = f"{needed.address} {needed.name}"
        if needed.fit is AllowedValue.AT_LEAST:
            wanted_text = f"at least {wanted or 'motor.peak_torque_nm'}"
        else:
            wanted_text = "" if wanted is None else _shown(needed, wanted)
        if needed.index in _PDO_ENTRIES:
            held = self._mapped(needed.index)
            does = None if None in held else held == _PDO_ENTRIES[needed.index]
        elif wanted is None or entry.default is None:
            does = None
        elif (needed.index, needed.sub) in _COB_IDS:
            # Drives are free to set the bit that forbids remote requests.
            does = (entry.default ^ wanted) & ~objects.NO_REMOTE_REQUEST == 0
            mapping = needed.index + 0x200
            if does and mapping in _PDO_ENTRIES and self._mapped(mapping) != _PDO_ENTRIES[mapping]:
                sentence = (
                    f"its object {needed.address} ({needed.name}) is read-only, so that the PDO "
                    f"cannot be switched off to be remapped. {needed.sentence}"
                )
                return SuitabilityFinding(
                    what, found, wanted_text, Grade.REFUSED, _sentence(sentence)
                )
        else:
            does = needed.fit.allows(entry.default, wanted)
        if does:
            return SuitabilityFinding(what, f"{found}: it does", wanted_text, Grade.FITS)
        if does is None and needed.index != objects.CONTROLWORD:
            return SuitabilityFinding(
                what, f"{found}: the drive will be asked", wanted_text, Grade.ASK
            )
        sentence = (
            f"its object {needed.address} ({needed.name}) is read-only and does not hold what is "
            f"needed{f' ({wanted_text})' if wanted_text else ''}. {needed.sentence}"
        )
        return SuitabilityFinding(what, found, wanted_text, Grade.REFUSED, _sentence(sentence))

    def _unmappable(self, entry: EdsEntry) -> str:
        """Describe why an object cannot be mapped into its PDO; empty if it can."""
        bits = _LENGTHS[entry.index]
        if entry.bits not in (None, bits):
            return f"has {entry.bits} bits, not {bits}"
        mapped = {held >> 16 for index in _PDO_ENTRIES for held in self._mapped(index) if held}
        if not entry.mappable and entry.index not in mapped:
            return "cannot be mapped into a PDO"
        return ""

    def _mapped(self, mapping: int) -> tuple[int | None, ...]:
        """Return the entries of a mapping as the file has them."""
        count = self._eds.get(mapping, 0)
        held = [self._eds.get(mapping, sub) for sub in range(1, 1 + min(_default(count) or 0, 64))]
        return tuple(map(_default, held)) if _default(count) is not None else (None,)


def _default(entry: EdsEntry | None) -> int | None:
    return None if entry is None else entry.default


def _takes(entry: EdsEntry, value: int) -> bool:
    """Whether a value is within the limits of an object, where it has any that make sense."""
    low, high = entry.low, entry.high
    if low is not None and high is not None and low > high:
        return True
    return (low is None or low <= value) and (high is None or value <= high)


def _shown(needed: Requirement, value: int) -> str:
    """Return a value as messages show it: identifiers and codes in hexadecimal."""
    in_hex = value > 0xFFFF or (needed.index, needed.sub) in _COB_IDS
    return f"0x{value:X}" if in_hex and value >= 0 else str(value)


def _limit(needed: Requirement, value: int | None) -> str:
    return "anything" if value is None else _shown(needed, value)


def _sentence(text: str) -> str:
    """Make a sentence of one that goes on after the name of a drive."""
    return text[0].upper() + text[1:]
