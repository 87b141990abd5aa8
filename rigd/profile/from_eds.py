"""A profile for a drive that nobody has connected yet: from its EDS and another profile."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from rigd.devices.cia402.eds import Eds
from rigd.devices.cia402.suitability import judge
from rigd.profile.load import ProfileError, profile_of
from rigd.profile.settings import Profile, keys
from rigd.profile.write import Setting, SettingValue, with_head, with_settings


class UnusableDriveError(ValueError):
    """A drive that no profile can make fit; the message names what it lacks."""


@dataclass(frozen=True, slots=True)
class Question:
    """What no EDS tells and a profile has to."""

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
"""Friction and delay are not asked for: rigd identify motor measures them."""


class Draft:
    """A new profile on its way: what the EDS tells, and what is answered.

    Parameters
    ----------
    base
        The profile whose text and other values it takes.
    eds
        What the drive's file tells.
    path
        Of the file that is to be written.

    Raises
    ------
    UnusableDriveError
        If no profile makes this drive fit.
    ProfileError
        If the profile to start from has no CiA 402 drive.
    """

    def __init__(self, base: Profile, eds: Eds, path: Path) -> None:
        if base.rig.cia402 is None or base.rig.can is None:
            raise ProfileError(
                f"{base.path}: has no CiA 402 drive to put another in the place of; start from "
                "antenna_can or antenna_serial."
            )
        judgement = judge(eds)
        if judgement.refusals:
            raise UnusableDriveError(
                f"{eds.path}: no session could be run with this drive, and no profile was "
                f"written: {' '.join(judgement.refusals)}"
            )
        self._base = base
        self._eds = eds
        self._path = path
        self._settings = {setting.key: setting for setting in self._told()}

    def value(self, key: str) -> SettingValue:
        """Return the value that a key has so far."""
        if key in self._settings:
            return self._settings[key].value
        section, _, name = key.rpartition(".")
        value: SettingValue = getattr(getattr(self._base.rig, section), name)
        return value

    def answer(self, key: str, text: str) -> None:
        """Take an answer, of the operator from a data sheet.

        Raises
        ------
        ValueError
            If the key does not take it; the message says what it takes.
        """
        annotation: Any = keys()[key]
        try:
            value = TypeAdapter(annotation).validate_strings(text)
        except ValidationError as error:
            raise ValueError(error.errors(include_url=False)[0]["msg"]) from None
        if value != self.value(key):
            self._settings[key] = Setting(key, value, "datasheet")

    def unanswered(self) -> list[Question]:
        """Return the questions whose values are still those of the profile started from."""
        return [question for question in QUESTIONS if question.key not in self._settings]

    def text(self) -> str:
        """Return the text of the profile.

        Raises
        ------
        ProfileError
            If its values contradict one another.
        """
        marked = [
            Setting(question.key, self.value(question.key), reason="TO FILL IN: " + question.text)
            for question in self.unanswered()
        ]
        text = with_settings(self._base.text, [*self._settings.values(), *marked])
        text = with_head(text, self._head())
        profile_of(text, self._path)
        return text
