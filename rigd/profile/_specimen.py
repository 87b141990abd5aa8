"""Specimens in their own files ``specimens/NAME.toml``, with the beam section of a profile."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Final

from rigd.beam import Beam, Damping
from rigd.devices import ActuationTarget, actuation_target
from rigd.profile import _diagnostics as diagnostics
from rigd.profile._load import ProfileError, complaint, flatten, parse, read_text, validate
from rigd.profile._locations import specimen_files
from rigd.profile._schema import (
    SECTIONS,
    BeamSection,
    Profile,
    ScaleUncertainty,
    Specimen,
    fields_of,
)
from rigd.units import suffix_of, unit_of

_BEAM: Final = "beam"
_DAMPING: Final = "beam.damping"
_UNCERTAINTY: Final = "uncertainty"
_OF_THE_RIG: Final = "uncertainty.torque_scale_percent"
_NOTE: Final = "note"
_MOST_BYTES: Final = 16_384
"""Largest file; each session sends it through a pipe to the recorder."""


def load_specimen(path: Path) -> Specimen:
    """Read and validate the file of a specimen.

    The file has the section ``[beam]`` of a profile. It may have ``[beam.damping]``, the keys of
    the beam in ``[uncertainty]``, and a text ``note``.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Specimen

    Raises
    ------
    ProfileError
        If the file cannot be read or has mistakes. Every problem is reported with its key, value,
        unit and remedy.
    """
    text = read_text(path)
    if len(text.encode()) > _MOST_BYTES:
        raise ProfileError(f"{path}: is longer than {_MOST_BYTES} bytes; shorten its notes.")
    problems: list[str] = []
    values, _ = flatten(parse(text, path), problems)
    note = values.pop(_NOTE, "")
    if not isinstance(note, str):
        problems.append(f"{_NOTE} = {note!r} must be text in quotes.")
    own = (f"{_BEAM}.", f"{_UNCERTAINTY}.")
    for key in [key for key in values if not key.startswith(own) or key == _OF_THE_RIG]:
        del values[key]
        problems.append(
            f"{key} does not belong to a specimen, which has [beam], [beam.damping], of "
            f"[uncertainty] all but {_OF_THE_RIG.partition('.')[2]}, and note; remove it."
        )
    sections = {_BEAM, _UNCERTAINTY}
    sections |= {_DAMPING for key in values if key.startswith(f"{_DAMPING}.")}
    values = validate(values, problems, frozenset({"", *SECTIONS} - sections))
    if not problems:
        problems.extend(diagnostics.first_mode(values))
    if problems:
        raise complaint(path, problems)
    beam = BeamSection(**{field: values[key] for key, field in fields_of(_BEAM)})
    damping = None
    if _DAMPING in sections:
        damping = Damping(**{field: values[key] for key, field in fields_of(_DAMPING)})
    uncertainty = ScaleUncertainty(**{field: values[key] for key, field in fields_of(_UNCERTAINTY)})
    return Specimen(
        path.stem, path, text, beam.uniform, damping, uncertainty, note, beam.tip_mass_kg
    )


def with_specimen(profile: Profile, name: str) -> Profile:
    """Return a profile with a mounted specimen, whose beam replaces that of the profile.

    Parameters
    ----------
    profile
        Profile of the rig.
    name
        Name of the specimen in a session. Without a file of that name it is only a label, and the
        profile is unchanged.

    Returns
    -------
    Profile

    Raises
    ------
    ProfileError
        If the file of that name cannot be used.
    """
    path = specimen_files().get(name.strip())
    if path is None:
        return profile
    specimen = load_specimen(path)
    rig = replace(profile.rig, beam=specimen.beam, damping=specimen.damping or profile.rig.damping)
    scale_percent = profile.uncertainty.torque_scale_percent
    return replace(
        profile,
        rig=rig,
        uncertainty=replace(specimen.uncertainty, torque_scale_percent=scale_percent),
        tip_mass_kg=specimen.tip_mass_kg,
        specimen=specimen,
        specimen_in_words=_in_words(profile, specimen),
    )


def _in_words(profile: Profile, specimen: Specimen) -> str:
    head = f"Specimen {specimen.name} ({specimen.path}): "
    different = [
        f"{name.removesuffix(suffix_of(name)).replace('_', ' ')} "
        f"{own:g} {unit_of(name)} (profile: {its:g})"
        for name in (each.name for each in fields(Beam))
        if (own := getattr(specimen.beam, name)) != (its := getattr(profile.rig.beam, name))
    ]
    if specimen.tip_mass_kg is not None:
        different.append(f"tip mass {1e3 * specimen.tip_mass_kg:g} g")
    if specimen.damping not in (None, profile.rig.damping):
        different.append("nominal damping of its own")
    if not different:
        return f"{head}beam as in the profile."
    words = f"{head}{', '.join(different)}; for prediction, nominal model and file."
    if actuation_target(profile.rig) is not ActuationTarget.HARDWARE:
        words += " The simulated rig keeps the beam of the profile."
    return words
