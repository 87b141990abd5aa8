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
from rigd.profile._load import ProfileError, profile_from_text
from rigd.profile._schema import UNKNOWN_SOURCE, Profile, key_types
from rigd.profile._write import Setting, SettingValue, with_head, with_settings

_ACCEPT_WITHOUT_KEY = "cia402.accept_without"
"""Key of the profile with the missing features of the drive that the operator accepts."""
_TORQUE_LIMIT_NAME_PATTERN = re.compile(
    r"(torque|current).*(limit|max)|(limit|max).*(torque|current)", re.IGNORECASE
)
"""Pattern of names of objects that may limit the torque."""
_MANUFACTURER_INDICES = range(0x2000, 0x6000)
"""Indices of manufacturer-specific CANopen objects."""
_MAX_NAMED_OBJECTS = 4
"""Largest number of manufacturer-specific objects that a comment names."""


class UnusableDriveError(FailureError, ValueError):
    """The drive is unsuitable, whatever the profile; the message names the missing features."""


@dataclass(frozen=True, slots=True)
class Question:
    """Question to the operator about a required setting that no EDS file states."""

    profile_key: str
    """Dotted key of the setting in the profile."""
    question_text: str
    """Question with the unit of the answer."""


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
"""Questions about every drive, except friction and delay, which rigd identify motor measures."""
_OTHER_DRIVE_COMMENT = "The previous value was of another drive."
"""Comment on a setting whose value is reset."""
_OWN_WATCHDOG_QUESTION = Question(  # Question about drives without a watchdog over CANopen
    "cia402.own_watchdog_s",
    "The drive's own watchdog that removes the torque if this computer stops communicating, s "
    "(0: none)",
)


