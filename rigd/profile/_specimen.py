"""Loader of specimen files ``specimens/NAME.toml``, whose beam replaces that of a profile."""

import difflib
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Final

from rigd.beam import Beam, Damping
from rigd.devices import ActuationTarget, actuation_target
from rigd.profile import _diagnostics as diagnostics
from rigd.profile._load import (
    ProfileError,
    flatten_document,
    parse_document,
    problems_error,
    read_text,
    validate_values,
)
from rigd.profile._locations import specimen_files
from rigd.profile._schema import (
    SECTIONS,
    BeamSection,
    Profile,
    ScaleUncertainty,
    Specimen,
    section_fields,
)
from rigd.units import suffix_of, unit_of

_BEAM_SECTION: Final = "beam"
"""Name of the section with the beam."""
_DAMPING_SECTION: Final = "beam.damping"
"""Name of the section with the beam's damping."""
_UNCERTAINTY_SECTION: Final = "uncertainty"
"""Name of the section with the uncertainties."""
_RIG_UNCERTAINTY_KEY: Final = "uncertainty.torque_scale_percent"
"""Key of the uncertainties that belongs to the rig and not to a specimen."""
_NOTE_KEY: Final = "note"
"""Key of the free text."""
_MAX_FILE_BYTES: Final = 16_384
"""Largest size of a specimen file in bytes, which each session sends through a pipe."""


def load_specimen(specimen_path: Path) -> Specimen:
    """Read and validate the file of a specimen.

    The file has the section ``[beam]`` of a profile. It may have ``[beam.damping]``, the keys of
    the beam in ``[uncertainty]``, and a text ``note``.

    Parameters
    ----------
    specimen_path
        Path of the specimen file.

    Returns
    -------
    Specimen
        Validated values of the file.

    Raises
    ------
    ProfileError
        If the file cannot be read or has mistakes. Every problem is reported with its key, value,
        unit and remedy.
    """
    file_text = read_text(specimen_path)
    if len(file_text.encode()) > _MAX_FILE_BYTES:
        raise ProfileError(
            f"{specimen_path}: is longer than {_MAX_FILE_BYTES} bytes; shorten its notes."
        )
    problem_messages: list[str] = []
    values_by_key, _ = flatten_document(parse_document(file_text, specimen_path), problem_messages)
    specimen_note = values_by_key.pop(_NOTE_KEY, "")
    if not isinstance(specimen_note, str):
        problem_messages.append(f"{_NOTE_KEY} = {specimen_note!r} must be text in quotes.")
    valid_prefixes = (f"{_BEAM_SECTION}.", f"{_UNCERTAINTY_SECTION}.")
    for key in [
        key
        for key in values_by_key
        if not key.startswith(valid_prefixes) or key == _RIG_UNCERTAINTY_KEY
    ]:
        del values_by_key[key]
        problem_messages.append(
            f"{key} does not belong to a specimen, which has [beam], [beam.damping], of "
            f"[uncertainty] all but {_RIG_UNCERTAINTY_KEY.partition('.')[2]}, and note; remove it."
        )
    known_sections = {_BEAM_SECTION, _UNCERTAINTY_SECTION}
    known_sections |= {
        _DAMPING_SECTION for key in values_by_key if key.startswith(f"{_DAMPING_SECTION}.")
    }
    values_by_key = validate_values(
        values_by_key, problem_messages, frozenset({"", *SECTIONS} - known_sections)
    )
    if not problem_messages:
        problem_messages.extend(diagnostics.first_mode_contradictions(values_by_key))
    if problem_messages:
        raise problems_error(specimen_path, problem_messages)
    beam = BeamSection(
        **{field_name: values_by_key[key] for key, field_name in section_fields(_BEAM_SECTION)}
    )
    damping = None
    if _DAMPING_SECTION in known_sections:
        damping = Damping(
            **{
                field_name: values_by_key[key]
                for key, field_name in section_fields(_DAMPING_SECTION)
            }
        )
    uncertainty = ScaleUncertainty(
        **{
            field_name: values_by_key[key]
            for key, field_name in section_fields(_UNCERTAINTY_SECTION)
        }
    )
    return Specimen(
        specimen_path.stem,
        specimen_path,
        file_text,
        beam.uniform_beam,
        damping,
        uncertainty,
        specimen_note,
        beam.tip_mass_kg,
    )


def with_specimen(profile: Profile, specimen_name: str) -> Profile:
    """Return the profile of a rig on which a specimen is mounted.

    The beam of the specimen's file replaces that of the profile.

    Parameters
    ----------
    profile
        Profile of the rig.
    specimen_name
        Name of the specimen in a session. If there is no file of that name, it is only a label, and
        the beam is that of the profile.

    Returns
    -------
    Profile
        Profile with the beam, the damping and the uncertainties of the specimen.

    Raises
    ------
    ProfileError
        If the specimen's file cannot be used.
    """
    paths_by_name = specimen_files()
    specimen_name = specimen_name.strip()
    specimen_path = paths_by_name.get(specimen_name)
    if specimen_path is None:
        similar_names = difflib.get_close_matches(specimen_name, paths_by_name)
        return replace(
            profile, specimen_in_words=_describe_missing_file(specimen_name, similar_names)
        )
    specimen = load_specimen(specimen_path)
    rig = replace(profile.rig, beam=specimen.beam, damping=specimen.damping or profile.rig.damping)
    torque_scale_percent = profile.uncertainty.torque_scale_percent
    return replace(
        profile,
        rig=rig,
        uncertainty=replace(specimen.uncertainty, torque_scale_percent=torque_scale_percent),
        tip_mass_kg=specimen.tip_mass_kg,
        specimen=specimen,
        specimen_in_words=_describe_specimen(profile, specimen),
    )


def _describe_missing_file(specimen_name: str, similar_names: Sequence[str]) -> str:
    """Return a sentence for the operator if a specimen without a file may be one with a file."""
    if not similar_names:
        return ""
    return (
        f"Specimen {specimen_name!r} has no file: the beam is that of the profile. "
        f"Specimens with a similar name: {', '.join(map(repr, similar_names))}."
    )


def _describe_specimen(profile: Profile, specimen: Specimen) -> str:
    """Return a sentence on the specimen's differences from the profile, for the operator."""
    sentence_start = f"Specimen {specimen.name} ({specimen.path}): "
    difference_texts = [
        f"{field_name.removesuffix(suffix_of(field_name)).replace('_', ' ')} "
        f"{specimen_value:g} {unit_of(field_name)} (profile: {profile_value:g})"
        for field_name in (beam_field.name for beam_field in fields(Beam))
        if (specimen_value := getattr(specimen.beam, field_name))
        != (profile_value := getattr(profile.rig.beam, field_name))
    ]
    if specimen.tip_mass_kg is not None:
        difference_texts.append(f"tip mass {1e3 * specimen.tip_mass_kg:g} g")
    if specimen.damping not in (None, profile.rig.damping):
        difference_texts.append("nominal damping of its own")
    if not difference_texts:
        return f"{sentence_start}beam as in the profile."
    specimen_sentence = (
        f"{sentence_start}{', '.join(difference_texts)}; for prediction, nominal model and file."
    )
    if actuation_target(profile.rig) is not ActuationTarget.HARDWARE:
        specimen_sentence += " The simulated rig keeps the beam of the profile."
    return specimen_sentence
