"""Draft of a profile for a new drive, from its EDS file and another profile."""

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from rigd.devices import MAY_BE_UNKNOWN
from rigd.devices.cia402 import Grade, SuitabilityFinding, check_suitability
from rigd.devices.cia402.objects import MAX_SPEED_RPM, RATED_TORQUE
from rigd.devices.cia402.requirements import TORQUE_FEEDBACK, TORQUE_LIMIT, WATCHDOG
from rigd.devices.eds import Eds
from rigd.errors import FailureError
from rigd.profile._load import ProfileError, profile_of
from rigd.profile._schema import UNKNOWN, Profile, keys
from rigd.profile._write import Setting, SettingValue, with_head, with_settings

_ACCEPT = "cia402.accept_without"
_LIMIT = re.compile(r"(torque|current).*(limit|max)|(limit|max).*(torque|current)", re.IGNORECASE)
_MAKERS_OWN = range(0x2000, 0x6000)
_MOST_NAMED = 4


class UnusableDriveError(FailureError, ValueError):
    """The drive is unsuitable with any profile; the message names the missing features."""


@dataclass(frozen=True, slots=True)
class Question:
    """Question about a required setting that no EDS file states."""

    key: str
    text: str


QUESTIONS = (
    Question("can.channel", "CAN interface of this computer"),
    Question("cia402.node_id", "Node id that is set at the drive"),
    Question("cia402.gear_ratio", "Gear ratio, motor turns per turn of the output shaft"),
    Question(
        "cia402.rated_torque_unit_nm", "One count of object 6076, N·m (mN·m: 1e-3, µN·m: 1e-6)"
    ),
    Question("motor.rated_torque_nm", "Rated torque at the output shaft, N·m"),
    Question("motor.peak_torque_nm", "Peak torque at the output shaft, N·m"),
    Question("motor.continuous_torque_nm", "Continuous (rms) torque at the output shaft, N·m"),
    Question("motor.inertia_kg_m2", "Inertia of motor and gear at the output shaft, kg·m²"),
    Question("encoder.resolution_rad", "Encoder step at the output shaft, rad"),
)
"""Questions about the drive. Friction and delay are measured by rigd identify motor."""
_OTHER = "The previous value was of another drive."
_OWN_WATCHDOG = Question(
    "cia402.own_watchdog_s",
    "The drive's own watchdog that removes the torque if this computer stops communicating, s "
    "(0: none)",
)