class Draft:
    """Draft of a profile for a new drive, from its EDS file and the operator's answers.

    Parameters
    ----------
    base_profile
        Profile whose text and values the draft starts from.
    eds
        Content of the drive's EDS file.
    path
        Path of the profile to be written.

    Raises
    ------
    UnusableDriveError
        If the drive is unsuitable with any profile.
    ProfileError
        If the profile to start from has no CiA 402 drive.
    """

    def __init__(self, base_profile: Profile, eds: Eds, path: Path) -> None:
        if base_profile.rig.cia402 is None or base_profile.rig.can is None:
            raise ProfileError(
                f"{base_profile.path}: has no CiA 402 drive that another can replace; start from "
                "antenna_can or antenna_serial."
            )
        suitability = check_suitability(eds)
        if suitability.refusals:
            raise UnusableDriveError(
                f"{eds.path}: no session could be run with this drive, and no profile was "
                f"written: {' '.join(suitability.refusals)}"
            )
        self._base = base_profile
        self._eds = eds
        self._path = path
        self._findings = suitability.findings
        self._accepted: list[str] = []
        self._settings = {
            reset_setting.profile_key: reset_setting for reset_setting in self._eds_settings()
        }
        # The base profile has another motor, gear and encoder: none of their values is used.
        for open_question in self.questions():
            if (
                open_question.profile_key in MAY_BE_UNKNOWN
                and open_question.profile_key not in self._settings
            ):
                self._settings[open_question.profile_key] = Setting(
                    open_question.profile_key, math.nan, UNKNOWN_SOURCE
                )

    def _draft_value(self, profile_key: str) -> SettingValue:
        """Return the value of a key in the draft."""
        if profile_key in self._settings:
            return self._settings[profile_key].new_value
        section_name, _, field_name = profile_key.rpartition(".")
        section_settings: object = getattr(self._base.rig, section_name)
        setting_value: SettingValue = getattr(section_settings, field_name)
        return setting_value

    def answer(self, profile_key: str, answer_text: str) -> None:
        """Set the value of a key of the draft from the operator's answer.

        Parameters
        ----------
        profile_key
            Dotted key of the profile.
        answer_text
            Answer of the operator. After ``unknown`` the value remains to be filled in, if the
            profile allows this.

        Raises
        ------
        ValueError
            If the value is invalid; the message states the valid values.
        """
        if answer_text == UNKNOWN_SOURCE and profile_key in MAY_BE_UNKNOWN:
            self._settings[profile_key] = Setting(profile_key, math.nan, UNKNOWN_SOURCE)
            return
        value_type: Any = key_types()[profile_key]
        try:
            answered_value = TypeAdapter(value_type).validate_strings(answer_text)
        except ValidationError as error:
            raise ValueError(error.errors(include_url=False)[0]["msg"]) from None
        if answered_value != self._draft_value(profile_key):
            self._settings[profile_key] = Setting(profile_key, answered_value, "datasheet")

    def value_text(self, profile_key: str) -> str:
        """Return the draft's value of a key as text, or ``unknown``.

        Parameters
        ----------
        profile_key
            Dotted key of the profile.
        """
        return (
            UNKNOWN_SOURCE if self._is_unknown(profile_key) else str(self._draft_value(profile_key))
        )

    def _is_unknown(self, profile_key: str) -> bool:
        """Return whether the draft of the profile states a key's value as unknown."""
        return (
            profile_key in self._settings
            and self._settings[profile_key].value_source == UNKNOWN_SOURCE
        )

    def unaccepted_findings(self) -> list[SuitabilityFinding]:
        """Return the features that the drive lacks and without which the draft would be refused.

        Raises
        ------
        ProfileError
            If the values of the draft contradict one another.
        """
        acceptance_setting = Setting(_ACCEPT_WITHOUT_KEY, tuple(self._accepted))
        draft_text = with_settings(self._base.text, [*self._settings.values(), acceptance_setting])
        drive_findings = check_suitability(
            self._eds, profile_from_text(draft_text, self._path).rig
        ).findings
        return [
            finding
            for finding in drive_findings
            if finding.acceptance_name and finding.grade is Grade.REFUSED
        ]

    def accept(self, feature_name: str) -> None:
        """Accept a missing feature of the drive in the draft, as decided by the operator.

        Parameters
        ----------
        feature_name
            Name of the feature: `acceptance_name` of one of the findings that `unaccepted_findings`
            returns.
        """
        self._accepted.append(feature_name)

    @property
    def remarks(self) -> list[str]:
        """Sentences for the operator on what remains uncertain about this drive."""
        drive_findings = check_suitability(
            self._eds, profile_from_text(self._text_without_head(), self._path).rig
        ).findings
        remarks = [f.consequence for f in drive_findings if f.consequence]
        return remarks + [
            f"The file does not state the value of {f.checked_item}, which has to be "
            f"{f.required_text}: rigd check reads it from the drive."
            for f in drive_findings
            if f.grade is Grade.ASK and f.required_text
        ]

    def questions(self) -> list[Question]:
        """Return all questions to the operator about this drive."""
        additional_questions = (
            (_OWN_WATCHDOG_QUESTION,) if WATCHDOG in self._missing_feature_names() else ()
        )
        unneeded_keys = set() if self._eds.get(RATED_TORQUE) else {"cia402.rated_torque_unit_nm"}
        return [
            question
            for question in (*QUESTIONS, *additional_questions)
            if question.profile_key not in unneeded_keys
        ]

    def unanswered_questions(self) -> list[Question]:
        """Return the questions whose key is unknown or still has the value of the base profile."""
        answered_keys = {
            key
            for key, setting in self._settings.items()
            if setting.comment != _OTHER_DRIVE_COMMENT and setting.value_source != UNKNOWN_SOURCE
        }
        return [
            question for question in self.questions() if question.profile_key not in answered_keys
        ]

    def profile_text(self) -> str:
        """Return the text of the finished profile.

        Raises
        ------
        ProfileError
            If the values of the draft contradict one another.
        """
        profile_text = self._text_without_head()
        profile_from_text(profile_text, self._path)
        return with_head(profile_text, self._head_comment())

    def _text_without_head(self) -> str:
        """Return the text of the profile with its settings, but without the new head."""
        settings_to_fill_in = [
            Setting(
                question.profile_key,
                self._draft_value(question.profile_key),
                UNKNOWN_SOURCE if self._is_unknown(question.profile_key) else "assumed",
                comment="TO FILL IN: " + question.question_text,
            )
            for question in self.unanswered_questions()
        ]
        all_settings = [
            *self._settings.values(),
            *settings_to_fill_in,
            *self._acceptance_settings(),
        ]
        return with_settings(self._base.text, all_settings)

    def _acceptance_settings(self) -> Iterator[Setting]:
        """Yield the setting that accepts missing features of the drive, if one is needed.

        If the operator has accepted none yet, the setting is written as a comment.
        """
        undecided_feature_names = [
            finding.acceptance_name for finding in self.unaccepted_findings()
        ]
        limit_objects_text = (
            self._manufacturer_limits()
            if TORQUE_LIMIT in (*undecided_feature_names, *self._accepted)
            else ""
        )
        hint_text = (
            f" For a torque limit of its own see {limit_objects_text}, set by cia402.set_objects."
            if limit_objects_text
            else ""
        )
        if self._accepted:
            acceptance_comment = (
                "According to its file, the drive lacks these features (docs/devices.md)."
            )
            acceptance_comment += (
                f" Not accepted, so that rigd refuses it: {', '.join(undecided_feature_names)}."
                if undecided_feature_names
                else ""
            )
            yield Setting(
                _ACCEPT_WITHOUT_KEY, tuple(self._accepted), comment=acceptance_comment + hint_text
            )
        elif undecided_feature_names:
            acceptance_comment = (
                "TO FILL IN: according to its file, the drive lacks these features "
                "(docs/devices.md), and rigd refuses it. Remove the #, and from the list each "
                "feature that must not be missing."
            )
            yield Setting(
                _ACCEPT_WITHOUT_KEY,
                tuple(undecided_feature_names),
                comment=acceptance_comment + hint_text,
                is_commented_out=True,
            )
        elif self._base.rig.cia402 is not None and self._base.rig.cia402.accept_without:
            yield Setting(
                _ACCEPT_WITHOUT_KEY,
                (),
                comment="According to its file, the drive has all that is needed.",
            )

    def _missing_feature_names(self) -> list[str]:
        """Return the names of the drive's missing features that a profile must accept."""
        return [finding.acceptance_name for finding in self._findings if finding.acceptance_name]

    def _eds_settings(self) -> Iterator[Setting]:
        """Yield the settings that follow from the EDS file and from missing features."""
        eds, path = self._eds, self._path
        product_name = (
            " ".join(filter(None, (eds.vendor_name, eds.product_name))) or "CiA 402 drive"
        )
        yield Setting("name", path.stem)
        yield Setting("description", f"{product_name}, from {eds.path.name}")
        relative_path = os.path.relpath(eds.path.resolve(), path.resolve().parent)
        yield Setting(
            "cia402.eds", relative_path, comment="The drive's file, relative to this folder."
        )
        for key, identity_number in (
            ("vendor_id", eds.vendor_id),
            ("product_code", eds.product_code),
        ):
            if identity_number:
                yield Setting(f"cia402.{key}", identity_number, "datasheet", is_hexadecimal=True)
        if eds.commissioned_node_id:
            setting_comment = "The node id that the file configures."
            yield Setting("cia402.node_id", eds.commissioned_node_id, "datasheet", setting_comment)
        can_settings = self._base.rig.can
        if (
            can_settings is not None
            and eds.bit_rates_bit_s
            and can_settings.bitrate_bit_s not in eds.bit_rates_bit_s
        ):
            setting_comment = (
                f"The drive has no {can_settings.bitrate_bit_s / 1000:g} kbit/s; this is its "
                "highest."
            )
            yield Setting(
                "can.bitrate_bit_s", max(eds.bit_rates_bit_s), "datasheet", setting_comment
            )
        yield from self._reset_settings()
        yield from self._missing_object_settings()

    def _reset_settings(self) -> Iterator[Setting]:
        """Yield settings that replace values which hold only for the base profile's drive."""
        drive_settings = self._base.rig.cia402
        assert drive_settings is not None
        if drive_settings.set_objects:
            yield Setting("cia402.set_objects", (), comment=_OTHER_DRIVE_COMMENT)
        if drive_settings.own_watchdog_s:
            yield Setting("cia402.own_watchdog_s", 0.0, "assumed", _OTHER_DRIVE_COMMENT)

    def _missing_object_settings(self) -> Iterator[Setting]:
        """Yield a setting of 0 for each optional object that the drive lacks."""
        missing_feature_names = self._missing_feature_names()
        for is_object_missing, key, object_description in (
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
            (
                TORQUE_FEEDBACK in missing_feature_names,
                "torque_tolerance_percent",
                "6077 (actual torque)",
            ),
        ):
            if is_object_missing:
                yield Setting(
                    f"cia402.{key}",
                    0.0,
                    "datasheet",
                    f"The drive has no object {object_description}.",
                )

    def _manufacturer_limits(self) -> str:
        """Return the manufacturer-specific objects that may limit the torque, as text.

        The text is empty if there are none.
        """
        object_texts = [
            f"{e.index:04X}:{e.subindex:X} "
            f"({e.name}{'' if e.default_value is None else f', {e.default_value}'})"
            for e in self._eds.entries.values()
            if e.index in _MANUFACTURER_INDICES
            and e.is_writable
            and _TORQUE_LIMIT_NAME_PATTERN.search(e.name)
        ]
        return " or ".join(object_texts[:_MAX_NAMED_OBJECTS])

    def _head_comment(self) -> list[str]:
        """Return the lines of the comment at the beginning of the profile."""
        return [
            f"Written by rigd profiles new from {self._eds.path.name} and the profile "
            f"{self._base.name}.",
            "",
            "Without the hardware, a simulated rig speaks the same protocols in its place:",
            f"  rigd simulate --profile {self._path.name}",
            "",
            "Every number states its source:",
            "  paper      printed in the paper (antenna, damping, encoder)",
            "  datasheet  from the drive's file, or entered from a data sheet",
            "  measured   on a rig or a computer, as the comment states",
            "  unknown    no value yet: rigd moves nothing before all of these are filled in, as",
            '             { value = 0.5, source = "datasheet" }',
            "  assumed    from the base profile: check those marked TO FILL IN first",
            "Units are in the keys; angles and torques are at the output shaft, behind the gear.",
            *(
                ["", "Of this drive:", *(f"* {file_doubt}" for file_doubt in self.remarks)]
                if self.remarks
                else []
            ),
        ]
