"""What the EDS of a drive tells, before anything is connected."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rigd.checks.rows import Row, Verdict
from rigd.devices.cia402.suitability import Grade, judge
from rigd.devices.eds import EdsError, read_eds

if TYPE_CHECKING:
    from rigd.devices.parameters import RigParameters

_VERDICTS = {
    Grade.FITS: Verdict.OK,
    Grade.STANDS_IN: Verdict.OK,
    Grade.ASK: Verdict.SKIPPED,
    Grade.ACCEPTED: Verdict.WARNING,
    Grade.DOUBT: Verdict.WARNING,
    Grade.REFUSED: Verdict.FAIL,
}


def eds_rows(path: Path, rig: "RigParameters | None") -> Iterator[Row]:
    """Hold an EDS file against what rigd asks of a drive.

    Parameters
    ----------
    path
        Of the file.
    rig
        Of the profile that the drive is to serve, or None.
    """
    try:
        node_id = rig.cia402.node_id if rig is not None and rig.cia402 is not None else 1
        eds = read_eds(path, node_id)
    except EdsError as error:
        yield Row("EDS", "file", str(error), "", Verdict.FAIL)
        return
    yield Row("EDS", "file", str(path), "", Verdict.OK)
    for finding in judge(eds, rig).findings:
        yield Row(
            "EDS",
            finding.what,
            finding.found,
            finding.wanted,
            _VERDICTS[finding.grade],
            finding.sentence,
        )