class Draft:
    """Draft of a new profile, from the EDS file and the answers of the operator.

    Parameters
    ----------
    base
        Profile with the initial text and values.
    eds
        Content of the drive's EDS file.
    path
        Path of the file to write.

    Raises
    ------
    UnusableDriveError
        If the drive is unsuitable with any profile.
    ProfileError
        If the profile to start from has no CiA 402 drive.
    """

    def __init__(self, base: Profile, eds: Eds, path: Path) -> None:
        if base.rig.cia402 is None or base.rig.can is None:
            raise ProfileError(
                f"{base.path}: has no CiA 402 drive to put another in the place of; start from "
                "antenna_can or antenna_serial."
            )
        judgement = check_suitability(eds)
        if judgement.refusals:
            raise UnusableDriveError(
                f"{eds.path}: no session could be run with this drive, and no profile was "
                f"written: {' '.join(judgement.refusals)}"
            )
        self._base = base
        self._eds = eds
        self._path = path
        self._findings = judgement.findings
        self._accepted: list[str] = []
        self._settings = {setting.key: setting for setting in self._eds_settings()}
        # The base profile has another motor, gear and encoder: none of their values is used.
        for question in self.questions():
            if question.key in MAY_BE_UNKNOWN and question.key not in self._settings:
                self._settings[question.key] = Setting(question.key, math.nan, UNKNOWN)

    def _value(self, key: str) -> SettingValue:
        """Return the present value of a key."""
        if key in self._settings:
            return self._settings[key].value
        section, _, name = key.rpartition(".")
        of_section: object = getattr(self._base.rig, section)
        value: SettingValue = getattr(of_section, name)
        return value

    def answer(self, key: str, text: str) -> None:
        """Set the value of a key from an answer of the operator.

        Parameters
        ----------
        key
            Dotted key of the profile.
        text
            The answer. With ``unknown`` the value remains to be filled in, if this is possible.

        Raises
        ------
        ValueError
            If the value is invalid; the message states the valid values.
        """
        if text == UNKNOWN and key in MAY_BE_UNKNOWN:
            self._settings[key] = Setting(key, math.nan, UNKNOWN)
            return
        annotation: Any = keys()[key]
        try:
            value = TypeAdapter(annotation).validate_strings(text)
        except ValidationError as error:
            raise ValueError(error.errors(include_url=False)[0]["msg"]) from None
        if value != self._value(key):
            self._settings[key] = Setting(key, value, "datasheet")

    def shown(self, key: str) -> str:
        """Return the present value of a key as text, or ``unknown``.

        Parameters
        ----------
        key
            Dotted key of the profile.
        """
        return UNKNOWN if self._is_unknown(key) else str(self._value(key))

    def _is_unknown(self, key: str) -> bool:
        return key in self._settings and self._settings[key].source == UNKNOWN

    def unaccepted(self) -> list[SuitabilityFinding]:
        """Return the missing features of the drive that the profile does not accept.

        Raises
        ------
        ProfileError
            If the present values contradict one another.
        """
        accepted = Setting(_ACCEPT, tuple(self._accepted))
        text = with_settings(self._base.text, [*self._settings.values(), accepted])
        found = check_suitability(self._eds, profile_of(text, self._path).rig).findings
        return [each for each in found if each.accept and each.grade is Grade.REFUSED]

    def accept(self, name: str) -> None:
        """Accept a missing feature in the profile, by decision of the operator.

        Parameters
        ----------
        name
            One of `unaccepted`.
        """
        self._accepted.append(name)

    @property
    def doubts(self) -> list[str]:
        """Return remarks on this drive for the operator, in sentences."""
        findings = check_suitability(self._eds, profile_of(self._body(), self._path).rig).findings
        remarks = [f.sentence for f in findings if f.sentence]
        return remarks + [
            f"The file does not tell what {f.what} holds, which has to be {f.wanted}: "
            "rigd check asks the drive."
            for f in findings
            if f.grade is Grade.ASK and f.wanted
        ]

    def questions(self) -> list[Question]:
        """Return the questions about this drive."""
        more = (_OWN_WATCHDOG,) if WATCHDOG in self._lacks() else ()
        absent = set() if self._eds.get(RATED_TORQUE) else {"cia402.rated_torque_unit_nm"}
        return [each for each in (*QUESTIONS, *more) if each.key not in absent]

    def unanswered(self) -> list[Question]:
        """Return the questions without an answer: unknown, or as in the base profile."""
        answered = {
            key
            for key, setting in self._settings.items()
            if setting.reason != _OTHER and setting.source != UNKNOWN
        }
        return [each for each in self.questions() if each.key not in answered]

    def text(self) -> str:
        """Return the text of the profile.

        Raises
        ------
        ProfileError
            If its values contradict one another.
        """
        text = self._body()
        profile_of(text, self._path)
        return with_head(text, self._head())

    def _body(self) -> str:
        marked = [
            Setting(
                question.key,
                self._value(question.key),
                UNKNOWN if self._is_unknown(question.key) else "assumed",
                reason="TO FILL IN: " + question.text,
            )
            for question in self.unanswered()
        ]
        settings = [*self._settings.values(), *marked, *self._acceptance()]
        return with_settings(self._base.text, settings)

    def _acceptance(self) -> Iterator[Setting]:
        """Yield the acceptances of the operator; undecided ones are written as a comment."""
        left = [finding.accept for finding in self.unaccepted()]
        own = self._own_limits() if TORQUE_LIMIT in (*left, *self._accepted) else ""
        hint = (
            f" For a torque limit of its own see {own}, set by cia402.set_objects." if own else ""
        )
        if self._accepted:
            why = "The drive lacks, by its file, what these names stand for (docs/devices.md)."
            why += f" Not accepted, so that rigd refuses it: {', '.join(left)}." if left else ""
            yield Setting(_ACCEPT, tuple(self._accepted), reason=why + hint)
        elif left:
            why = (
                "TO FILL IN: the drive lacks, by its file, what these names stand for "
                "(docs/devices.md), and rigd refuses it. Take the # away, and from the list what "
                "must not be missing."
            )
            yield Setting(_ACCEPT, tuple(left), reason=why + hint, commented=True)
        elif self._base.rig.cia402 is not None and self._base.rig.cia402.accept_without:
            yield Setting(_ACCEPT, (), reason="The drive has, by its file, all that is needed.")

    def _lacks(self) -> list[str]:
        """Return the names of the missing features that a profile must accept."""
        return [finding.accept for finding in self._findings if finding.accept]

    def _eds_settings(self) -> Iterator[Setting]:
        """Yield the settings from the EDS file and those that follow from missing features."""
        eds, path = self._eds, self._path
        product = " ".join(filter(None, (eds.vendor_name, eds.product_name))) or "CiA 402 drive"
        yield Setting("name", path.stem)
        yield Setting("description", f"{product}, from {eds.path.name}")
        relative_path = os.path.relpath(eds.path.resolve(), path.resolve().parent)
        yield Setting(
            "cia402.eds", relative_path, reason="The file of the drive, from this folder on."
        )
        for key, number in (("vendor_id", eds.vendor_id), ("product_code", eds.product_code)):
            if number:
                yield Setting(f"cia402.{key}", number, "datasheet", hexadecimal=True)
        if eds.commissioned_node_id:
            why = "The node id for which the file configures the drive."
            yield Setting("cia402.node_id", eds.commissioned_node_id, "datasheet", why)
        can = self._base.rig.can
        if can is not None and eds.bit_rates_bit_s and can.bitrate_bit_s not in eds.bit_rates_bit_s:
            why = f"The drive has no {can.bitrate_bit_s / 1000:g} kbit/s; this is its highest."
            yield Setting("can.bitrate_bit_s", max(eds.bit_rates_bit_s), "datasheet", why)
        yield from self._of_the_other_drive()
        yield from self._absent()

    def _of_the_other_drive(self) -> Iterator[Setting]:
        """Yield the removal of settings that are specific to the drive of the base profile."""
        drive = self._base.rig.cia402
        assert drive is not None
        if drive.set_objects:
            yield Setting("cia402.set_objects", (), reason=_OTHER)
        if drive.own_watchdog_s:
            yield Setting("cia402.own_watchdog_s", 0.0, "assumed", _OTHER)

    def _absent(self) -> Iterator[Setting]:
        lacks = self._lacks()
        for missing, key, why in (
            (
                not self._eds.get(MAX_SPEED_RPM),
                "max_speed_rad_s",
                "6080 (max motor speed)",
            ),
            (
                not self._eds.get(RATED_TORQUE),
                "rated_torque_unit_nm",
                "6076 (rated torque)",
            ),
            (TORQUE_FEEDBACK in lacks, "torque_tolerance_percent", "6077 (actual torque)"),
        ):
            if missing:
                yield Setting(f"cia402.{key}", 0.0, "datasheet", f"The drive has no object {why}.")

    def _own_limits(self) -> str:
        """Return the manufacturer-specific objects that may limit the torque."""
        found = [
            f"{e.index:04X}:{e.sub:X} ({e.name}{'' if e.default is None else f', {e.default}'})"
            for e in self._eds.entries.values()
            if e.index in _MAKERS_OWN and e.writable and _LIMIT.search(e.name)
        ]
        return " or ".join(found[:_MOST_NAMED])

    def _head(self) -> list[str]:
        return [
            f"Written by rigd profiles new from {self._eds.path.name} and the profile "
            f"{self._base.name}.",
            "",
            "Without the hardware, a simulated rig speaks the same protocols in its place:",
            f"  rigd simulate --profile {self._path.name}",
            "",
            "Every number says where it comes from:",
            "  paper      printed in the paper (antenna, damping, encoder)",
            "  datasheet  told by the drive's file, or typed in from a data sheet",
            "  measured   on a rig or a computer, as said beside it",
            "  unknown    no value yet: rigd moves nothing before all of these are filled in, as",
            '             { value = 0.5, source = "datasheet" }',
            "  assumed    of the profile started from: check those marked TO FILL IN first",
            "Units are in the keys; angles and torques are at the output shaft, behind the gear.",
            *(
                ["", "Of this drive:", *(f"* {doubt}" for doubt in self.doubts)]
                if self.doubts
                else []
            ),
        ]
